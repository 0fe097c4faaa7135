"""Which pairs of frames cannot see common ground, told by the pairs that were matched before."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from overfly.geometry import Array

Pair = tuple[int, int]

FEWEST_POINTS = 25
"""Common points from which on a pair tells how two frames lie."""

WORST_FIT = 0.1
"""Misfit with the median partner, as a share of the image's diagonal, up to which a frame is believed: oblique ones fit
worse."""

UNLIKE = 3.0
"""Frames whose pixels are so many times larger or smaller on the ground than usual ones are not believed."""

SAFETY = 1.2
"""Images are taken as so many times larger: GPS, relief and tilt move what they see."""


def cannot_overlap(
    pairs: Sequence[Pair],
    places: Array,
    sizes: Sequence[tuple[int, int]],
    matched: Mapping[Pair, tuple[NDArray, NDArray]],
) -> set[Pair]:
    """The pairs whose images lie beside each other on the ground.

    Frames that look straight down are laid on a plane around their positions, turned and scaled, such that common
    points fall together: complex least squares, linear in a factor per frame, from pixels to metres.

    Args:
        pairs: (i, j), i < j, that are asked about.
        places: [n, 2] positions, metres; NaN where unknown.
        sizes: width and height of n frames, pixels.
        matched: verified common points of pairs, pixels [m, 2] in either frame.
    """
    at = _plane(places)
    told = {
        pair: tuple((_plane(points) - _plane(sizes[k]) / 2).conj() for k, points in zip(pair, both, strict=True))
        for pair, both in matched.items()
        if len(both[0]) >= FEWEST_POINTS and np.isfinite(at[list(pair)]).all()
    }  # y points down in an image: the conjugate
    if not told:
        return set()
    factors = _factors(told, at)
    if not np.isfinite(list(factors.values())).all():  # copies of a photo, or a drone that hovered
        return set()
    misfits: dict[int, list[float]] = {}
    for (i, j), (a, b) in told.items():
        away = np.abs(at[i] + factors[i] * a - at[j] - factors[j] * b).mean()
        for k in (i, j):
            misfits.setdefault(k, []).append(float(away / np.abs(factors[k] * _plane(sizes[k]))))
    usual = float(np.median(np.abs(list(factors.values()))))
    believed = [
        k
        for k, found in misfits.items()
        if np.median(found) < WORST_FIT and usual / UNLIKE < abs(factors[k]) < usual * UNLIKE
    ]
    shown = {k: _outline(at[k], SAFETY * factors[k], sizes[k]) for k in believed}
    return {(i, j) for i, j in pairs if i in shown and j in shown and shown[i].disjoint(shown[j])}


def _plane(vectors: Any) -> Any:
    """Vectors [..., 2] as complex numbers."""
    return np.asarray(vectors, float) @ np.array([1, 1j])


def _factors(told: Mapping[Pair, Any], at: NDArray[np.complex128]) -> dict[int, complex]:
    """Metres per pixel and heading of each frame that has common points, as one complex number."""
    from scipy.sparse import coo_array
    from scipy.sparse.linalg import MatrixRankWarning, spsolve

    frames = sorted({k for pair in told for k in pair})
    column = {k: c for c, k in enumerate(frames)}
    rows, columns, values = [], [], []
    right = np.zeros(len(frames), complex)
    for (i, j), (a, b) in told.items():  # factor_i * a - factor_j * b = at_j - at_i
        p, q, away = column[i], column[j], at[j] - at[i]
        rows += [p, q, p, q]
        columns += [p, q, q, p]
        values += [np.vdot(a, a), np.vdot(b, b), -np.vdot(a, b), -np.vdot(b, a)]
        right[p] += np.vdot(a, np.full_like(a, away))
        right[q] -= np.vdot(b, np.full_like(b, away))
    normal = coo_array((values, (rows, columns)), shape=(len(frames), len(frames))).tocsc()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MatrixRankWarning)  # told by what comes out
        return dict(zip(frames, np.atleast_1d(spsolve(normal, right)).tolist(), strict=True))


def _outline(middle: complex, factor: complex, size: tuple[int, int]) -> shapely.Polygon:
    corners = middle + factor * _plane(np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * size) / 2
    return shapely.Polygon(np.column_stack([corners.real, corners.imag]))
