"""A first look at the ground where cameras are given without any points: few pairs at low resolution."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from overfly.errors import InputError
from overfly.flights import Frame
from overfly.geometry import Array, Camera, unproject
from overfly.mapping.depth_map import is_oblique
from overfly.mapping.depth_ranges import beside_others
from overfly.mapping.matcher import UNKNOWN, Image, depth_in_frame, disparities
from overfly.mapping.rectify import Rectified, Relief, ordered, rectify

LONGEST_SIDE = 320
DRAWN, LEAST_MATCHED = 200, 0.02
"""Points of a pair, and share of its canvas without which nothing is believed."""

PAIRS = 24
"""Frames of a short flight that are matched with their neighbours."""

APART = 8
"""In a long flight every so manieth is: its ground may lie high here and low there."""

BESIDE, ENOUGH, ROUNDS = 8, 6, 3
"""Nearest points of other pairs that a point is compared with, how many of them must be about as high, and how often
those that are not are taken away: pairs that look from two sides match half of their pixels wrongly, side by side."""

AROUND = 64
"""Nearest points of all pairs among which those of others are looked for."""

OFF = 0.15
"""Share of the cameras' height that those may be off."""

RELIEF, WITHIN = 0.5, 0.9
"""The same of how far the surface may rise over the usual ground, or fall below it, in the second look; the part of it
within which points are kept: what matches nowhere comes to lie at the ends."""


