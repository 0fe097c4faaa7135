"""What one image alone suggests, laid on the surface that has been measured around it.

A network that sees a place once knows what stands on the ground, roughly, and not how high the ground is: where it was
followed, even with its mean error taken off, plain interpolation between the measured places was nearer to the truth.
So the measured surface is carried on smoothly, and of the network only the order is taken: how much rises over it what
looks as tall is seen where the same image is measured.

Not so in oblique images of which pairs match the ground and hardly roofs and walls, since they look from far apart:
what looks tall and was measured is mostly ground there (F-score at 1 m of blocks on circles with an image every 60 and
33 degrees 0.47 told by it, 0.50 without). Then only what rises clearly is taken from the network, shrunk, since it is
wrong as often as right.
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

TALL = (0.003, 0.007, 0.013, 0.02, 0.03, 0.04, 0.05, 0.067, 0.1)
"""Shares of the camera's height over the surface between which things look as tall as one another."""

FEWEST_SEEN = (100, 4)
"""Measured pixels that look so tall, and cells that they lie in, or what is measured tells nothing of such a height."""

MEASURED = 0.65
"""Share of what looks tall in an oblique image, and has a place in others, that must be measured to tell anything. On
circles with an image every 60 and 33 degrees 34 to 57 % are (suburb), with one every 25 and 35 degrees 80 to 93 %
(suburb) and 67 to 86 % (blocks: F-score at 1 m 0.797, told by it 0.803, precision 0.885 and 0.918)."""

BELIEVED, SHRUNK, ALIKE = 0.05, 0.7, (0.7, 0.0)
"""Where it tells nothing: the share of the camera's height that something must seem to rise to be believed, the part of
its height that it gets, and how much is taken to be as it seems: of what does not rise, and of what does."""

SURROUNDINGS = 4
"""Cells across which what stands on the ground is told from the ground."""

RIGHT = 0.01
"""Share of the camera's height over the surface within which a height is right."""

AROUND = 4.0
"""Cells, standard deviation of the weights by which measured pixels around a place tell how level the land is there."""

BELIEF = (-2.46, -0.55, 1.91, 3.13)
"""Logit of the probability that a height is right: constant; times the logarithm of 1 + cells to the nearest measured
one; times the share of measured pixels around that are right on the plate; times that of those that look as tall and
rise as much. Fitted by maximum likelihood to frames of ten rendered flights over four styles, before oblique images
were left out; what it gives there is right as docs/mapping.md says. What the network thinks
of its own word told nothing, or the reverse."""


def anchored(suggested: Map, measured: Map, asked: NDArray[np.bool_] | None = None) -> tuple[Map, Map]:
    """Heights of a frame's pixels from a suggestion and measurements, and how sure they are.

    Args:
        suggested: [h, w], metres over the camera (negative below it), finite.
        measured: [h, w], the same, NaN where nothing is measured.
        asked: [h, w] of an oblique image, pixels that others have inside: where little of what looks tall is measured
            there, it does not tell how much things rise.

    Returns:
        heights [h, w]: a thin plate through the medians of the measured cells (Duchon 1977), and on it what the
        suggestion lets rise over its surroundings, as high as what seems as tall is where it is measured; and the
        probability [h, w] that they are right where nothing is measured. Where too little is measured the suggestion
        itself, as sure as what is far from everything.
    """
    import cv2
    from scipy.ndimage import distance_transform_edt

    h, w = suggested.shape
    size = max(1, round(max(h, w) / CELLS))
    medians, weights = _cells(measured, size)
    if not weights.any():
        nothing = BELIEF[0] + BELIEF[1] * np.log1p(CELLS) + BELIEF[3] * ALIKE[1]
        return suggested, np.full_like(suggested, 1 / (1 + np.exp(-nothing)))
    rows, columns = medians.shape
    plate = _plate(medians, weights).astype(np.float32)
    surface = cv2.resize(plate, (columns * size, rows * size), interpolation=cv2.INTER_CUBIC)[:h, :w]
    kernel = np.ones((SURROUNDINGS * size | 1,) * 2, np.uint8)
    ground = cv2.GaussianBlur(cv2.morphologyEx(suggested, cv2.MORPH_OPEN, kernel), (0, 0), size)
    above = np.maximum(np.abs(surface), 1e-3)
    seeming, told = (suggested - ground) / above, (measured - surface) / above
    if asked is not None:
        tall = asked & (seeming > BELIEVED)
        if not tall.any() or np.isfinite(told[tall]).mean() < MEASURED:
            told = np.full_like(told, np.nan)
    rise, alike = _as_measured(seeming, told, size)
    heights = surface + rise * above
    known = np.isfinite(measured).astype(np.float32)
    with np.errstate(invalid="ignore"):
        level = (np.abs(measured - surface) < RIGHT * above).astype(np.float32)
    total, share = (cv2.GaussianBlur(part, (0, 0), AROUND * size) for part in (known, level))
    far = distance_transform_edt(weights == 0).astype(np.float32)
    far = cv2.resize(far, (columns * size, rows * size), interpolation=cv2.INTER_LINEAR)[:h, :w]
    logit = BELIEF[0] + BELIEF[1] * np.log1p(far) + BELIEF[2] * share / np.maximum(total, 1e-6) + BELIEF[3] * alike
    return heights.astype(np.float32), (1 / (1 + np.exp(-logit))).astype(np.float32)


def _as_measured(seeming: Map, true: Map, size: int) -> tuple[Map, Map]:
    """How much things rise, [h, w], and the share of measured pixels that look as tall and do so, to :data:`RIGHT`.

    Args:
        seeming: rise over the surroundings as suggested, in shares of the camera's height.
        true: as measured, NaN where nothing is.
        size: pixels along a cell.
    """
    kind = np.searchsorted(TALL, seeming)
    known = np.isfinite(true)
    rise = np.where(seeming > BELIEVED, SHRUNK * seeming, 0)
    alike = np.where(rise > 0, ALIKE[1], ALIKE[0])
    kinds, told = kind[known], true[known]
    row, column = (part // size for part in np.nonzero(known))
    cell = row * seeming.shape[1] + column
    for k in range(len(TALL) + 1):
        found = np.sort(told[kinds == k])
        if len(found) < FEWEST_SEEN[0] or len(np.unique(cell[kinds == k])) < FEWEST_SEEN[1]:
            continue
        within = np.searchsorted(found, found + 2 * RIGHT, side="right") - np.arange(len(found))
        first = int(within.argmax())
        rise[kind == k] = np.median(found[first : first + within[first]])  # of the densest group: roofs are alike
        alike[kind == k] = within[first] / len(found)
    return rise.astype(np.float32), alike.astype(np.float32)


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
