"""First looks at low resolution: at the ground where cameras are given without any points, and at how high and how low
the surface is where pairs look from far apart."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from overfly.errors import Damaged, InputError
from overfly.files import load_arrays, save_arrays
from overfly.flights import Frame
from overfly.geometry import Array, Camera, unproject
from overfly.mapping.depth_map import is_oblique
from overfly.mapping.depth_ranges import BESIDE as VICINITY
from overfly.mapping.depth_ranges import Span, beside_others
from overfly.mapping.matcher import UNKNOWN, depth_in_frame, disparities
from overfly.mapping.neighbours import is_wide
from overfly.mapping.rectify import Relief, ordered, rectify, relief_of
from overfly.mapping.views import Views

LOOKED_AT = 400
"""Longest side, pixels, of images that are looked at for the highest and the lowest of the surface."""

PIECE, OUTER = 150, 0.001
"""Pixels that hang together are believed there from so many on, and share of their heights at either end that is not:
what matches wrongly, as one pixel in a hundred does, lies far above or below in small pieces."""

ROOM = 0.03
"""Share of a frame's median depth that the surface may reach beyond what was seen of it."""

LONGEST_SIDE = 320
DRAWN = 200
"""Points of a pair."""

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
    cameras = [_small(f) for f in pair]
    baseline = float(np.linalg.norm(poses[0][:3, 3] - poses[1][:3, 3]))
    reach = cameras[0].fx * baseline / cameras[0].width
    span = (reach / 0.9, reach / 0.02)
    layout = rectify((cameras[0], cameras[1]), (poses[0], poses[1]), (span, span), relief)
    if layout is None:
        return None
    gray = [cv2.resize(_gray(f), (c.width, c.height), interpolation=cv2.INTER_AREA) for f, c in zip(pair, cameras)]
    match = disparities((gray[0], gray[1]), (cameras[0], cameras[1]), (poses[0], poses[1]), layout)
    if (match != UNKNOWN).mean() < 0.02:
        return None
    ideal = cameras[0].undistorted()
    depth = depth_in_frame(match, ideal, poses[0], layout, right=False)
    rows, columns = np.nonzero(np.isfinite(depth))
    if len(rows) < DRAWN:
        return None
    pick = rng.choice(len(rows), DRAWN, replace=False)
    rows, columns = rows[pick], columns[pick]
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


def _small(frame: Frame) -> Camera:
    assert frame.camera is not None
    factor = min(1.0, LONGEST_SIDE / max(frame.width, frame.height))
    return frame.camera.resized(round(frame.width * factor), round(frame.height * factor))


def _gray(frame: Frame) -> np.ndarray:
    import cv2

    return cv2.cvtColor(frame.image(), cv2.COLOR_RGB2GRAY)


def narrowed(flight: Views, ranges: Sequence[Span], partners: Sequence[Sequence[int]], kept: Path) -> list[Span]:
    """The frames' ranges of heights, no wider than what pairs show of the surface at low resolution.

    Sparse points leave room for towers that they have missed. Near pairs can afford it; pairs that look from far apart
    search hundreds of disparities for it, and find wrong ones.

    Args:
        ranges, partners: of n frames.
        kept: file of what was found, for a run that goes on.
    """
    try:
        seen = load_arrays(kept)["heights"]
    except Damaged:
        seen = np.array([_heights_seen(flight, ranges, i, list(partners[i])) for i in range(len(ranges))])
        save_arrays(kept, {"heights": seen})
    centres = np.array([pose[:3, 3] for pose in flight.poses])
    looked = np.flatnonzero(np.isfinite(seen).all(1))
    found = list(ranges)
    if not len(looked):
        return found
    for i, span in enumerate(ranges):
        away = np.linalg.norm(centres[looked] - centres[i], axis=1)
        beside = seen[looked[np.argsort(away, kind="stable")[:VICINITY]]]
        room = ROOM * span.middle
        low, high = max(span.low, float(beside[:, 0].min()) - room), min(span.high, float(beside[:, 1].max()) + room)
        found[i] = span._replace(low=min(low, span.ground), high=max(high, span.ground))
    return found


def _heights_seen(flight: Views, ranges: Sequence[Span], i: int, partners: Sequence[int]) -> tuple[float, float]:
    """The lowest and highest z that a frame and the best of its near partners show; NaN where there is none."""
    import cv2

    near = [j for j in partners if not is_wide(flight.full[i], flight.poses[i], ranges[i].middle, flight.poses[j])]
    nothing = float("nan"), float("nan")
    if not near:
        return nothing
    pair = (i, near[0]) if ordered((flight.poses[i], flight.poses[near[0]])) else (near[0], i)
    factor = min(1.0, LOOKED_AT / max(flight.matched[i].width, flight.matched[i].height))
    cameras, gray = [], []
    for k in pair:
        whole = flight.matched_lens[k]
        cameras.append(whole.resized(round(whole.width * factor), round(whole.height * factor)))
        size = cameras[-1].width, cameras[-1].height
        gray.append(np.asarray(cv2.resize(flight.matched_gray(k), size, interpolation=cv2.INTER_AREA), np.uint8))
    lenses, poses = (cameras[0], cameras[1]), (flight.poses[pair[0]], flight.poses[pair[1]])
    here, there = (ranges[k] for k in pair)
    layout = rectify(lenses, poses, ((here.near, here.far), (there.near, there.far)), relief_of(here, there))
    if layout is None:
        return nothing
    match = disparities((gray[0], gray[1]), lenses, poses, layout)
    cv2.filterSpeckles(match, int(UNKNOWN), PIECE, 32)
    ideal = lenses[0].undistorted()
    depth = depth_in_frame(match, ideal, poses[0], layout, right=False)
    rows, columns = np.nonzero(np.isfinite(depth))
    if len(rows) < DRAWN:
        return nothing
    points = unproject(np.stack([columns + 0.5, rows + 0.5], axis=1), depth[rows, columns], ideal, poses[0])
    low, high = np.quantile(points[:, 2], [OUTER, 1 - OUTER])
    return float(low), float(high)
