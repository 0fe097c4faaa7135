"""Which photographs see which faces of a mesh, and how well: unhidden, frontal, far from the border, sharp and near.

Whether a face is hidden is told by a depth buffer that the mesh itself is drawn into, over the ideal image plane: the
lens plays no part there, and none of its pixels is lost.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from overfly.flights.footprint import border_pixels
from overfly.geometry import Array, Camera, invert, project, rays, transform
from overfly.mapping.visibility import View
from overfly.mesh import Mesh
from overfly.rendering.operations import interpolate, rasterise
from overfly.rendering.render import Views
from overfly.rendering.render import project as project_mesh

CANDIDATES = 8
"""Photographs remembered of each face, the best ones."""

BUFFER = 1024
"""Longest side of a depth buffer, pixels."""

SLACK = 3.0
"""A point is hidden that lies more than this many buffer pixels, on the ground, behind what is seen."""

HEM = (2, 15)
"""Least and most buffer pixels around a point, otherwise a cell of the mesh, in which nothing should stand before it:
the edges of a mesh are off by as much, and a photograph that sees a face close behind one may show the roof there."""

STEP = 2.0
"""Cells by which something stands before a point, and not only beside it on a slope."""

BESIDE_EDGE = 0.05
"""Factor on the worth of a photograph in which nothing of a face is free of edges."""

BORDER = 4.0
"""Pixels at an image's border that colour nothing: filters see them only from one side."""

RAMP = 8.0
"""A photograph has its full weight from 1 / RAMP of the image's side from the border on."""

GRAZING = 0.05
"""Cosine of the angle between a face's normal and the line of sight under which it shows no more than its edge."""

FRONTAL = 3
"""Power of that cosine in the worth: the texture is off by the tangent of the angle times the error of the surface."""

SAMPLES = np.array(
    [[0.9, 0.05, 0.05], [0.05, 0.9, 0.05], [0.05, 0.05, 0.9], [0.5, 0.5, 0], [0, 0.5, 0.5], [0.5, 0, 0.5], [1 / 3] * 3]
)
"""Barycentric coordinates of the points of a face that are tested."""


class Candidates(NamedTuple):
    """The best photographs of each of F faces, in no order.

    Attributes:
        photo: [F, CANDIDATES] int32, -1 where fewer see the face.
        worth: [F, CANDIDATES] float32 above 0; 0 where there is no photograph.
    """

    photo: NDArray[np.int32]
    worth: NDArray[np.float32]


def rank_views(
    mesh: Mesh,
    views: Sequence[View],
    sharpness: Array,
    progress: Callable[[int, int], None] | None = None,
) -> Candidates:
    """The photographs that see all of a face, and what they are worth.

    Args:
        mesh: in the frame of the cameras.
        views: n frames with cameras and poses; no image is read.
        sharpness: [n] factors, see :class:`overfly.mapping.gains.Gains`.
        progress: told (done, in all).
    """
    corners = mesh.vertices[mesh.faces]  # [F, 3, 3]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)
    smooth = _smoothed(mesh, across)
    cell = float(np.sqrt(np.median(np.abs(across[:, 2]))))  # side of the square that two faces make
    vertices, faces = torch.from_numpy(mesh.vertices), torch.from_numpy(np.ascontiguousarray(mesh.faces, np.int32))
    found = Candidates(
        np.full((len(mesh.faces), CANDIDATES), -1, np.int32), np.zeros((len(mesh.faces), CANDIDATES), np.float32)
    )
    for i, view in enumerate(views):
        camera, pose = view.camera, view.world_from_camera
        assert camera is not None
        assert pose is not None
        border = _border(mesh.vertices, camera, pose)
        sight = pose[:3, 3] - corners.mean(1)
        distance = np.linalg.norm(sight, axis=1)
        cosine = (normals * sight).sum(1) / distance
        edge = border[mesh.faces].min(1)
        mine = np.flatnonzero((edge > 0) & (cosine > GRAZING))
        if len(mine):
            buffer = _DepthBuffer(vertices, faces, camera, pose, cell)
            seen, free = buffer.look(SAMPLES @ corners[mine])
            mine, free = mine[seen], free[seen]
            frontal = np.clip((smooth[mine] * sight[mine]).sum(1) / distance[mine], GRAZING, 1)
            worth = frontal**FRONTAL * camera.fx / distance[mine] * np.clip(RAMP * edge[mine], 0, 1)
            worth *= (BESIDE_EDGE + (1 - BESIDE_EDGE) * free) * np.clip(sharpness[i], 0.1, 1)
            _keep_best(found, mine, i, worth.astype(np.float32))
        if progress is not None:
            progress(i + 1, len(views))
    return found


