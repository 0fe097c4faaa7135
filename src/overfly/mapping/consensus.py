"""One depth per pixel from several pairs: the hypothesis that most pairs support, averaged over its supporters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Map = NDArray[np.float32]

ROWS = 64
"""Rows worked on at once: all pairs of many maps take memory."""


def consensus(
    depths: Sequence[Map], sigmas: Sequence[Map], *, gates: float = 3.0
) -> tuple[Map, Map, NDArray[np.uint8]]:
    """Merge depth maps of one frame.

    Args:
        depths: each [H, W], metres, NaN where a pair knows nothing.
        sigmas: their standard deviations [H, W], metres.
        gates: two depths support each other within this many standard deviations of their difference.

    Returns:
        depth and sigma [H, W] (NaN where no pair knows anything), and the number of supporting pairs [H, W].
    """
    shape = depths[0].shape
    depth, sigma = np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32)
    support = np.zeros(shape, np.uint8)
    tops = [float(np.max(1 / np.square(s), initial=0, where=np.isfinite(d))) for d, s in zip(depths, sigmas)]
    for start in range(0, shape[0], ROWS):
        rows = slice(start, start + ROWS)
        band = [d[rows] for d in depths], [s[rows] for s in sigmas]
        depth[rows], sigma[rows], support[rows] = _of_rows(*band, tops, gates)
    return depth, sigma, support


def _of_rows(
    depths: Sequence[Map], sigmas: Sequence[Map], tops: Sequence[float], gates: float
) -> tuple[Map, Map, NDArray[np.uint8]]:
    """The consensus of some rows; ``tops`` are the largest weights of the whole maps."""
    shape = depths[0].shape
    best = np.zeros(shape, np.float32)
    depth, sigma = np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32)
    support = np.zeros(shape, np.uint8)
    weights = [np.where(np.isfinite(d), 1 / np.square(s), 0).astype(np.float32) for d, s in zip(depths, sigmas)]
    weighted = [w * np.nan_to_num(d) for w, d in zip(weights, depths)]
    gate = [np.float32(gates**2) * np.square(s) for s in sigmas]
    totals, means = [w.copy() for w in weights], [m.copy() for m in weighted]
    counts = [(w > 0).astype(np.uint8) for w in weights]
    for i in range(len(depths)):
        for j in range(i + 1, len(depths)):
            with np.errstate(invalid="ignore"):
                same = np.square(depths[j] - depths[i]) < gate[i] + gate[j]
            agrees = same.astype(np.float32)
            for one, other in ((i, j), (j, i)):
                totals[one] += weights[other] * agrees
                means[one] += weighted[other] * agrees
                counts[one] += same
    for top, total, mean, count in zip(tops, totals, means, counts):
        # More supporters win; among equals, the more precise ones.
        vote = count + total / (total + np.float32(top) + np.float32(1e-12))
        wins = (vote > best) & (count > 0)
        best[wins] = vote[wins]
        depth[wins] = mean[wins] / total[wins]
        sigma[wins] = 1 / np.sqrt(total[wins])
        support[wins] = count[wins]
    return depth, sigma, support
