"""What one image alone suggests, moved so that it meets what has been measured around it.

A network that sees a place once knows what stands on the ground better than how high the ground is: roofs from lawns,
but not a slope. Measured ground beside it tells the slope, and where the network tends to err.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Map = NDArray[np.float32]

CELLS = 24
"""Cells along the longer side in which the difference is taken: smaller than a block, larger than a house."""

SHARE = 0.15
"""Of a cell's pixels, this many must be measured for its median to count."""

REACHES = (1.0, 3.0, 9.0)
"""Standard deviations of the smoothing, cells: near cells decide, far ones where there are no near ones."""


def anchored(suggested: Map, measured: Map) -> Map:
    """Heights of a frame's pixels from a suggestion and measurements.

    Args:
        suggested: [h, w], metres, NaN where nothing is suggested.
        measured: [h, w], metres, NaN where nothing is measured.

    Returns:
        [h, w]: the suggestion plus the smooth part of what the measurements differ from it by, which is carried on
        beyond them; the suggestion itself where nothing at all is measured.
    """
    import cv2
    from scipy.ndimage import gaussian_filter

    h, w = suggested.shape
    size = max(1, round(max(h, w) / CELLS))
    rows, columns = -(-h // size), -(-w // size)
    medians, weights = np.zeros((rows, columns)), np.zeros((rows, columns))
    difference = measured - suggested
    for row in range(rows):
        for column in range(columns):
            cell = difference[row * size : (row + 1) * size, column * size : (column + 1) * size]
            known = cell[np.isfinite(cell)]
            if len(known) >= SHARE * cell.size:
                medians[row, column], weights[row, column] = np.median(known), len(known) / cell.size
    if not weights.any():
        return suggested
    total, weight = np.zeros_like(medians), np.zeros_like(medians)
    for k, reach in enumerate(REACHES):
        share = 0.03**k
        total += share * gaussian_filter(weights * medians, reach, mode="constant")
        weight += share * gaussian_filter(weights, reach, mode="constant")
    everywhere = (weights * medians).sum() / weights.sum()
    field: NDArray = (total + 1e-6 * everywhere) / (weight + 1e-6)
    wide = cv2.resize(field.astype(np.float32), (columns * size, rows * size), interpolation=cv2.INTER_LINEAR)
    return suggested + wide[:h, :w]
