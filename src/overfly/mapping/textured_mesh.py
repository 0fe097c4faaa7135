"""The surface of a map as a textured mesh: ``mesh.glb``, for any viewer of 3D models.

Every face shows the photograph that sees it best. What no photograph sees keeps the colours of the cloud, cut from one
more picture: the mesh's vertices as pixels, seen from above.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from overfly.errors import InputError
from overfly.geometry import Array, project
from overfly.mapping.atlas import Layout, Picture, lay_out, paint, scaled
from overfly.mapping.face_labels import charts, choose
from overfly.mapping.face_views import rank_views
from overfly.mapping.gains import Gains
from overfly.mapping.glb import Part, write_glb
from overfly.mapping.seams import field, movements, tones_at
from overfly.mapping.visibility import Image, View
from overfly.mesh import Mesh
from overfly.rendering.topology import topology

Bar = Callable[[str, str], AbstractContextManager[Callable[[int, int], None]]]

TEXELS, WIDEST = 4, 4096
"""Pixels along a cell of the mesh where the cloud gives the colours, for JPEG blends the colours of single ones; fewer
where that picture would be wider."""


def write_textured_mesh(
    path: Path,
    mesh: Mesh,
    views: Sequence[View],
    gains: Gains,
    *,
    place: Callable[[Array], Array],
    crs: str | None,
    bar: Bar,
) -> dict[str, Any]:
    """Texture a mesh from photographs and write it, atomically.

    Args:
        path: the .glb file.
        mesh: a coloured height field in the frame of the cameras, z up.
        views: n frames with cameras and poses.
        gains: of them.
        place: from that frame to the coordinates of the product, [N, 3] -> [N, 3].
        crs: of the product, None for a local frame.
        bar: shows progress; see :meth:`overfly.mapping.steps.Steps.bar`.

    Returns:
        For ``map.json``: ``faces``; ``origin``, which added to the file's x, -z, y gives the coordinates of the product
        in ``crs``; ``texture_px``, width and height of each page; ``texture_scale`` of the photographs, 1 for their own
        resolution; ``textured_share`` of the mesh's area that a photograph colours; ``charts``.

    Raises:
        InputError: the mesh has no colours, or an image cannot be read.
    """
    if mesh.colors is None:
        raise InputError("The cloud has no colours, so that what no photograph sees would have none.")
    neighbours = topology(mesh.faces, len(mesh.vertices)).neighbours.numpy()
    with bar("mesh", "photographs") as update:
        candidates = rank_views(mesh, views, gains.sharpness, update)
    label = choose(candidates, neighbours)
    unseen = label < 0
    label[unseen] = len(views)  # the picture of the cloud's colours
    chart = charts(label, neighbours)
    corner_chart, vertex, face = _split(mesh.faces, chart)
    above = Above(mesh)
    pictures: list[Picture] = [*(Photograph(v, g) for v, g in zip(views, gains.colors, strict=True)), above]
    picture = np.empty(chart.max() + 1, np.int64)
    picture[chart] = label
    pixels = _pixels(mesh, views, above, picture[corner_chart], vertex)
    low, high = _bounds(pixels, corner_chart, len(picture))
    layout = lay_out(picture, low, high)
    owner = picture[corner_chart]
    with bar("mesh", "tones") as update:
        tones = _tones(pictures[:-1], owner, pixels, face, layout.scale, update)
    moved = movements(tones, vertex, face)
    with bar("mesh", "texture") as update:
        fields = partial(_field, pictures[:-1], owner, pixels, face, moved)
        pages = paint(layout, pictures, fields, mesh.colors.mean(0), update)
    placed = place(mesh.vertices)
    origin = np.round((placed.min(0) + placed.max(0)) / 2)
    uv = layout.texture_coordinates(corner_chart, pixels)
    extras = {"origin": origin.tolist(), "crs": crs, "coordinates": "x + origin[0], origin[1] - z, y + origin[2]"}
    write_glb(path, _parts(placed - origin, uv, vertex, face, layout, corner_chart, pages), extras)
    areas = mesh.areas()
    return {
        "faces": len(mesh.faces),
        "origin": origin.tolist(),
        "crs": crs,
        "texture_px": [list(size) for size in layout.sizes],
        "texture_scale": round(layout.scale, 4),
        "textured_share": round(float(areas[~unseen].sum() / areas.sum()), 4),
        "charts": len(picture),
    }


@dataclass(frozen=True)
class Photograph:
    """A frame in its gains [3], to cut charts from."""

    view: View
    gains: Array

    @property
    def size(self) -> tuple[int, int]:
        camera = self.view.camera
        assert camera is not None
        return camera.width, camera.height

    def read(self, size: tuple[int, int]) -> Image:
        import cv2

        image = self.view.image()
        if image.shape[1::-1] != size:
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
        table = np.clip(np.rint(np.arange(256)[:, None] * self.gains), 0, 255).astype(np.uint8)
        return np.asarray(cv2.LUT(image, table[None]))


class Above:
    """The vertices of a height field as pixels of a picture from above.

    Attributes:
        pixels: [V, 2] where the vertices are.
    """

    def __init__(self, mesh: Mesh) -> None:
        assert mesh.colors is not None
        columns, column = np.unique(mesh.vertices[:, 0], return_inverse=True)
        rows, row = np.unique(-mesh.vertices[:, 1], return_inverse=True)
        self._texels = min(TEXELS, max(1, WIDEST // max(len(rows), len(columns))))
        self.pixels = self._texels * (np.column_stack([column, row]) + 0.5)
        self._colors = np.zeros((len(rows), len(columns), 3), np.uint8)
        self._colors[row, column] = mesh.colors

    @property
    def size(self) -> tuple[int, int]:
        rows, columns, _ = self._colors.shape
        return self._texels * columns, self._texels * rows

    def read(self, size: tuple[int, int]) -> Image:
        import cv2

        return np.asarray(cv2.resize(self._colors, size, interpolation=cv2.INTER_LINEAR))


def _split(faces: NDArray, chart: NDArray) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Vertices of their own for each chart: chart [W], vertex of the mesh [W], and faces [F, 3] of the new ones."""
    count = int(faces.max()) + 1
    keys, face = np.unique(chart[:, None].astype(np.int64) * count + faces, return_inverse=True)
    return *np.divmod(keys, count), face.reshape(-1, 3)


