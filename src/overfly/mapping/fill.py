"""Colours for the few cells of a surface that no photograph sees: strips at the feet of walls, gaps in crowns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from overfly.mapping.lattice import Map

FILL = 8
"""Cells that a colour is carried on, each from surely seen cells, from any, and into pits and spikes."""

FILLED = 254
"""Alpha of cells that no photograph sees: opaque to the eye, yet told from photographed (255) and empty ones (0)."""

SURE = 0.02
"""Worth up to which a frame may well show the edge of what hides the cell instead of the cell."""


def fill(rgb: NDArray[np.uint8], worth: Map, heights: Map, step: np.float32) -> NDArray[np.bool_]:
    """Give cells of the surface that no frame sees the mean colour of their neighbours at like height.

    Surely seen cells come first; their colours find their way over unsure ones, which are not altered themselves. Pits
    and spikes, at most twice :data:`FILL` cells wide and high, that nothing of like height surrounds take the colour of
    what does; larger places stay blank farther in.

    Args:
        rgb: [3, rows, columns], altered in place.
        worth: [rows, columns], of the best frame; 0 where none sees the cell.
        heights: [rows, columns], NaN where empty.
        step: difference of heights between two surfaces.

    Returns:
        The cells that were given a colour [rows, columns].
    """
    import cv2

    unseen = (worth == 0) & np.isfinite(heights)
    near = cv2.dilate(unseen.astype(np.uint8), np.ones((2 * FILL + 1, 2 * FILL + 1), np.uint8)) > 0
    open_ = near & (worth < SURE) & np.isfinite(heights)
    open_[[0, -1]] = open_[:, [0, -1]] = False
    source, known = rgb.copy(), (worth > 0) & ~open_
    _carry(source, known, heights, open_, step)
    doubtful = (worth > 0) & ~known
    known |= doubtful
    _carry(source, known, heights, unseen & ~known & open_, step)
    _carry(source, known, heights, _small(unseen) & ~known & open_, np.float32(np.inf))
    filled = unseen & known
    np.copyto(rgb, source, where=filled)
    return filled


def _small(blank: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The connected pieces [rows, columns] that are at most twice :data:`FILL` cells wide and high."""
    import cv2

    _, labels, stats, _ = cv2.connectedComponentsWithStats(blank.astype(np.uint8), connectivity=8)
    small = np.maximum(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT]) <= 2 * FILL
    return blank & small[labels]


def _carry(
    rgb: NDArray[np.uint8], known: NDArray[np.bool_], heights: Map, blank: NDArray[np.bool_], step: np.float32
) -> None:
    """Colour blank cells, none at the border, from known ones, :data:`FILL` cells far; in place, with ``known``."""
    columns = heights.shape[1]
    colors, sure, z = rgb.reshape(3, -1), known.reshape(-1), heights.reshape(-1)
    left = np.flatnonzero(blank)
    around = [down * columns + right for down in (-1, 0, 1) for right in (-1, 0, 1) if down or right]
    for _ in range(FILL):
        total, count = np.zeros((3, len(left)), np.int64), np.zeros(len(left), np.int64)
        for beside in around:
            other = left + beside
            with np.errstate(invalid="ignore"):
                good = sure[other] & (np.abs(z[other] - z[left]) <= step)
            total[:, good] += colors[:, other[good]]
            count += good
        found = count > 0
        colors[:, left[found]] = (total[:, found] + count[found] // 2) // count[found]
        sure[left[found]] = True
        left = left[~found]
