"""One tile of the cloud from the points of all frames: one point per voxel, no strays, guesses only where needed.

Voxels and the larger cells of the filters are counted from the frame's origin, and a tile's borders are borders of all
of them: a point's fate depends on nothing but its neighbours, wherever tiles begin and end.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from overfly.cloud import Cloud, concatenate, voxel_thin

CROWD = 8
"""Voxels along a cell in which company is counted."""

FEWEST = 6
"""Points in a cell and its 26 neighbours, or they are stray."""

LEAST_CONFIDENT = 0.33
"""Points that no pair has matched are left out with less confidence. At 0.4 precision is up to 0.05 higher, at 0.25
recall; F-scores prefer the latter on rendered flights and the former on a real one."""

WALL = 128
"""Added to ``apart`` of points on walls that were not matched: their cells have a height, too, since the roof above a
wall is in its cell of the plan."""

WALL_VOXELS = 2
"""Voxels along a cube that holds at most one such point: frames place a wall a little apart."""

BLOCK = 120
"""Voxels: tiles begin and end at multiples, at which the filters' cells do, too."""

MARGIN = CROWD
"""Voxels around a tile whose matched points its filters must know."""


def thinned_tile(
    matched: Cloud, guesses: Cloud, apart: NDArray[np.uint8], size: float, low: NDArray, high: NDArray
) -> Cloud:
    """The finished points of a tile.

    Args:
        matched: all points that pairs have matched in the tile and :data:`MARGIN` voxels around it, in a fixed order.
        guesses: all other points, of the tile alone.
        apart: voxels [N] along the cell of the plan, divisors of :data:`BLOCK`, in which a matched point makes a guess
            needless; with :data:`WALL` those along a cube.
        size: side of a voxel.
        low, high: [2], the tile's first voxel and the one behind its last, multiples of :data:`BLOCK`.
    """
    first = matched[thinned(matched, size)]
    first = first[accompanied(first.points, size)]
    first = first[within(voxels(first.points, size), low, high)]
    on_wall = apart >= WALL
    others = _standing(guesses, np.flatnonzero(~on_wall), apart, size, size, [first.points])
    walls = _standing(
        guesses, np.flatnonzero(on_wall), apart, size, WALL_VOXELS * size, [first.points, guesses.points[others]]
    )
    return concatenate([first, guesses[others], guesses[walls]])


def _standing(
    guesses: Cloud,
    asked: NDArray[np.intp],
    apart: NDArray[np.uint8],
    size: float,
    cube: float,
    before: list[NDArray[np.float64]],
) -> NDArray[np.intp]:
    """Numbers of the guesses among those asked that stand, at most one in a cube, beside the points that do already."""
    assert guesses.confidence is not None
    chosen = asked[thinned(guesses[asked], cube)]
    chosen = chosen[guesses.confidence[chosen] >= LEAST_CONFIDENT]
    stand = np.zeros(len(chosen), bool)
    known = np.concatenate(before)
    for cells in np.unique(apart[chosen]):
        these = apart[chosen] == cells
        stand[these] = _elsewhere(guesses.points[chosen[these]], known, size, int(cells))
    return chosen[stand]


def within(at: NDArray[np.int64], low: NDArray, high: NDArray) -> NDArray[np.bool_]:
    """Which voxels [N, >=2] lie in a tile."""
    return np.asarray(((at[:, :2] >= low) & (at[:, :2] < high)).all(1))


def voxels(points: NDArray, size: float) -> NDArray[np.int64]:
    """The voxel [N, 3] of each point [N, 3]."""
    return np.floor(points / size).astype(np.int64)


def thinned(cloud: Cloud, size: float) -> NDArray[np.int64]:
    """Numbers of the most confident point of each voxel; the first of equals."""
    assert cloud.confidence is not None
    order = np.argsort(-cloud.confidence, kind="stable")
    return order[voxel_thin(cloud.points[order], size)] if len(cloud) else order


def accompanied(points: NDArray, size: float) -> NDArray[np.bool_]:
    """Points whose cell and its 26 neighbours hold enough others not to be stray."""
    if not len(points):
        return np.ones(0, bool)
    cells = voxels(points, size) // CROWD
    cells -= cells.min(0) - 1
    spans = cells.max(0) + 2
    if np.prod(spans, dtype=float) >= 2**62:  # the flat number would overflow: points at absurd distances
        cells = np.stack([_closed_up(c) for c in cells.T], axis=1)
        spans = cells.max(0) + 2
    flat = (cells[:, 0] * spans[1] + cells[:, 1]) * spans[2] + cells[:, 2]
    known, owner, counts = np.unique(flat, return_inverse=True, return_counts=True)
    around = np.zeros(len(known), np.int64)
    for dx, dy, dz in product((-1, 0, 1), repeat=3):
        beside = known + (dx * spans[1] + dy) * spans[2] + dz
        at = np.minimum(np.searchsorted(known, beside), len(known) - 1)
        around += np.where(known[at] == beside, counts[at], 0)
    return np.asarray(around[owner.reshape(-1)] >= FEWEST)


def _closed_up(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Whole numbers [N] with the gaps between them closed to one: who was beside whom stays so."""
    known, owner = np.unique(values, return_inverse=True)
    return np.asarray(np.concatenate([[1], 1 + np.cumsum(np.minimum(np.diff(known), 2))])[owner])


def _elsewhere(guesses: NDArray, matched: NDArray, size: float, apart: int) -> NDArray[np.bool_]:
    """Guessed points [N, 3] in whose cell of the plan nothing was matched: what is measured needs no guess."""
    if not len(guesses) or not len(matched):
        return np.ones(len(guesses), bool)
    axes = 3 if apart >= WALL else 2
    cells = [voxels(points[:, :axes], size) // (apart % WALL) for points in (guesses, matched)]
    low, high = cells[0].min(0), cells[0].max(0)
    near = cells[1][((cells[1] >= low) & (cells[1] <= high)).all(1)]
    spans = high - low + 1
    return ~np.isin(*(np.ravel_multi_index(tuple((c - low).T), tuple(spans)) for c in (cells[0], near)))
