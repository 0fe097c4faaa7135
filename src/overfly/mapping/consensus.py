"""One depth per pixel from several pairs: the hypothesis that most pairs support, averaged over its supporters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Map = NDArray[np.float32]


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
    best = np.zeros(shape, np.float32)
    depth, sigma = np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32)
    support = np.zeros(shape, np.uint8)
    weights = [np.where(np.isfinite(d), 1 / np.square(s), 0).astype(np.float32) for d, s in zip(depths, sigmas)]
    known = [np.nan_to_num(d) for d in depths]
    for i, (centre, spread) in enumerate(zip(depths, sigmas)):
        total, mean, count = weights[i].copy(), weights[i] * known[i], (weights[i] > 0).astype(np.uint8)
        for j, other in enumerate(depths):
            if i == j:
                continue
            with np.errstate(invalid="ignore"):
                agrees = np.abs(other - centre) < gates * np.hypot(spread, sigmas[j])
            w = np.where(agrees, weights[j], 0)
            total += w
            mean += w * known[j]
            count += agrees
        # More supporters win; among equals, the more precise ones.
        vote = count + total / (total + weights[i].max() + 1e-12)
        wins = (vote > best) & (count > 0)
        best[wins] = vote[wins]
        depth[wins] = mean[wins] / total[wins]
        sigma[wins] = 1 / np.sqrt(total[wins])
        support[wins] = count[wins]
    return depth, sigma, support
