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

RIGHT = 0.01
"""Share of the camera's height over the surface within which a height is right."""

AROUND = 4.0
"""Cells, standard deviation of the weights by which measured pixels around a place tell how level the land is there."""

BELIEF = (-0.83, -0.88, 3.16, -2.31)
"""Logit of the probability that a height is right: constant; times the logarithm of 1 + cells to the nearest measured
one; times the share of measured pixels around that are right on the plate; where something rises. Fitted by maximum
likelihood to 130 images of seven rendered flights: of what it gives up to 20, 40, 60, 80 and 100 %, there 13, 31, 50,
73 and 93 % are right. What the network thinks of its own word told nothing, or the reverse."""


def anchored(suggested: Map, measured: Map) -> tuple[Map, Map]:
    """Heights of a frame's pixels from a suggestion and measurements, and how sure they are.

    Args:
        suggested: [h, w], metres over the camera (negative below it), finite.
        measured: [h, w], the same, NaN where nothing is measured.

    Returns:
        heights [h, w]: a thin plate through the medians of the measured cells (Duchon 1977), and on it what the
        suggestion lets rise over its surroundings; and the probability [h, w] that they are right where nothing is
        measured. Where too little is measured the suggestion itself, as sure as what is far from everything.
    """
    import cv2
    from scipy.ndimage import distance_transform_edt

    h, w = suggested.shape
    size = max(1, round(max(h, w) / CELLS))
    medians, weights = _cells(measured, size)
    if not weights.any():
        nothing = BELIEF[0] + BELIEF[1] * np.log1p(CELLS)
        return suggested, np.full_like(suggested, 1 / (1 + np.exp(-nothing)))
    rows, columns = medians.shape
    plate = _plate(medians, weights).astype(np.float32)
    surface = cv2.resize(plate, (columns * size, rows * size), interpolation=cv2.INTER_CUBIC)[:h, :w]
    kernel = np.ones((SURROUNDINGS * size | 1,) * 2, np.uint8)
    ground = cv2.GaussianBlur(cv2.morphologyEx(suggested, cv2.MORPH_OPEN, kernel), (0, 0), size)
    rise = suggested - ground
    stands = rise > TALL * np.abs(surface)
    heights = surface + np.where(stands, SHRUNK * rise, 0)
    known = np.isfinite(measured).astype(np.float32)
    with np.errstate(invalid="ignore"):
        level = (np.abs(measured - surface) < RIGHT * np.abs(surface)).astype(np.float32)
    total, share = (cv2.GaussianBlur(part, (0, 0), AROUND * size) for part in (known, level))
    far = distance_transform_edt(weights == 0).astype(np.float32)
    far = cv2.resize(far, (columns * size, rows * size), interpolation=cv2.INTER_LINEAR)[:h, :w]
    logit = BELIEF[0] + BELIEF[1] * np.log1p(far) + BELIEF[2] * share / np.maximum(total, 1e-6) + BELIEF[3] * stands
    return heights.astype(np.float32), (1 / (1 + np.exp(-logit))).astype(np.float32)


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
