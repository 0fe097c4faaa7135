"""Cells of north-up grids as points of the block's frame, such that a cell's numbers are the same in every window.

Windows of one surface must agree to the last bit. Coordinates are therefore counted from zero in whole cells, not from
the window's corner, and the map from the grid's CRS into the block's frame is an affine one per chunk of
:data:`CHUNK` x :data:`CHUNK` cells, laid out from zero too: over 256 cells of 0.3 m the curvature of the Earth leaves
0.1 mm. Exact where corners are multiples of the cell, as :func:`overfly.mapping.raster.grid_over` makes them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from numpy.typing import NDArray

from overfly.geodesy import Origin, enu_from_crs
from overfly.geometry import Array
from overfly.mapping.raster import Grid

Map = NDArray[np.float32]
Place = Callable[[Array], Array]
"""Grid coordinates x, y, z [N, 3] -> the block's frame [N, 3]."""

CHUNK = 256
STEP = 3.0
"""Neighbouring cells that differ in height by more than this many cells belong to two surfaces, with a wall between."""


def placing(origin: Origin | None) -> Place:
    """From ``origin``'s projected and vertical CRS to its local frame; the identity where there is none."""
    return (lambda points: points) if origin is None else (lambda points: enu_from_crs(points, origin))


def anchor(edge: float, cell: float) -> tuple[int, float]:
    """A grid's edge as whole cells from zero, and the rest in the grid's unit."""
    index = round(edge / cell)
    rest = edge - index * cell
    return index, 0.0 if abs(rest) < 1e-6 * cell else rest


@dataclass(frozen=True)
class Chunk:
    """A part of a grid with its own affine map: world = base + jacobian @ (x, y, z - level).

    Attributes:
        rows, columns: of the grid that was cut.
        x, y: [c], [r] coordinates of the cells' centres, from the chunk's middle.
        base, jacobian: [3], [3, 3] float64.
        level: height at which the map is exact.
    """

    rows: slice
    columns: slice
    x: NDArray
    y: NDArray
    base: Array
    jacobian: Array
    level: float

    def from_camera(self, world_from_camera: Array, x: Array, y: Array, z: Map) -> tuple[Map, Map, Map, Map]:
        """Camera coordinates of points, and how far they lie under the camera along the world's z; float32 each.

        ``x``, ``y`` from the chunk's middle and heights ``z`` must broadcast.
        """
        axes = np.vstack([world_from_camera[:3, :3].T, [0, 0, -1.0]])
        turn, start = axes @ self.jacobian, axes @ (self.base - world_from_camera[:3, 3])
        height = (z - np.float32(self.level)).astype(np.float32)
        east = [(s + t[0] * x).astype(np.float32) for s, t in zip(start, turn)]
        north = [(t[1] * y).astype(np.float32) for t in turn]
        a, b, c, d = (e + n + np.float32(t[2]) * height for e, n, t in zip(east, north, turn))
        return a, b, c, d

    @cached_property
    def outline(self) -> shapely.Geometry:
        """The polygon of its outer cells' centres in the world's x, y, at its level."""
        x, y = np.meshgrid(self.x[[0, -1]], self.y[[0, -1]])
        corners = self.base + np.stack([x.ravel(), y.ravel(), np.zeros(4)], axis=1) @ self.jacobian.T
        return shapely.MultiPoint(corners[:, :2]).convex_hull


def chunks(grid: Grid, place: Place, level: float) -> Iterator[Chunk]:
    """Cut a grid at multiples of :data:`CHUNK` cells from zero."""
    (left, rest_x), (top, rest_y) = anchor(grid.x_min, grid.cell), anchor(-grid.y_max, grid.cell)
    half, reach = CHUNK / 2, CHUNK / 2 * grid.cell
    around = np.vstack([np.zeros(3), reach * np.eye(3), -reach * np.eye(3)])
    for down in range(top // CHUNK, (top + grid.rows - 1) // CHUNK + 1):
        first, last = max(down * CHUNK, top), min((down + 1) * CHUNK, top + grid.rows)
        y = -(np.arange(first, last) + 0.5 - (down * CHUNK + half)) * grid.cell
        for right in range(left // CHUNK, (left + grid.columns - 1) // CHUNK + 1):
            begin, end = max(right * CHUNK, left), min((right + 1) * CHUNK, left + grid.columns)
            x = (np.arange(begin, end) + 0.5 - (right * CHUNK + half)) * grid.cell
            middle = [(right * CHUNK + half) * grid.cell + rest_x, -(down * CHUNK + half) * grid.cell - rest_y, level]
            world = place(middle + around)
            jacobian = ((world[1:4] - world[4:]) / (2 * reach)).T
            rows, columns = slice(first - top, last - top), slice(begin - left, end - left)
            yield Chunk(rows, columns, x, y, world[0], jacobian, level)


def on_finer(heights: NDArray, surface: Grid, grid: Grid) -> Map:
    """Heights [rows, columns] of a surface on another, usually finer grid; NaN where it is empty or ends.

    Bilinear within a surface, the nearest cell across steps of more than :data:`STEP` cells and beside empty cells, so
    that the edges of roofs stay sharp.
    """
    padded = np.pad(np.asarray(heights, np.float32), 1, constant_values=np.nan)
    i, v = _between(-grid.y_max, grid.cell, grid.rows, -surface.y_max, surface.cell, surface.rows)
    j, u = _between(grid.x_min, grid.cell, grid.columns, surface.x_min, surface.cell, surface.columns)
    quads = np.stack([padded[:-1, :-1], padded[:-1, 1:], padded[1:, :-1], padded[1:, 1:]])
    smooth = quads.max(0) - quads.min(0) <= np.float32(STEP * surface.cell)  # False where one is NaN
    upper = padded[i] + (padded[i + 1] - padded[i]) * v[:, None]
    left, right = upper.take(j, axis=1), upper.take(j + 1, axis=1)
    nearest = padded[i + (v >= 0.5)].take(j + (u >= 0.5), axis=1)
    return np.where(smooth[i].take(j, axis=1), left + (right - left) * u, nearest)


def _between(edge: float, cell: float, count: int, edge_s: float, cell_s: float, count_s: int) -> tuple[NDArray, Map]:
    """For each of ``count`` cells the index, into an axis padded by one, of the surface's cell before it; the share."""
    (first, rest), (first_s, rest_s) = anchor(edge, cell), anchor(edge_s, cell_s)
    at = ((np.arange(first, first + count) + 0.5) * cell + (rest - rest_s)) / cell_s - 0.5
    before = np.floor(at)
    index = before.astype(np.int64) - first_s + 1
    inside = (index >= 0) & (index <= count_s)
    share = np.where(inside, at - before, np.where(index < 0, 0, 1)).astype(np.float32)
    return np.clip(index, 0, count_s), share
