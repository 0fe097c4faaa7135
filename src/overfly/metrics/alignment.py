"""Laying one cloud upon another before they are compared: always explicit, and the transform is always reported.

The search is the ICP of ``icp.py`` from several starts. The starts come from height maps: aerial
clouds of one place differ by metres in height (barometer, geoid) and in plan (GPS), which nearest neighbours alone do
not bridge. Everything is deterministic.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from overfly.errors import unknown
from overfly.geometry import transform
from overfly.metrics.functional import as_points
from overfly.metrics.icp import KEPT, Pair, thin

Array = NDArray[np.float64]

MODES = ("none", "shift", "rigid", "similarity")
"""Nothing; a translation; and a rotation; and a scale."""

TURNS_DEG = (-12.0, -8.0, -4.0, 0.0, 4.0, 8.0, 12.0)
"""Headings from which ``rigid`` and ``similarity`` start."""

COARSE_POINTS, SCALE_POINTS, FINE_POINTS = 6_000, 20_000, 80_000


def align(cloud: Any, reference: Any, mode: str) -> tuple[Array, Array]:
    """Lay ``cloud`` upon ``reference``.

    ``shift`` bridges offsets of about a quarter of the extent, or any offset if the clouds do not overlap at all.
    ``rigid`` and ``similarity`` start from that shift and correct headings of about 15 degrees, tilts of a few degrees
    and scales of a few per cent: a cloud without GPS, in a frame of its own, has to be brought near its place first.

    Args:
        cloud, reference: points [N, 3] and [M, 3].
        mode: one of ``MODES``.

    Returns:
        The transform reference-from-cloud [4, 4] and the transformed points [N, 3].

    Raises:
        InputError: the mode is unknown, or a cloud is empty, of another shape or not finite.
    """
    if mode not in MODES:
        raise unknown("The alignment", mode, MODES)
    points, target = as_points(cloud, "The cloud"), as_points(reference, "The reference")
    if mode == "none":
        return np.eye(4), points.copy()
    centre = np.round(np.median(target, axis=0))  # rotations about a far origin would lose digits
    found = _align(points - centre, target - centre, mode)
    away, back = np.eye(4), np.eye(4)
    away[:3, 3], back[:3, 3] = -centre, centre
    matrix = back @ found @ away
    return matrix, transform(found, points - centre) + centre


def _align(points: Array, target: Array, mode: str) -> Array:
    points, target = thin(points, FINE_POINTS), thin(target, FINE_POINTS)
    coarse = Pair.thinned(points, target, COARSE_POINTS)
    tried = []
    for turn in [0.0] if mode == "shift" else TURNS_DEG:
        turned = np.eye(4)
        turned[:3, :3] = Rotation.from_euler("z", turn, degrees=True).as_matrix()
        # The shift comes first in every mode: a rotation must not make up for a wrong start.
        found = starts(transform(turned, points), target)
        tried += [coarse.refine(start @ turned, "shift", 10) for start in found]
    promising = sorted(tried, key=coarse.misfit)[:3]
    rigid = "shift" if mode == "shift" else "rigid"
    best = min((coarse.refine(start, rigid, 60) for start in promising), key=coarse.misfit)
    fine = Pair.thinned(points, target, FINE_POINTS)
    if mode != "similarity":
        return fine.refine(best, mode, 40)
    return _scaled(Pair.thinned(points, target, SCALE_POINTS), fine, best)


def _scaled(middle: Pair, fine: Pair, rigid: Array) -> Array:
    """The similarity of the smallest misfit, from a rigid start.

    Planes hold the scale of a flat, noisy cloud badly: every shrinking makes its noise smaller (the sparse cloud of a
    park ended at 0.94). The distances from the reference back to the cloud hold it, so they judge: between the free
    fit, and the minimum of a parabola through the misfits of fixed scales about the better one.
    """
    tried = [fine.refine(rigid, "rigid", 40), fine.refine(middle.refine(rigid, "similarity", 60), "similarity", 40)]
    best = min(tried, key=fine.misfit)
    centre = transform(best, middle.points).mean(0)

    def at_scale(factor: float) -> Array:
        fixed = np.eye(4) * [factor, factor, factor, 1]
        fixed[:3, 3] = centre * (1 - factor)
        return middle.refine(fixed @ best, "rigid", 15)

    factors = np.linspace(0.97, 1.03, 7)
    curve = np.polyfit(factors - 1, [middle.misfit(at_scale(factor)) for factor in factors], 2)
    if curve[0] > 0 and abs(lowest := -curve[1] / (2 * curve[0])) < 0.03:
        tried.append(fine.refine(at_scale(1 + lowest), "rigid", 40))
    return min(tried, key=fine.misfit)


def starts(points: Array, target: Array) -> list[Array]:
    """Candidate translations [4, 4]: as it is (or centre on centre), and by height maps of two resolutions."""
    extent = float(np.ptp(target[:, :2], axis=0).max())
    low, high = target.min(0), target.max(0)
    overlapping = (points[:, :2].min(0) < high[:2]).all() and (points[:, :2].max(0) > low[:2]).all()
    first = np.zeros(3) if overlapping else (low + high) / 2 - (points.min(0) + points.max(0)) / 2
    shifts = [first]
    if extent > 0:
        rough = _by_heights(points, target, first, extent / 32, 8)
        shifts += [_by_heights(points, target, start, extent / 128, 6) for start in (first, rough)]
    different = np.unique(np.round(shifts, 6), axis=0)  # both resolutions often agree
    matrices = np.tile(np.eye(4), (len(different), 1, 1))
    matrices[:, :3, 3] = different
    return list(matrices)


def _by_heights(points: Array, target: Array, start: Array, cell: float, reach: int) -> Array:
    """The shift within ``reach`` cells of ``start`` in plan under which two height maps agree best, with its height."""
    low = target[:, :2].min(0)
    size = np.ceil(np.ptp(target[:, :2], axis=0) / cell).astype(int) + 1
    wanted = _height_map(target, low, cell, size)
    given = _height_map(points + start, low - reach * cell, cell, size + 2 * reach)
    needed = 0.5 * np.isfinite(wanted).sum()  # half of the reference has to be covered, or as much as ever is
    covers, scores, heights, steps = [], [], [], []
    for i in range(2 * reach + 1):
        for j in range(2 * reach + 1):
            difference = wanted - given[i : i + size[0], j : j + size[1]]
            difference = difference[np.isfinite(difference)]
            if not difference.size:
                continue
            height = float(np.median(difference))
            residual = np.sort(np.abs(difference - height))[: max(1, int(KEPT * difference.size))]
            covers.append(difference.size)
            scores.append(residual.mean())
            heights.append(height)
            steps.append((reach - i, reach - j))
    if not covers:
        return start
    enough = np.array(covers) >= min(needed, 0.8 * max(covers))
    best = int(np.argmin(np.where(enough, scores, np.inf)))
    return start + np.array([steps[best][0] * cell, steps[best][1] * cell, heights[best]])


def _height_map(points: Array, low: Array, cell: float, size: NDArray[np.int64]) -> Array:
    """Mean height of the points in each square cell [size], NaN where there are none."""
    index = np.floor((points[:, :2] - low) / cell).astype(np.int64)
    inside = ((index >= 0) & (index < size)).all(axis=1)
    flat = index[inside, 0] * size[1] + index[inside, 1]
    count = np.bincount(flat, minlength=size[0] * size[1])
    total = np.bincount(flat, points[inside, 2], minlength=size[0] * size[1])
    with np.errstate(invalid="ignore"):
        return (total / np.where(count, count, np.nan)).reshape(size[0], size[1])