def coarse_points(frames: Sequence[Frame], *, seed: int) -> Array:
    """Points [M, 3] on the surface, some hundred of each of a few dozen pairs, from cameras and images alone.

    Disparities from 2 to 90 % of the image's width are searched. Oblique pairs are looked at once more, when the height
    of the ground is known: sheared by it they match better.

    Raises:
        InputError: no pair of neighbours shows the same ground.
    """
    poses = [np.asarray(frame.world_from_camera, float) for frame in frames]
    centres = np.array([pose[:3, 3] for pose in poses])
    pairs: list[tuple[int, int]] = []
    step = min(max(1, len(frames) // PAIRS), APART)
    for i in range(0, len(frames), step):
        near = np.argsort(np.linalg.norm(centres - centres[i], axis=1), kind="stable")
        others = [j for j in near.tolist() if j != i and np.any(centres[j] != centres[i])][:3]
        pairs += [(min(i, j), max(i, j)) for j in others]
    pairs = list(dict.fromkeys(pairs))
    rng = np.random.default_rng(seed)
    found = [_matched(frames[i], frames[j], None, rng) for i, j in pairs]
    points = _standing(found, centres)
    if not len(points):
        raise InputError(
            "No two neighbouring images match with these cameras: if they were given, check that they belong to these "
            "images, or map with --cameras estimate; if they were estimated, the images share too little ground: give "
            "sharp ones that overlap by 60 %."
        )
    ground, oblique = float(np.median(points[:, 2])), [is_oblique(pose) for pose in poses]
    if not any(oblique) or ground >= centres[:, 2].min():
        return points
    room = RELIEF * (float(np.median(centres[:, 2])) - ground)
    relief = Relief(ground - room, ground, ground + room)
    rng = np.random.default_rng(seed)
    found = [
        _matched(frames[i], frames[j], relief, rng) if oblique[i] or oblique[j] else level
        for (i, j), level in zip(pairs, found, strict=True)
    ]
    again = _standing(found, centres)
    again = again[np.abs(again[:, 2] - ground) < WITHIN * room]
    return again if len(again) >= DRAWN else points


def _standing(matched: Sequence[Array | None], centres: Array) -> Array:
    """Points [M, 3] of pairs that those of other pairs confirm; none where no pair matches."""
    found = [points for points in matched if points is not None]
    if not found:
        return np.zeros((0, 3))
    points = np.concatenate(found)
    height = abs(float(np.median(centres[:, 2]) - np.median(points[:, 2])))
    confirmed = _confirmed(points, np.repeat(np.arange(len(found)), DRAWN), OFF * height)
    if confirmed.sum() >= DRAWN:
        points = points[confirmed]
        return points[beside_others(points, centres)]
    # Of one pair or two: keep what lies among the others.
    away = np.abs(points[:, 2] - np.median(points[:, 2]))
    return np.asarray(points[away <= 6 * np.median(away) + 1e-6])


def _matched(first: Frame, second: Frame, relief: Relief | None, rng: np.random.Generator) -> Array | None:
    """Some points [DRAWN, 3] of two frames, None where too little matches."""
    import cv2

    pair = [first, second]
    poses = [np.asarray(f.world_from_camera, float) for f in pair]
    if not ordered((poses[0], poses[1])):
        pair, poses = pair[::-1], poses[::-1]
    cameras = [small(f.camera, LONGEST_SIDE) for f in pair if f.camera is not None]
    baseline = float(np.linalg.norm(poses[0][:3, 3] - poses[1][:3, 3]))
    reach = cameras[0].fx * baseline / cameras[0].width
    span = (reach / 0.9, reach / 0.02)
    layout = rectify((cameras[0], cameras[1]), (poses[0], poses[1]), (span, span), relief)
    if layout is None:
        return None
    gray = [cv2.resize(_gray(f), (c.width, c.height), interpolation=cv2.INTER_AREA) for f, c in zip(pair, cameras)]
    points = pair_points((gray[0], gray[1]), (cameras[0], cameras[1]), (poses[0], poses[1]), layout)
    return points[rng.choice(len(points), DRAWN, replace=False)] if len(points) >= DRAWN else None


def pair_points(
    gray: tuple[Image, Image],
    cameras: tuple[Camera, Camera],
    poses: tuple[Array, Array],
    layout: Rectified,
    *,
    piece: int = 0,
) -> Array:
    """What a rectified pair of small images matches, points [M, 3]; none where that is next to nothing.

    Args:
        gray, cameras, poses: of the two images, the left one first.
        piece: pixels that must hang together to count.
    """
    import cv2

    match = disparities(gray, cameras, poses, layout)
    if piece:
        cv2.filterSpeckles(match, int(UNKNOWN), piece, 32)
    if (match != UNKNOWN).mean() < LEAST_MATCHED:
        return np.zeros((0, 3))
    ideal = cameras[0].undistorted()
    depth = depth_in_frame(match, ideal, poses[0], layout, right=False)
    rows, columns = np.nonzero(np.isfinite(depth))
    return unproject(np.stack([columns + 0.5, rows + 0.5], axis=1), depth[rows, columns], ideal, poses[0])


def _confirmed(points: Array, pair: NDArray[np.intp], off: float) -> NDArray[np.bool_]:
    """Which points [M, 3] have points of other pairs [M] beside them, in plan, that are about as high."""
    from scipy.spatial import cKDTree

    left = np.arange(len(points))
    for _ in range(ROUNDS):
        if len(left) <= AROUND:
            return np.zeros(len(points), bool)
        _, beside = cKDTree(points[left, :2]).query(points[left, :2], k=AROUND)
        other = pair[left][beside] != pair[left, None]
        asked = other & (np.cumsum(other, axis=1) <= BESIDE)
        alike = np.abs(points[left, 2][beside] - points[left, 2, None]) < off
        left = left[(asked & alike).sum(1) >= ENOUGH]
    return np.isin(np.arange(len(points)), left)


def small(camera: Camera, longest: int) -> Camera:
    """The camera with so many pixels on its longest side, or as many as it has."""
    factor = min(1.0, longest / max(camera.width, camera.height))
    return camera.resized(round(camera.width * factor), round(camera.height * factor))


def _gray(frame: Frame) -> np.ndarray:
    import cv2

    return cv2.cvtColor(frame.image(), cv2.COLOR_RGB2GRAY)
