"""How high and how low the surface is, as near pairs show it at low resolution: what pairs from far apart search."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from overfly.errors import Damaged
from overfly.files import load_arrays, save_arrays
from overfly.mapping.coarse import pair_points, small
from overfly.mapping.depth_ranges import BESIDE, Span
from overfly.mapping.neighbours import is_wide
from overfly.mapping.rectify import ordered, rectify, relief_of
from overfly.mapping.threads import in_threads
from overfly.mapping.views import Views

LOOKED_AT = 400
"""Longest side, pixels, of images that are looked at for the highest and the lowest of the surface."""

PIECE, OUTER = 150, 0.001
"""Pixels that hang together are believed there from so many on, and share of their heights at either end that is not:
what matches wrongly, as one pixel in a hundred does, lies far above or below in small pieces."""

ROOM = 0.03
"""Share of a frame's median depth that the surface may reach beyond what was seen of it."""


def narrowed(
    flight: Views,
    ranges: Sequence[Span],
    partners: Sequence[Sequence[int]],
    asked: Sequence[int],
    kept: Path,
    workers: int = 1,
) -> list[Span]:
    """The frames' ranges of heights, no wider than what pairs show of the surface at low resolution.

    Sparse points leave room for towers that they have missed. Near pairs search it; pairs that look from far apart
    would search hundreds of disparities for it, and find wrong ones.

    Args:
        ranges, partners: of n frames.
        asked: frames that have a wide partner; ranges of others, and of those of which nothing is seen or whose heights
            are not known at all, stay as they are.
        kept: file of what was found, for a run that goes on.
        workers: frames that are looked at side by side.
    """
    try:
        seen = load_arrays(kept)["heights"]
    except Damaged:
        seen = np.full((len(ranges), 2), np.nan)
        with in_threads(workers) as pool:
            looks = [pool.submit(_heights_seen, flight, ranges, i, partners[i]) for i in asked]
            seen[list(asked)] = [look.result() for look in looks]
        save_arrays(kept, {"heights": seen})
    centres = np.array([pose[:3, 3] for pose in flight.poses])
    looked = np.flatnonzero(np.isfinite(seen).all(1))
    found = list(ranges)
    for i in looked.tolist():
        span = ranges[i]
        if not np.isfinite([span.low, span.high]).all():
            continue
        away = np.linalg.norm(centres[looked] - centres[i], axis=1)
        beside = seen[looked[np.argsort(away, kind="stable")[:BESIDE]]]
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
    cameras, gray = [], []
    for k in pair:
        cameras.append(small(flight.matched_lens[k], LOOKED_AT))
        size = cameras[-1].width, cameras[-1].height
        gray.append(np.asarray(cv2.resize(flight.matched_gray(k), size, interpolation=cv2.INTER_AREA), np.uint8))
    lenses, poses = (cameras[0], cameras[1]), (flight.poses[pair[0]], flight.poses[pair[1]])
    here, there = (ranges[k] for k in pair)
    layout = rectify(lenses, poses, ((here.near, here.far), (there.near, there.far)), relief_of(here, there))
    if layout is None:
        return nothing
    points = pair_points((gray[0], gray[1]), lenses, poses, layout, piece=PIECE)
    if not len(points):
        return nothing
    low, high = np.quantile(points[:, 2], [OUTER, 1 - OUTER])
    return float(low), float(high)
