"""A point cloud on a north-up grid: the surface seen from above, with height, colour and any attribute per cell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from overfly.cloud import Cloud

LAYER = 3.0
"""Points less than this many cells under a cell's highest one belong to the surface seen from above."""


@dataclass(frozen=True)
class Grid:
    """A north-up grid: row 0 is the north edge. Lengths in the unit of the cloud (metres where it is metric).

    Attributes:
        x_min, y_max: the north-west corner.
        cell: side of a cell.
        rows, columns: size.
    """

    x_min: float
    y_max: float
    cell: float
    rows: int
    columns: int

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """x_min, x_max, y_min, y_max."""
        return (
            self.x_min,
            self.x_min + self.columns * self.cell,
            self.y_max - self.rows * self.cell,
            self.y_max,
        )

    def cells(self, points: ArrayLike) -> NDArray[np.int64]:
        """Flat cell index of x, y in points [N, >=2]; -1 outside [N]."""
        xy = np.asarray(points)[:, :2]
        column = np.floor((xy[:, 0] - self.x_min) / self.cell).astype(np.int64)
        row = np.floor((self.y_max - xy[:, 1]) / self.cell).astype(np.int64)
        inside = (column >= 0) & (column < self.columns) & (row >= 0) & (row < self.rows)
        return np.where(inside, row * self.columns + column, -1)

    def hit(self, *points: ArrayLike) -> int:
        """Number of cells that hold at least one of the points, each [N, >=2]."""
        if self.rows * self.columns > 100_000_000:  # marks would fill the memory
            found = np.unique(np.concatenate([np.unique(self.cells(p)) for p in points]))
            return int(np.count_nonzero(found >= 0))
        marks = np.zeros(self.rows * self.columns + 1, bool)
        for some in points:
            marks[self.cells(some)] = True  # -1, outside, marks the spare last one
        return int(np.count_nonzero(marks[:-1]))

    def centres(self) -> NDArray[np.float64]:
        """x, y of all cell centres [rows, columns, 2]."""
        x = self.x_min + (np.arange(self.columns) + 0.5) * self.cell
        y = self.y_max - (np.arange(self.rows) + 0.5) * self.cell
        return np.stack(np.meshgrid(x, y), axis=-1)