def _pixels(mesh: Mesh, views: Sequence[View], above: Above, picture: NDArray, vertex: NDArray) -> Array:
    """Where vertices [W] of the mesh stand in their pictures [W]: pixels [W, 2]."""
    pixels = above.pixels[vertex]
    order = np.argsort(picture, kind="stable")
    for mine in np.split(order, np.flatnonzero(np.diff(picture[order])) + 1):
        if (i := picture[mine[0]]) < len(views):
            camera, pose = views[i].camera, views[i].world_from_camera
            assert camera is not None
            assert pose is not None
            pixels[mine], _ = project(mesh.vertices[vertex[mine]], camera, pose)
    return np.asarray(pixels)


def _tones(
    photographs: Sequence[Picture],
    owner: NDArray,
    pixels: Array,
    face: NDArray,
    scale: float,
    progress: Callable[[int, int], None],
) -> Array:
    """Tones of the charts' vertices [W, 3], averaged over a side of their faces; NaN where no photograph is."""
    tones = np.full((len(pixels), 3), np.nan)
    for i, photograph in enumerate(photographs):
        mine = np.flatnonzero(owner == i)
        if len(mine):
            sides = pixels[face[owner[face[:, 0]] == i]]
            width = float(np.median(np.linalg.norm(sides[:, 1] - sides[:, 0], axis=1)))
            size = scaled(photograph.size, scale)
            tones[mine] = tones_at(photograph.read(size), pixels[mine] * scale, width * scale)
        progress(i + 1, len(photographs))
    return tones


def _field(
    photographs: Sequence[Picture], owner: NDArray, pixels: Array, face: NDArray, moved: Array, i: int
) -> NDArray[np.float32] | None:
    """How the tones of picture ``i`` are moved; those of the cloud are not."""
    if i >= len(photographs):
        return None
    used, faces = np.unique(face[owner[face[:, 0]] == i], return_inverse=True)
    return field(photographs[i].size, pixels[used], moved[used], faces.reshape(-1, 3))


def _bounds(pixels: Array, chart: NDArray, count: int) -> tuple[Array, Array]:
    """Least and largest pixel of each chart [C, 2]."""
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, chart, pixels)
    np.maximum.at(high, chart, pixels)
    return low, high


def _parts(
    points: Array, uv: Array, vertex: NDArray, face: NDArray, layout: Layout, chart: NDArray, pages: list[bytes]
) -> list[Part]:
    """The faces of each page, with vertices of their own."""
    page = layout.page[chart]
    parts = []
    for i, texture in enumerate(pages):
        mine = np.flatnonzero(page == i)
        number = np.zeros(len(page), np.int64)
        number[mine] = np.arange(len(mine))
        faces = face[page[face[:, 0]] == i]
        parts.append(Part(points[vertex[mine]], uv[mine], number[faces], texture))
    return parts
