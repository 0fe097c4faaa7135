"""The scene: one triangle mesh with materials, its bare ground, and the two ways to get one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from overfly.errors import InputError, unknown
from overfly.geodesy import Origin

STYLES = ("campus", "blocks", "suburb", "village", "industrial", "vegetation")
"""The procedural landscapes that :func:`make_scene` can build."""

SUFFIXES = (".ply", ".obj", ".glb", ".las", ".laz", ".tif", ".tiff")
"""The files that :func:`load_scene` reads."""


@dataclass(frozen=True)
class Heightfield:
    """Bare ground ``z`` [rows, cols] on uneven, ascending lines ``x`` [cols] and ``y`` [rows]; metres."""

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    z: NDArray[np.float64]

    def __call__(self, xy: ArrayLike) -> NDArray[np.float64]:
        """Height [N] at ``xy`` [N, 2], exactly on the triangles of :meth:`mesh`; beyond the rim the rim's height."""
        points = np.asarray(xy, float).reshape(-1, 2)
        px, py = np.clip(points[:, 0], self.x[0], self.x[-1]), np.clip(points[:, 1], self.y[0], self.y[-1])
        col = np.clip(np.searchsorted(self.x, px, side="right") - 1, 0, len(self.x) - 2)
        row = np.clip(np.searchsorted(self.y, py, side="right") - 1, 0, len(self.y) - 2)
        u = (px - self.x[col]) / (self.x[col + 1] - self.x[col])
        v = (py - self.y[row]) / (self.y[row + 1] - self.y[row])
        a, b = self.z[row, col], self.z[row, col + 1]
        d, c = self.z[row + 1, col], self.z[row + 1, col + 1]
        return np.where(u >= v, a + u * (b - a) + v * (c - b), a + v * (d - a) + u * (c - d))

    def mesh(self) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """Vertices [rows * cols, 3] and faces [2 (rows - 1)(cols - 1), 3], normals up."""
        gx, gy = np.meshgrid(self.x, self.y)
        index = np.arange(gx.size, dtype=np.int32).reshape(gx.shape)
        a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
        faces = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2)
        return np.stack([gx, gy, self.z], -1).reshape(-1, 3), faces.reshape(-1, 3)

    def normals(self) -> NDArray[np.float64]:
        """Smooth unit normals [rows * cols, 3] of the mesh's vertices."""
        dy, dx = np.gradient(self.z, self.y, self.x)
        normal = np.stack([-dx, -dy, np.ones_like(dx)], -1).reshape(-1, 3)
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)


@dataclass(frozen=True)
class Cover:
    """What lies on the ground: a raster that the shading kernel reads; row 0 is the south.

    Attributes:
        x_min, y_min, size_m: the south-western corner and the width of the square that both rasters fill, metres.
        kind: [n, n] uint8, codes of :mod:`overfly.scenes.materials`.
        road: [k, k, 4] float32: signed distance to the nearest road's axis, half its width, the way along it,
            and the way to the edge of the nearest crossing; all metres. Bilinear interpolation keeps its edges sharp.
        heading_deg: turn of the layout against east, counter-clockwise: stall lines, mowing and paving follow it.
        pavement: width of the pavement beside the streets, metres, 0 = none.
        marked: whether the streets carry lane marks.
        wild: the kind beyond the raster.
    """

    x_min: float
    y_min: float
    size_m: float
    kind: NDArray[np.uint8]
    road: NDArray[np.float32]
    heading_deg: float = 0.0
    pavement: float = 0.0
    marked: bool = False
    wild: int = 0