def grid_over(points: ArrayLike, cell: float, *, trim: float = 0.0) -> Grid:
    """The grid that covers x, y of points [N, >=2], its corner on a multiple of ``cell``.

    Args:
        points: at least one point.
        cell: side of a cell.
        trim: share of the points left out on each side (0.001 keeps single stray points from blowing it up).
    """
    xy = np.asarray(points)[:, :2]
    if trim:
        low, high = np.quantile(xy[:: len(xy) // 500_000 + 1], [trim, 1 - trim], axis=0)  # a sample is enough
    else:
        low, high = xy.min(0), xy.max(0)
    x_min, y_max = np.floor(low[0] / cell) * cell, (np.floor(high[1] / cell) + 1) * cell
    columns, rows = int(np.floor((high[0] - x_min) / cell)) + 1, int(np.ceil((y_max - low[1]) / cell))
    return Grid(float(x_min), float(y_max), float(cell), max(rows, 1), max(columns, 1))


@dataclass(frozen=True)
class Surface:
    """What is seen from above.

    Attributes:
        grid: where it lies.
        heights: [rows, columns] float64, NaN where empty.
        colors: [rows, columns, 3] uint8, or None.
        counts: [rows, columns] points of the upper layer; 0 where empty or filled.
        views, predicted: [rows, columns] mean number of views, share of predicted points; NaN where empty.
    """

    grid: Grid
    heights: NDArray[np.float64]
    colors: NDArray[np.uint8] | None
    counts: NDArray[np.int64]
    views: NDArray[np.float64] | None = None
    predicted: NDArray[np.float64] | None = None

    @property
    def filled(self) -> NDArray[np.bool_]:
        return np.isfinite(self.heights)


def surface(cloud: Cloud, grid: Grid, *, fill: int = 0) -> Surface:
    """Mean height and colour of the upper layer of the points in each cell.

    The highest point alone would lift the surface by the noise; the mean of the points within :data:`LAYER` cells under
    it keeps roofs over walls and does not.

    Args:
        cloud: N points.
        grid: the cells.
        fill: passes in which an empty cell with at least three filled neighbours of eight takes their mean; with any,
            single cells that stand apart from all their neighbours in height count as empty.
    """
    cells, size = grid.cells(cloud.points), grid.rows * grid.columns
    inside = np.flatnonzero(cells >= 0)
    z, cells = cloud.points[inside, 2], cells[inside]
    top = np.full(size, -np.inf)
    np.maximum.at(top, cells, z)
    upper = z >= top[cells] - LAYER * grid.cell
    chosen, cells = inside[upper], cells[upper]
    counts = np.bincount(cells, minlength=size)

    def mean(values: NDArray) -> NDArray[np.float64]:
        total = np.bincount(cells, weights=values[chosen].astype(np.float64), minlength=size)
        with np.errstate(invalid="ignore"):
            return np.asarray(total / counts).reshape(grid.rows, grid.columns)

    layers = {"heights": mean(cloud.points[:, 2])}
    for name in ("views", "predicted"):
        if (values := getattr(cloud, name)) is not None:
            layers[name] = mean(values)
    if cloud.colors is not None:
        layers |= {name: mean(cloud.colors[:, channel]) for channel, name in enumerate("rgb")}
    stack = np.stack(list(layers.values()), axis=-1)
    counts = counts.reshape(grid.rows, grid.columns)
    if fill:
        lone = _speckles(layers["heights"], LAYER * grid.cell)
        stack[lone], counts[lone] = np.nan, 0
    closed = _fill(stack, fill)
    made = dict(zip(layers, np.moveaxis(closed, -1, 0), strict=True))
    colors = None
    if cloud.colors is not None:
        colors = np.nan_to_num(np.stack([made[name] for name in "rgb"], axis=-1)).round().astype(np.uint8)
    return Surface(
        grid,
        made["heights"],
        colors,
        counts,
        made.get("views"),
        made.get("predicted"),
    )


def _speckles(heights: NDArray[np.float64], step: float) -> NDArray[np.bool_]:
    """Cells that fewer than two of their eight neighbours join within ``step`` in height: stray matches, not ground."""
    padded = np.pad(heights, 1, constant_values=np.nan)
    rows, columns = heights.shape
    joined = np.zeros(heights.shape, np.int8)
    known = np.zeros(heights.shape, np.int8)
    for down in range(3):
        for right in range(3):
            if (down, right) != (1, 1):
                beside = padded[down : down + rows, right : right + columns]
                joined += np.abs(beside - heights) <= step
                known += np.isfinite(beside)
    return (known >= 2) & (joined < 2)


def _fill(layers: NDArray[np.float64], passes: int) -> NDArray[np.float64]:
    """Close small gaps in [rows, columns, C] from the neighbours' mean; NaN marks the gaps.

    A cell's neighbours are always added in the same order, so that it gets the same value in every window.
    """
    if not passes:
        return layers
    padded = np.pad(layers, ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)
    known = np.isfinite(padded[..., 0]).ravel()
    empty = ~known  # cells that may be filled: the padding may not
    empty.reshape(padded.shape[:2])[[0, -1]] = empty.reshape(padded.shape[:2])[:, [0, -1]] = False
    flat, width = padded.reshape(-1, padded.shape[2]), padded.shape[1]
    around = [width * down + right for down in (-1, 0, 1) for right in (-1, 0, 1) if (down, right) != (0, 0)]
    asked = np.flatnonzero(empty)
    for _ in range(passes):
        count = np.zeros(len(asked), np.int8)
        for step in around:
            count += known[asked + step]
        at, count = asked[count >= 3], count[count >= 3]
        if not len(at):
            break
        total = np.zeros((len(at), flat.shape[1]))
        for step in around:
            beside = flat[at + step]
            total += np.where(np.isfinite(beside[:, :1]), beside, 0.0)
        flat[at] = total / count[:, None]
        known[at], empty[at] = True, False
        near = np.zeros(len(known), bool)  # only beside a cell that was just filled may another one be
        for step in around:
            near[at + step] = True
        asked = np.flatnonzero(near & empty)
    return padded[1:-1, 1:-1]
