"""Between which depths and heights the surface lies in each frame, by surface points: where pairs may match it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from overfly.errors import InputError
from overfly.geometry import Array, Camera, pixel_grid, project, rays
from overfly.mapping.culling import Groups

STRAYS = 2.5
"""Points of a frame at either end that may be wrong: of few points half a per cent is none."""

AROUND, OFF_OTHERS = 8, 0.35
"""Nearest points in plan that a sparse point is compared with, none farther than the cameras are high; share of that
height that it may be off them."""

OUTER, BEYOND = 0.01, 0.5
"""Share of all points at either end in height that may be wrong together, where their neighbours are as wrong as they;
how far beyond the others, as a share of the cameras' height, they are left out."""

BESIDE = 24
"""Nearest frames that tell the usual depths where a frame's own are not known."""

UNDER, OVER = (0.3, 0.04), (0.3, 0.12)
"""Room below and above the points' heights, as shares of their range and of the median depth: key points are rare in
pits, on roofs and on tree tops."""


class Span(NamedTuple):
    """Where the surface lies in a frame, metres: depths along its axis and heights z, the outer ones with margins."""

    near: float
    middle: float
    far: float
    low: float
    ground: float
    high: float

    def floor(self, camera: Camera, world_from_camera: Array) -> NDArray[np.float32]:
        """Depth [H, W] in which each ray of an undistorted frame comes down to the lowest z; infinite if it does not.

        An oblique frame looks far at its top and near at its bottom: its range of depths alone reaches deep under the
        ground there, where wrong matches lie.
        """
        rise = rays(pixel_grid(camera.width, camera.height), camera) @ world_from_camera[2, :3]
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(rise < 0, (self.low - world_from_camera[2, 3]) / rise, np.inf).astype(np.float32)


def depth_ranges(cameras: Sequence[Camera], poses: Sequence[Array], points: Array) -> list[Span]:
    """Where the surface lies in each frame, with margins, from surface points [M, 3].

    Frames with too few points inside them take the depths that are usual in the frames beside them, and any height.
    """
    groups = Groups(points)
    found: list[Span | None] = []
    for camera, pose in zip(cameras, poses):
        near = groups.points[groups.near(camera, pose)]
        pixels, depth = project(near, camera, pose)
        with np.errstate(invalid="ignore"):
            inside = ((pixels > 0) & (pixels < [camera.width, camera.height])).all(1)
        if inside.sum() < 20:
            found.append(None)
            continue
        rare = max(0.005, STRAYS / int(inside.sum()))
        first, middle, last = np.quantile(depth[inside], [rare, 0.5, 1 - rare]).tolist()
        margin = 0.15 * (last - first) + 0.02 * middle
        bottom, ground, top = np.quantile(near[inside, 2], [rare, 0.5, 1 - rare]).tolist()
        under, over = (share * (top - bottom) + least * middle for share, least in (UNDER, OVER))
        low, high = bottom - under, top + over
        found.append(Span(max(first - 1.5 * margin, 0.05 * middle), middle, last + margin, low, ground, high))
    known = np.flatnonzero([f is not None for f in found])
    if not len(known):
        raise InputError(
            "The surface points lie outside all frames: the cameras and the points do not belong together."
        )
    centres = np.array([pose[:3, 3] for pose in poses])
    ranges = np.array([f for f in found if f is not None])
    settled = []
    for i, own in enumerate(found):
        if own is None:
            away = np.linalg.norm(centres[known] - centres[i], axis=1)
            usual = np.median(ranges[np.argsort(away, kind="stable")[:BESIDE]], axis=0).tolist()
            own = Span(*usual)._replace(low=-np.inf, high=np.inf)  # the land may fall or rise there
        settled.append(own)
    return settled


def beside_others(points: Array, centres: Array) -> NDArray[np.bool_]:
    """Which sparse points [m, 3], z up, have others around them, and are about as high: wrong matches lie far away.

    Args:
        points: they tell the depths that are looked for.
        centres: of the cameras [n, 3].
    """
    from scipy.spatial import cKDTree

    if len(points) <= AROUND:
        return np.ones(len(points), bool)
    height = abs(float(np.median(centres[:, 2]) - np.median(points[:, 2])))
    away, near = (np.asarray(found) for found in cKDTree(points[:, :2]).query(points[:, :2], k=AROUND + 1))
    off = np.abs(points[:, 2] - np.median(points[:, 2][near[:, 1:]], axis=1))
    low, high = np.quantile(points[:, 2], [OUTER, 1 - OUTER]) + BEYOND * height * np.array([-1, 1])
    usual = (points[:, 2] > low) & (points[:, 2] < high)
    return np.asarray(usual & (off < OFF_OTHERS * height) & (away[:, -1] < height))
