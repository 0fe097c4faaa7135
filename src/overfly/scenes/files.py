"""Scenes from files: which reader takes which file, and meshes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from overfly.cloud import read_cloud
from overfly.errors import InputError
from overfly.mesh import Z_UP_FROM_Y_UP, read_mesh
from overfly.ply import read_ply
from overfly.scenes import materials as m
from overfly.scenes.envelope import lower_envelope, top_raster
from overfly.scenes.lidar import from_cloud
from overfly.scenes.rasters import from_dsm
from overfly.scenes.scene import Scene

GREY = 0.3
"""Linear reflectance of a surface whose file has no colour."""

FAR_M = 10_000.0
"""Coordinates beyond this are shifted to a local origin, for float32 would lose the millimetres."""


def load(path: Path, orthophoto: Path | None = None) -> Scene:
    """See :func:`overfly.scenes.load_scene`."""
    suffix = path.suffix.lower()
    if suffix in (".tif", ".tiff"):
        return from_dsm(path, orthophoto)
    if orthophoto is not None:
        raise InputError(f"An orthophoto goes with a height raster (.tif), but the scene is {path.name}: leave it out.")
    if suffix in (".las", ".laz"):
        return from_cloud(read_cloud(path), path.stem)
    if suffix == ".ply":
        faces = read_ply(path).faces
        if faces is None or not len(faces):
            return from_cloud(read_cloud(path), path.stem)
    return _from_mesh(path)


def _from_mesh(path: Path) -> Scene:
    mesh = read_mesh(path)
    vertices, faces = mesh.vertices, mesh.faces
    offset = np.zeros(3)
    if np.abs(vertices[:, :2]).max() > FAR_M:
        offset[:2] = np.round((vertices[:, :2].min(0) + vertices[:, :2].max(0)) / 2)
    vertices = (vertices - offset).astype(np.float32).astype(np.float64)
    edges = vertices[faces[:, 1:]] - vertices[faces[:, :1]]
    normal = np.cross(edges[:, 0], edges[:, 1])
    if not np.abs(normal).max() > 0:
        raise InputError(f"{path} has no area: all its triangles are degenerate.")
    if not np.ptp(vertices[:, 0]) > 0 or not np.ptp(vertices[:, 1]) > 0:
        raise InputError(f"{path} is a vertical sheet: a scene needs some extent in x and in y.")
    material, shape, colors = np.full(len(faces), m.PAINT, np.int32), np.zeros((len(faces), 4), np.float32), None
    uv, texture = _texture(path, len(vertices))
    if texture is not None and uv is not None:
        material[:] = m.TEXTURE
        shape[:, 0] = _density(uv[faces], texture, 0.5 * np.linalg.norm(normal, axis=1))
    elif mesh.colors is not None:
        material[:], colors = m.VERTEX, mesh.colors
    paint = np.tile(np.array([GREY, GREY, GREY, 0], np.float32), (len(faces), 1))
    low, high = vertices.min(0), vertices.max(0)
    terrain = lower_envelope(*top_raster(_dense_points(vertices, faces, normal), low, high))
    return Scene(
        name=path.stem,
        vertices=vertices,
        faces=faces,
        normals=_vertex_normals(vertices, faces, normal),
        material=material,
        paint=paint,
        shape=shape,
        terrain=terrain,
        extent=(float(low[0]), float(low[1]), float(high[0]), float(high[1])),
        colors=colors,
        uv=uv,
        texture=texture,
        offset=(float(offset[0]), float(offset[1]), 0.0),
    )


def _dense_points(vertices: NDArray, faces: NDArray, normal: NDArray) -> NDArray:
    """Vertices and evenly drawn points of the faces, enough to fill a raster of the top surface."""
    rng = np.random.default_rng(0)
    area = np.linalg.norm(normal, axis=1)
    face = rng.choice(len(faces), 200_000, p=area / area.sum())
    weights = rng.dirichlet((1, 1, 1), len(face))
    return np.concatenate([vertices, (vertices[faces[face]] * weights[..., None]).sum(1)])


def _vertex_normals(vertices: NDArray, faces: NDArray, normal: NDArray) -> NDArray[np.float32]:
    """Shading normals: smooth where a vertex's faces nearly agree, else the zero vector, which shades flat."""
    unit = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    total, count = np.zeros_like(vertices), np.zeros(len(vertices))
    for corner in range(3):
        np.add.at(total, faces[:, corner], unit)
        np.add.at(count, faces[:, corner], 1)
    length = np.linalg.norm(total, axis=1)
    smooth = length > 0.9 * count
    return np.where(smooth[:, None], total / np.maximum(length, 1e-12)[:, None], 0.0).astype(np.float32)


def _texture(path: Path, count: int) -> tuple[NDArray[np.float32] | None, NDArray[np.uint8] | None]:
    """Texture coordinates [V, 2] and one image of all textures stacked, if every part of the mesh has a texture."""
    if path.suffix.lower() == ".ply":
        return None, None
    import trimesh

    scene = trimesh.load_scene(path, process=False, maintain_order=True)
    if path.suffix.lower() == ".glb":
        scene.apply_transform(Z_UP_FROM_Y_UP)
    parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh)]
    images = [_image(part) for part in parts]
    if not parts or sum(len(part.vertices) for part in parts) != count:
        return None, None
    found = [image for image in images if image is not None]
    if len(found) < len(parts):
        return None, None
    width, height = max(i.shape[1] for i in found), sum(i.shape[0] for i in found)
    atlas, uv, row = np.zeros((height, width, 3), np.uint8), [], 0
    for part, image in zip(parts, found):
        rows, cols = image.shape[:2]
        atlas[row : row + rows, :cols] = image
        own = np.asarray(part.visual.uv, float)
        if own.min() < -0.01 or own.max() > 1.01:  # a repeated texture: bring the coordinates into the image
            own = own % 1.0
        uv.append(np.stack([own[:, 0] * cols / width, 1 - (row + (1 - own[:, 1]) * rows) / height], -1))
        row += rows
    return np.concatenate(uv).astype(np.float32), atlas


def _image(part: Any) -> NDArray[np.uint8] | None:
    material = getattr(part.visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if image is None or getattr(part.visual, "uv", None) is None:
        return None
    return np.asarray(image.convert("RGB"), np.uint8)


def _density(uv: NDArray, texture: NDArray, area: NDArray) -> NDArray[np.float32]:
    """Texels per metre of each face [F]."""
    edges = (uv[:, 1:] - uv[:, :1]) * [texture.shape[1], texture.shape[0]]
    texels = 0.5 * np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0])
    return np.sqrt(texels / np.maximum(area, 1e-9)).astype(np.float32)
