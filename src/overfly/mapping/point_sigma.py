"""Standard deviation of points: what their errors were on rendered flights, told by what is known of each.

What a pair has matched is as exact as the surface around it is smooth: where depths scatter about a plane through
their neighbours there are leaves, edges and wrong matches, and what correlation promises (a quarter of a pixel of
disparity) means little. The constants are those of the 68.3 % quantile of errors on twelve rendered flights of all
styles and paths, 80 to 300 m high, with exact cameras; heights were compared with the surface at the nearest place.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from overfly.mapping.subpixel import Map

SIDE = 5
"""Pixels along the window in which roughness is measured."""

SMOOTHEST, ROUGHEST = 0.05, 3.0
"""Ground pixels: roughness below the first is that of the grid of disparities, beyond the second it says no more."""

ROUGHNESS_POWER = 0.755
MATCHED, CONFIRMED_BY_NONE, CORRELATED = 0.69, 0.42, -0.74
"""Logarithm of ground pixels; of what no other frame confirms; and of correlation 1."""

MOVED, MOVED_SURE = 2.59, -2.34
"""The same of a network's word that was moved to where images correlate, and of confidence 1."""

CARRIED_ON, DOUBT_POWER, SUREST = 0.03, 2.37, 0.85
"""Of the distance, for ground that is carried on into what one frame sees, by a power of the doubt left."""

WORD = 0.61
"""Of the network's own standard deviation, for its word where several frames see the place."""


def roughness(depth: Map, focal: float) -> NDArray[np.float32]:
    """How far depths scatter about a plane, ground pixels [H, W]: the standard deviation in a window of :data:`SIDE`.

    Args:
        depth: [H, W] metres, NaN where unknown. Unknown neighbours count as lying at the others' mean.
        focal: pixels.
    """
    import cv2

    known = np.isfinite(depth)
    if not known.any():
        return np.zeros(depth.shape, np.float32)
    window, middle = (SIDE, SIDE), float(np.median(depth[known]))
    z = np.where(known, depth - middle, 0).astype(np.float64)
    share = cv2.boxFilter(known.astype(np.float64), -1, window)
    z = np.where(known, z, cv2.boxFilter(z, -1, window) / np.maximum(share, 1e-9))
    mean = cv2.boxFilter(z, -1, window)
    variance = cv2.boxFilter(z * z, -1, window) - mean * mean
    ramp = np.tile(np.arange(SIDE) - SIDE // 2, (SIDE, 1)).astype(np.float64)
    for slope in (ramp, ramp.T):  # what a plane explains
        variance -= cv2.filter2D(z, -1, slope / SIDE**2) ** 2 / np.mean(ramp**2)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(np.maximum(variance, 0)) / depth * focal, np.float32)


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
    sigma = np.where(alone, np.where(once, carried_on, WORD * word), sigma)
    return np.asarray(sigma, np.float32)
