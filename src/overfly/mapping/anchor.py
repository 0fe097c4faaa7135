"""What one image alone suggests, laid on the surface that has been measured around it.

A network that sees a place once knows what stands on the ground, roughly, and not how high the ground is: where it was
followed, even with its mean error taken off, plain interpolation between the measured places was nearer to the truth.
So the measured surface is carried on smoothly, and only what rises clearly over its surroundings is taken from the
network, shrunk, since it is wrong as often as right.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Map = NDArray[np.float32]

CELLS = 30
"""Cells along the longer side, of which the measured median is taken: smaller than a block, larger than a house."""

SHARE = 0.4
"""Of a cell's pixels, this many must be measured for its median to count: roofs alone are no ground."""

BENDING, SLOPING = 1.0, 0.02
"""Weights of second and first differences between cells against a wholly measured cell."""

OUTLIER, ROUNDS = 0.005, 6
"""Share of the camera's height over the surface by which a cell may miss the plate at full weight, and how often cells
are weighed anew: a roof or a wood beside a gap says little of the ground in it."""

ABOVE = 4.0
"""How much more a cell over the plate is taken to miss it than one under it: what stands on the ground is over it. The
price: wrong cells below the ground pull it down; 15 % of them, 15 m too low, by 2.6 m."""

TALL = 0.05
"""Share of the camera's height over the surface by which something must rise over its surroundings to be believed."""

SHRUNK = 0.7
"""Part of its height that it gets: what is wrong half of the time is best told lower than it seems."""

SURROUNDINGS = 4
"""Cells across which what stands on the ground is told from the ground."""


def anchored(suggested: Map, measured: Map) -> Map:
    """Heights of a frame's pixels from a suggestion and measurements.

    Args:
        suggested: [h, w], metres over the camera (negative below it), finite.
        measured: [h, w], the same, NaN where nothing is measured.

    Returns:
        [h, w]: a thin plate through the medians of the measured cells (Duchon 1977), and on it what the suggestion lets
        rise over its surroundings; the suggestion itself where too little is measured.
    """
    import cv2

    h, w = suggested.shape
    size = max(1, round(max(h, w) / CELLS))
    medians, weights = _cells(measured, size)
    if not weights.any():
        return suggested
    rows, columns = medians.shape
    plate = _plate(medians, weights).astype(np.float32)
    surface = cv2.resize(plate, (columns * size, rows * size), interpolation=cv2.INTER_CUBIC)[:h, :w]
    kernel = np.ones((SURROUNDINGS * size | 1,) * 2, np.uint8)
    ground = cv2.GaussianBlur(cv2.morphologyEx(suggested, cv2.MORPH_OPEN, kernel), (0, 0), size)
    rise = suggested - ground
    return np.asarray(surface + np.where(rise > TALL * np.abs(surface), SHRUNK * rise, 0), np.float32)


def _cells(measured: Map, size: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Median and measured share of each cell; both 0 where too little is measured."""
    h, w = measured.shape
    rows, columns = -(-h // size), -(-w // size)
    medians, weights = np.zeros((rows, columns)), np.zeros((rows, columns))
    for row in range(rows):
        for column in range(columns):
            cell = measured[row * size : (row + 1) * size, column * size : (column + 1) * size]
            known = cell[np.isfinite(cell)]
            if len(known) >= SHARE * cell.size:
                medians[row, column], weights[row, column] = np.median(known), len(known) / cell.size
    return medians, weights


def _plate(medians: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """The thin plate [rows, columns] through weighted values; those that miss it weigh less (Huber), above sooner."""
    from scipy.sparse import csr_array, diags_array, eye_array, kron
    from scipy.sparse.linalg import spsolve

    def differences(n: int, order: int) -> Any:
        if n <= order:  # a strip of a picture
            return csr_array((0, n))
        pattern = {1: [-1.0, 1.0], 2: [1.0, -2.0, 1.0]}[order]
        return diags_array(pattern, offsets=list(range(order + 1)), shape=(n - order, n))

    def squared(down: Any, along: Any) -> Any:
        both = kron(down, along)
        return both.T @ both

    rows, columns = medians.shape
    stay = eye_array(rows), eye_array(columns)
    first, second = ((differences(rows, k), differences(columns, k)) for k in (1, 2))
    bending = squared(second[0], stay[1]) + squared(stay[0], second[1]) + 2 * squared(*first)
    sloping = squared(first[0], stay[1]) + squared(stay[0], first[1])
    stiff = BENDING * bending + SLOPING * sloping
    limit = OUTLIER * float(np.median(np.abs(medians[weights > 0])))
    w = weights
    for _ in range(ROUNDS):
        plate = spsolve((stiff + diags_array(w.ravel())).tocsc(), (w * medians).ravel()).reshape(rows, columns)
        over = medians - plate
        w = weights * limit / np.maximum(np.where(over > 0, ABOVE * over, -over), max(limit, 1e-9))
    return np.asarray(plate)
