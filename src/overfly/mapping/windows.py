"""Rectangles of a grid, by which rasters are computed and written piece by piece."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from overfly.mapping.raster import Grid


@dataclass(frozen=True)
class Window:
    """Rows and columns of a grid."""

    whole: Grid
    rows: slice
    columns: slice

    @property
    def grid(self) -> Grid:
        """Of these cells alone."""
        cell = self.whole.cell
        return Grid(
            self.whole.x_min + self.columns.start * cell,
            self.whole.y_max - self.rows.start * cell,
            cell,
            self.rows.stop - self.rows.start,
            self.columns.stop - self.columns.start,
        )

    @property
    def place(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """As rasterio writes it: (first and last row + 1, first and last column + 1)."""
        return (self.rows.start, self.rows.stop), (self.columns.start, self.columns.stop)

    def wide(self, cells: int) -> Window:
        """With so many cells more on each side, as far as the grid goes."""
        return Window(
            self.whole,
            slice(max(0, self.rows.start - cells), min(self.whole.rows, self.rows.stop + cells)),
            slice(max(0, self.columns.start - cells), min(self.whole.columns, self.columns.stop + cells)),
        )

    def inside(self, wide: Window) -> tuple[slice, slice]:
        """Where it lies in a wider one."""
        row, column = wide.rows.start, wide.columns.start
        return (
            slice(self.rows.start - row, self.rows.stop - row),
            slice(self.columns.start - column, self.columns.stop - column),
        )


def windows(grid: Grid, cells: int) -> Iterator[Window]:
    """The windows of a grid, so many cells each way, row by row from the north-west."""
    for row in range(0, grid.rows, cells):
        for column in range(0, grid.columns, cells):
            rows = slice(row, min(row + cells, grid.rows))
            yield Window(grid, rows, slice(column, min(column + cells, grid.columns)))


def window_over(grid: Grid, part: Grid) -> Window:
    """The cells of a grid that a part of another one touches; at least one."""
    x_min, x_max, y_min, y_max = part.extent
    rows = [int(np.floor((grid.y_max - y) / grid.cell)) for y in (y_max, y_min)]
    columns = [int(np.floor((x - grid.x_min) / grid.cell)) for x in (x_min, x_max)]
    (top, bottom), (left, right) = np.clip(rows, 0, grid.rows - 1), np.clip(columns, 0, grid.columns - 1)
    return Window(grid, slice(int(top), int(bottom) + 1), slice(int(left), int(right) + 1))
