"""The triangle mesh: vertices, faces, vertex colours, and its files (PLY, OBJ, GLB).

In memory z is up, as everywhere. GLB files are y up by their standard: they are turned on reading and turned back on
writing; PLY and OBJ, which fix no axis, are taken as they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from overfly.cloud import Cloud
from overfly.errors import InputError
from overfly.files import existing, replacing
from overfly.ply import read_ply, write_ply

if TYPE_CHECKING:
    import trimesh

SUFFIXES = (".ply", ".obj", ".glb")

Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


@dataclass(frozen=True)
class Mesh:
    """Triangles in one frame of reference.

    Attributes:
        vertices: [V, 3] float64, metres.
        faces: [F, 3] int32, counter-clockwise seen from outside.
        colors: [V, 3] uint8 RGB, or None.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    colors: NDArray[np.uint8] | None = None

    def areas(self) -> NDArray[np.float64]:
        """Area of every face [F], square metres."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)

    def sample(self, n: int, rng: np.random.Generator) -> Cloud:
        """``n`` points, uniform by area over all faces, with interpolated colours.

        Raises:
            InputError: the mesh has no area.
        """
        areas = self.areas()
        if not areas.sum() > 0:
            raise InputError(
                "A mesh without area cannot be sampled: give one with triangles that are not all degenerate."
            )
        face = np.searchsorted(np.cumsum(areas), rng.random(n) * areas.sum(), side="right").clip(0, len(areas) - 1)
        u, v = rng.random((2, n))
        folded = u + v > 1  # the other half of the parallelogram, mirrored into the triangle
        u, v = np.where(folded, 1 - u, u), np.where(folded, 1 - v, v)
        weights = np.stack([1 - u - v, u, v], axis=1)[..., None]  # [n, 3, 1]
        corners = self.faces[face]
        points = (self.vertices[corners] * weights).sum(1)
        if self.colors is None:
            return Cloud(points)
        return Cloud(points, np.rint((self.colors[corners] * weights).sum(1)).astype(np.uint8))


def read_mesh(path: Path | str) -> Mesh:
    """Read a .ply, .obj or .glb file; polygons become triangles, textures become vertex colours, vertices stay apart.

    Raises:
        InputError: the file is missing, of another kind, broken, has no faces, or has NaN vertices.
    """
    path = existing(path, "The mesh", SUFFIXES)
    mesh = _read_ply(path) if path.suffix.lower() == ".ply" else _read_trimesh(path)
    if not len(mesh.faces):
        raise InputError(f"{path} has no faces: give a triangle mesh (a point cloud has only vertices).")
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise InputError(f"A face of {path} names a vertex that does not exist: write the file again.")
    if bad := int((~np.isfinite(mesh.vertices)).any(axis=1).sum()):
        raise InputError(
            f"{bad} of the {len(mesh.vertices)} vertices of {path} are NaN or infinite: mend the mesh first."
        )
    return mesh


def write_mesh(mesh: Mesh, path: Path | str) -> None:
    """Write .ply (float64), .obj or .glb (by the suffix), atomically.

    Raises:
        InputError: the suffix is unknown.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"A mesh cannot be written as {path.name}: end the name in {', '.join(SUFFIXES)}.")
    if suffix == ".ply":
        columns = dict(zip("xyz", np.asarray(mesh.vertices, np.float64).T, strict=True))
        if mesh.colors is not None:
            columns |= dict(zip(("red", "green", "blue"), np.asarray(mesh.colors, np.uint8).T, strict=True))
        write_ply(path, columns, np.asarray(mesh.faces, np.int32))
        return
    import trimesh

    if suffix == ".obj":
        data: str | bytes = _trimesh(mesh, np.zeros(3)).export(file_type="obj", digits=6, include_normals=False)
    else:
        # GLB holds float32: large coordinates go into the node's transform, which is written as decimal numbers.
        offset = np.round(mesh.vertices.mean(0)) if len(mesh.vertices) else np.zeros(3)
        scene = trimesh.Scene()
        placed = np.linalg.inv(Z_UP_FROM_Y_UP)
        placed[:3, 3] = placed[:3, :3] @ offset
        scene.add_geometry(_trimesh(mesh, offset), node_name="mesh", transform=placed)
        data = scene.export(file_type="glb")
    with replacing(path) as temporary:
        temporary.write_bytes(data.encode() if isinstance(data, str) else data)


def _trimesh(mesh: Mesh, offset: NDArray) -> trimesh.Trimesh:
    import trimesh

    return trimesh.Trimesh(mesh.vertices - offset, mesh.faces, vertex_colors=mesh.colors, process=False)


def _read_ply(path: Path) -> Mesh:
    ply = read_ply(path)
    columns = ply.columns
    if not {"x", "y", "z"} <= columns.keys():
        raise InputError(f"{path} has no x, y and z: give a triangle mesh.")
    rgb = [columns[name] for name in ("red", "green", "blue") if name in columns]
    return Mesh(
        np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1),
        np.zeros((0, 3), np.int32) if ply.faces is None else ply.faces,
        np.stack(rgb, axis=1).astype(np.uint8) if len(rgb) == 3 else None,
    )


def _read_trimesh(path: Path) -> Mesh:
    import trimesh

    try:
        scene = trimesh.load_scene(path, process=False, maintain_order=True)
        if path.suffix.lower() == ".glb":
            scene.apply_transform(Z_UP_FROM_Y_UP)
        parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh)]
        known = [c for part in parts if (c := _vertex_colors(part)) is not None]
    except Exception as error:  # the readers of the formats fail in many ways, all of them the file's fault
        raise InputError(f"{path} is not a readable mesh ({error}): write it again or give another file.") from error
    if not parts:
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return Mesh(
        np.concatenate([np.asarray(part.vertices, np.float64) for part in parts]),
        np.concatenate([np.asarray(part.faces) + start for part, start in zip(parts, starts)]).astype(np.int32),
        np.concatenate(known) if len(known) == len(parts) else None,
    )


def _vertex_colors(part: trimesh.Trimesh) -> NDArray[np.uint8] | None:
    """Colours [V, 3] from vertex colours, a texture or a plain material; None where the file has none."""
    visual = part.visual
    if visual.kind == "texture":
        visual = visual.to_color()
    if visual.kind is None:
        return None
    return np.asarray(visual.vertex_colors)[:, :3].astype(np.uint8)
