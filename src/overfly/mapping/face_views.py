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
from overfly.mapping.rough_mesh import cell_of
from overfly.mapping.visibility import View
from overfly.mesh import Mesh
from overfly.rendering.operations import interpolate, rasterise
from overfly.rendering.render import NEAR

CANDIDATES = 8
"""Photographs remembered of each face, the best ones."""

BUFFER = 1024
"""Longest side of a depth buffer, pixels."""

SLACK = 3.0
"""A point is hidden that lies more than this many buffer pixels, on the ground, behind what is seen."""

HEM, LEAST, MOST = 1.5, 2, 20
"""Cells of the mesh around a point, and least and most buffer pixels, in which nothing should stand before it: edges of
roofs are off by as much, and a photograph that sees a face close behind one may show the roof there."""

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

NOTHING = np.float32(3e38)
"""Depth where there is no surface."""

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
    faces = np.asarray(mesh.faces, np.int32)
    corners = mesh.vertices[faces]  # [F, 3, 3]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)
    smooth, middle = _smoothed(mesh, across), corners.mean(1)
    cell = cell_of(mesh)
    found = Candidates(np.full((len(faces), CANDIDATES), -1, np.int32), np.zeros((len(faces), CANDIDATES), np.float32))
    for i, view in enumerate(views):
        camera, pose = view.camera, view.world_from_camera
        assert camera is not None
        assert pose is not None
        plane = _Plane(camera, pose)
        local = transform(plane.camera_from_world, mesh.vertices)
        near = plane.touched(local, faces)
        sight = pose[:3, 3] - middle[near]
        distance = np.linalg.norm(sight, axis=1)
        edge = _border(mesh.vertices[faces[near]], camera, pose)
        front = (edge > 0) & ((normals[near] * sight).sum(1) > GRAZING * distance)
        if front.any():
            mine, sight, distance, edge = near[front], sight[front], distance[front], edge[front]
            seen, free = plane.drawn(local, faces[near], cell).look(SAMPLES @ corners[mine])
            frontal = np.clip((smooth[mine] * sight).sum(1) / distance, GRAZING, 1)
            worth = frontal**FRONTAL * camera.fx / distance * np.clip(RAMP * edge, 0, 1)
            worth *= (BESIDE_EDGE + (1 - BESIDE_EDGE) * free) * np.clip(sharpness[i], 0.1, 1)
            _keep_best(found, mine[seen], i, worth[seen].astype(np.float32))
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


def _border(corners: Array, camera: Camera, pose: Array) -> Array:
    """Distance of faces [F, 3, 3] from the image's border as a share of its sides [F]; at most 0 where outside."""
    pixels, _ = project(corners, camera, pose)
    size = np.array([camera.width, camera.height])
    with np.errstate(invalid="ignore"):
        inside = np.minimum(pixels - BORDER, size - BORDER - pixels) / size
    return np.nan_to_num(inside.min((1, 2)), nan=-1.0)


class _Plane:
    """The ideal image plane of a camera, in pixels of a depth buffer: all that the image shows, without its lens."""

    def __init__(self, camera: Camera, pose: Array) -> None:
        border = rays(border_pixels(camera), camera)[:, :2]
        border = border[np.isfinite(border).all(1)]  # a strong barrel has no rays at its corners
        self.low = border.min(0)
        extent = border.max(0) - self.low
        self.focal, self.camera_from_world = BUFFER / extent.max(), invert(pose)
        self.width, self.height = (int(n) for n in np.ceil(extent * self.focal))

    def pixels(self, local: Array) -> Array:
        """Column and row [..., 2] of points in camera axes [..., 3]; NaN nearer than :data:`NEAR`."""
        depth = np.where(local[..., 2:] >= NEAR, local[..., 2:], np.nan)
        return np.asarray((local[..., :2] / depth - self.low) * self.focal)

    def touched(self, local: Array, faces: NDArray[np.int32]) -> NDArray[np.int64]:
        """The faces of which the plane may show a part; vertices [V, 3] in camera axes."""
        at = self.pixels(local)
        beyond = np.stack([at[:, 0] >= 0, at[:, 1] >= 0, at[:, 0] < self.width, at[:, 1] < self.height], axis=1)
        return np.flatnonzero((beyond[faces[:, 0]] | beyond[faces[:, 1]] | beyond[faces[:, 2]]).all(1))

    def drawn(self, local: Array, faces: NDArray[np.int32], cell: float) -> _DepthBuffer:
        """The depth buffer of faces [F, 3] over vertices [V, 3] in camera axes; ``cell``: side of the mesh's cells."""
        at = self.pixels(local)
        screen = np.nan_to_num(np.column_stack([at, 1 / local[:, 2]]) * np.isfinite(at[:, :1]))
        x, y = (
            (np.arange(n) + 0.5) / self.focal + low for n, low in zip((self.width, self.height), self.low, strict=True)
        )
        points, triangles = torch.from_numpy(local)[None], torch.from_numpy(faces)
        face = rasterise(torch.from_numpy(screen)[None], triangles, (self.width, self.height))
        through = torch.from_numpy(x)[None], torch.from_numpy(y)[None]
        _, depth = interpolate(points, torch.zeros(len(local), 1), triangles, face, through)
        depths = np.where(face[0].numpy() >= 0, depth[0].numpy(), NOTHING)
        return _DepthBuffer(self, depths.astype(np.float32), cell)


class _DepthBuffer:
    """Depths [rows, columns] of what a plane shows, :data:`NOTHING` where it shows nothing."""

    def __init__(self, plane: _Plane, depths: NDArray[np.float32], cell: float) -> None:
        import cv2

        self.plane, self.cell = plane, cell
        # A pixel's centre at the edge of a roof may see the roof where the point beside it is free.
        self.farthest = cv2.dilate(depths, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
        shown = depths[depths < NOTHING]
        hem = 2 * int(np.clip(HEM * cell * plane.focal / np.median(shown), LEAST, MOST)) + 1 if len(shown) else 1
        self.nearest = cv2.erode(depths, np.ones((hem, hem), np.uint8), borderType=cv2.BORDER_REPLICATE)

    def look(self, points: Array) -> tuple[NDArray[np.bool_], Array]:
        """Of points [F, S, 3] of F faces: whether all are seen [F], and the share that stands free of edges [F]."""
        local = transform(self.plane.camera_from_world, points)
        depth, (column, row) = local[..., 2], np.moveaxis(self.plane.pixels(local), -1, 0)
        rows, columns = self.farthest.shape
        place = np.clip(row, 0, rows - 1).astype(np.int64) * columns + np.clip(column, 0, columns - 1).astype(np.int64)
        slack = SLACK * depth / self.plane.focal
        seen = (depth <= self.farthest.ravel()[place] + slack).all(1)
        free = depth <= self.nearest.ravel()[place] + np.maximum(slack, STEP * self.cell)
        return seen, free.mean(1)


def _keep_best(found: Candidates, faces: NDArray[np.int64], photo: int, worth: NDArray[np.float32]) -> None:
    """Remember a photograph of some faces in place of their worst one, if it is better."""
    worst = found.worth[faces].argmin(1)
    better = worth > found.worth[faces, worst]
    faces, worst = faces[better], worst[better]
    found.photo[faces, worst], found.worth[faces, worst] = photo, worth[better]