def _smoothed(mesh: Mesh, across: Array, rounds: int = 2) -> Array:
    """Unit normals [F, 3] averaged over the faces around: a rough surface would take each face from elsewhere."""
    face = across
    for _ in range(rounds):
        at_vertex = np.stack(
            [np.bincount(mesh.faces.ravel(), np.repeat(face[:, axis], 3), len(mesh.vertices)) for axis in range(3)],
            axis=1,
        )
        face = at_vertex[mesh.faces].sum(1)
        face /= np.maximum(np.linalg.norm(face, axis=1, keepdims=True), 1e-300)
    return face


def _border(points: Array, camera: Camera, pose: Array) -> Array:
    """Distance of points [N, 3] from the image's border as a share of its sides; at most 0 where outside."""
    pixels, _ = project(points, camera, pose)
    size = np.array([camera.width, camera.height])
    with np.errstate(invalid="ignore"):
        inside = np.minimum(pixels - BORDER, size - BORDER - pixels) / size
    return np.nan_to_num(inside.min(1), nan=-1.0)


class _DepthBuffer:
    """What a camera sees of a mesh, drawn without its lens; ``cell`` is the side of the mesh's cells."""

    def __init__(self, vertices: torch.Tensor, faces: torch.Tensor, camera: Camera, pose: Array, cell: float) -> None:
        import cv2

        border = rays(border_pixels(camera), camera)[:, :2]
        border = border[np.isfinite(border).all(1)]  # a strong barrel has no rays at its corners
        self.low, self.cell = border.min(0), cell
        extent = border.max(0) - self.low
        self.focal, self.camera_from_world = BUFFER / extent.max(), invert(pose)
        width, height = (int(n) for n in np.ceil(extent * self.focal))
        x, y = -self.low * self.focal
        matrix = torch.tensor([[self.focal, 0, x], [0, self.focal, y], [0, 0, 1]], dtype=torch.float64)
        views = Views(matrix[None], torch.from_numpy(self.camera_from_world)[None], (width, height))
        points, screen, through = project_mesh(vertices, views)
        face = rasterise(screen, faces, views.size)
        _, depth = interpolate(points, torch.zeros(len(vertices), 1), faces, face, through)
        depths = depth[0].numpy()
        depths[face[0].numpy() < 0] = 3e38
        # A pixel's centre at the edge of a roof may see the roof where the point beside it is free.
        self.farthest = cv2.dilate(depths, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
        drawn = depths[depths < 3e38]
        hem = 2 * int(np.clip(cell * self.focal / np.median(drawn), *HEM)) + 1 if len(drawn) else 1
        self.nearest = cv2.erode(depths, np.ones((hem, hem), np.uint8), borderType=cv2.BORDER_REPLICATE)

    def look(self, points: Array) -> tuple[NDArray[np.bool_], Array]:
        """Of points [F, S, 3] of F faces: whether all are seen [F], and the share that stands free of edges [F]."""
        local = transform(self.camera_from_world, points)
        depth = local[..., 2]
        column, row = np.moveaxis((local[..., :2] / depth[..., None] - self.low) * self.focal, -1, 0)
        rows, columns = self.farthest.shape
        place = np.clip(row, 0, rows - 1).astype(np.int64) * columns + np.clip(column, 0, columns - 1).astype(np.int64)
        slack = SLACK * depth / self.focal
        seen = (depth <= self.farthest.ravel()[place] + slack).all(1)
        free = depth <= self.nearest.ravel()[place] + np.maximum(slack, STEP * self.cell)
        return seen, free.mean(1)


def _keep_best(found: Candidates, faces: NDArray[np.int64], photo: int, worth: NDArray[np.float32]) -> None:
    """Remember a photograph of some faces in place of their worst one, if it is better."""
    worst = found.worth[faces].argmin(1)
    better = worth > found.worth[faces, worst]
    faces, worst = faces[better], worst[better]
    found.photo[faces, worst], found.worth[faces, worst] = photo, worth[better]