@dataclass(frozen=True)
class Scene:
    """A landscape: one triangle mesh in local ENU metres.

    Attributes:
        name: a style and seed, or the file's name.
        vertices: [V, 3] float64, each exactly representable in float32.
        faces: [F, 3] int32.
        normals: [V, 3] float32 shading normals.
        material: [F] int32, codes of :mod:`overfly.scenes.materials`.
        paint: [F, 4] float32: red, green, blue (0..1, linear reflectance) and a random number 0..1 of the object.
        shape: [F, 4] float32: the material's own numbers (see :mod:`overfly.scenes.materials`).
        terrain: the bare ground (for files: an estimate by the lower envelope).
        extent: x_min, y_min, x_max, y_max of the landscape; procedural ground goes on beyond it, without objects.
        cover: what lies on procedural ground, or None.
        colors: [V, 3] uint8 vertex colours, for faces of material VERTEX.
        uv: [V, 2] float32 texture coordinates (v upward), for faces of material TEXTURE.
        texture: [rows, cols, 3] uint8, row 0 = top (v = 1).
        origin: where the local frame stands on the Earth, if known.
        offset: what was subtracted from a file's coordinates; add it to get them back (0 where ``origin`` is known).
        seed: for the kernel's noise.
    """

    name: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    normals: NDArray[np.float32]
    material: NDArray[np.int32]
    paint: NDArray[np.float32]
    shape: NDArray[np.float32]
    terrain: Heightfield
    extent: tuple[float, float, float, float]
    cover: Cover | None = None
    colors: NDArray[np.uint8] | None = None
    uv: NDArray[np.float32] | None = None
    texture: NDArray[np.uint8] | None = None
    origin: Origin | None = None
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    seed: int = 0

    @cached_property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lowest and highest corner ([3], [3]) of the landscape within its extent."""
        x_min, y_min, x_max, y_max = self.extent
        x, y, z = self.vertices.T
        inside = (x >= x_min) & (x <= x_max) & (y >= y_min) & (y <= y_max)
        heights = z[inside] if inside.any() else z
        return np.array([x_min, y_min, heights.min()]), np.array([x_max, y_max, heights.max()])

    def ground(self, xy: ArrayLike) -> NDArray[np.float64]:
        """Height [N] of the bare ground at ``xy`` [N, 2] (or [2]), metres."""
        return self.terrain(xy)

    def sample(self, n: int, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
        """``n`` points on all surfaces within the extent, walls and undersides too, uniform by area.

        Returns:
            Points [n, 3] (metres) and their unlit colours [n, 3] uint8.
        """
        from overfly.scenes.renderer import surface_colors
        from overfly.scenes.sampling import sample_faces

        faces, weights, points = sample_faces(self, n, rng)
        return points, surface_colors(self, faces, weights)


def make_scene(style: str, seed: int, *, size_m: float = 400.0, relief: float | None = None) -> Scene:
    """Build a procedural landscape; the same arguments give the same scene.

    Args:
        style: one of :data:`STYLES`.
        seed: 0 or more.
        size_m: width and depth in metres, 60 to 4000, centred on the local origin.
        relief: height range of the bare ground in metres; None takes the style's own.

    Raises:
        InputError: unknown style, or a value out of range.
    """
    if style not in STYLES:
        raise unknown("The scene style", style, STYLES)
    if not 60 <= size_m <= 4000:
        raise InputError(f"The scene's size is {size_m} m: give 60 to 4000.")
    if seed < 0:
        raise InputError(f"The scene's seed is {seed}: give 0 or more.")
    if relief is not None and not 0 <= relief <= 500:
        raise InputError(f"The scene's relief is {relief} m: give 0 to 500.")
    from overfly.scenes.styles import build

    return build(style, int(seed), float(size_m), relief)


def load_scene(path: Path | str, *, orthophoto: Path | str | None = None) -> Scene:
    """Read a scene from a mesh (.ply, .obj, .glb), a lidar cloud (.laz, .las, .ply without faces) or a DSM (.tif).

    Files in a CRS are taken to local ENU metres about their centre (heights as ellipsoidal, in the CRS's own unit);
    files without one keep their coordinates, shifted only where they lie beyond 10 km.

    Args:
        path: the file.
        orthophoto: colours of a DSM; None takes ``<name>_ortho.tif`` or ``orthophoto.tif`` beside it, else grey.

    Raises:
        InputError: missing, of another kind, broken, empty or holding NaN.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(
            f"{path} cannot be a scene: give a mesh ({', '.join(SUFFIXES[:3])}), a cloud (.las, .laz, .ply), "
            f"a height raster (.tif) or a style ({', '.join(STYLES)})."
        )
    if not path.is_file():
        raise InputError(f"The scene file {path} does not exist.")
    from overfly.scenes.files import load

    return load(path, None if orthophoto is None else Path(orthophoto))


def open_scene(scene: Path | str, seed: int = 0, *, size_m: float = 400.0) -> Scene:
    """A scene by the name of a style, or from a file; ``seed`` and ``size_m`` apply to styles only."""
    if str(scene) in STYLES:
        return make_scene(str(scene), seed, size_m=size_m)
    if Path(scene).suffix:
        return load_scene(scene)
    raise unknown("The scene", str(scene), STYLES, "Or give a .ply, .obj, .glb, .laz or .tif file.")
