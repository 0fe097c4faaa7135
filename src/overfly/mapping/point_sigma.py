"""Standard deviation of points: what their errors were on rendered flights, told by what is known of each.

What a pair has matched is as exact as the surface around it is smooth: where depths scatter about a plane through
their neighbours there are leaves, edges and wrong matches, and what correlation promises (a quarter of a pixel of
disparity) means little. The constants are those of the 68.3 % quantile of errors on twelve rendered flights of all
styles and paths, 80 to 300 m high, with exact cameras (``benchmarks/sigma.py``).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from overfly.mapping.subpixel import Map

SIDE = 5
"""Pixels along the window in which roughness is measured."""

FEWEST = 8
"""Known depths that a window must hold."""

SMOOTHEST, ROUGHEST = 0.05, 3.0
"""Ground pixels: roughness below the first is that of the grid of disparities, beyond the second it says no more."""

ROUGHNESS_POWER = 0.87
MATCHED, CONFIRMED_BY_NONE, CORRELATED = 0.69, 0.32, -0.62
"""Logarithm of ground pixels; of what no other frame confirms; and of correlation 1."""

MOVED, MOVED_SURE = 2.31, -1.68
"""The same of a network's word that was moved to where images correlate, and of confidence 1."""

CARRIED_ON, DOUBT_POWER, SUREST = 0.006, 0.46, 0.85
"""Of the distance, for ground that is carried on into what one frame sees, by a power of the doubt left."""


def roughness(depth: Map, focal: float) -> NDArray[np.float32]:
    """How far depths scatter about a plane, ground pixels [H, W]: the standard deviation in a window of :data:`SIDE`.

    Args:
        depth: [H, W] metres, NaN where unknown; it is left out. Where fewer than :data:`FEWEST` are known the surface
            counts as rough.
        focal: pixels.
    """
    import cv2

    known = np.isfinite(depth)
    if not known.any():
        return np.full(depth.shape, ROUGHEST, np.float32)
    ramp = np.arange(SIDE, dtype=np.float64) - SIDE // 2
    weight = known.astype(np.float32)  # sums of small whole numbers are exact
    z = np.where(known, depth - np.median(depth[known]), 0).astype(np.float64)

    def total(values: NDArray, across: int = 0, down: int = 0) -> NDArray:
        """Of the window, weighted by powers of the distance from its middle."""
        return np.asarray(cv2.sepFilter2D(values, -1, ramp**across, ramp**down, borderType=cv2.BORDER_CONSTANT))

    n = np.maximum(total(weight), 1).astype(np.float64)
    x, y, mean = total(weight, 1) / n, total(weight, 0, 1) / n, total(z) / n
    xx, yy, xy = total(weight, 2) / n - x * x, total(weight, 0, 2) / n - y * y, total(weight, 1, 1) / n - x * y
    xz, yz = total(z, 1) / n - x * mean, total(z, 0, 1) / n - y * mean
    flat = np.maximum(xx * yy - xy * xy, 1e-9)
    explained = (xz * xz * yy - 2 * xz * yz * xy + yz * yz * xx) / flat
    variance = total(z * z) / n - mean * mean - explained
    with np.errstate(invalid="ignore"):
        rough = np.sqrt(np.maximum(variance, 0)) / depth * focal
    return np.where(known & (n >= FEWEST), rough, ROUGHEST).astype(np.float32)


def point_sigmas(
    rough: NDArray, agree: NDArray, score: NDArray, confidence: NDArray, word: NDArray, depth: NDArray, focal: float,
    *, second: NDArray[np.bool_], alone: NDArray[np.bool_], once: NDArray[np.bool_],
) -> NDArray[np.float32]:  # fmt: skip
    """Standard deviation [n] of points, metres.

    Args:
        rough: :func:`roughness` there.
        agree: other frames whose depth is the same.
        score: correlation of what was matched.
        confidence: of the point.
        word: standard deviation that the network gives its word, metres.
        depth: metres.
        focal: pixels.
        second: not matched by pairs, but a network's word that was moved to where images correlate, or the word itself.
        alone: the word itself.
        once: seen by one frame only.
    """
    surface = ROUGHNESS_POWER * np.log(SMOOTHEST + np.clip(rough, 0, ROUGHEST))
    matched = np.exp(MATCHED + surface + CONFIRMED_BY_NONE * (agree == 0) + CORRELATED * score)
    moved = np.exp(MOVED + surface + MOVED_SURE * confidence)
    carried_on = CARRIED_ON * depth * (1 - np.minimum(confidence, SUREST)) ** DOUBT_POWER
    sigma = np.where(second, moved, matched) * depth / focal
    sigma = np.where(alone, np.where(once, carried_on, word), sigma)
    return np.asarray(sigma, np.float32)
