"""Painting what lies on the ground: areas, streets and what is already taken by an object."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from overfly.scenes.scene import Cover

Array = NDArray[np.float64]

PIECE_M = 20.0
"""Streets are painted in pieces of this length, so that each touches a small part of the raster."""


class Painter:
    """A raster over the landscape on which areas, streets and objects are marked.

    Args:
        size_m: the landscape's width.
        heading: turn of the layout, radians.
        background: kind of everything that is not painted.
        pavement: width of the pavements beside streets, metres.
        marked: whether the streets carry lane marks.
        wild: the kind beyond the landscape.
    """

    def __init__(
        self, size_m: float, heading: float, background: int, *, pavement: float, marked: bool, wild: int
    ) -> None:
        count = int(min(np.ceil(size_m / 0.25), 2000))
        self.cell = size_m / count
        self.low = -size_m / 2
        self.size_m, self.heading, self.pavement, self.marked, self.wild = size_m, heading, pavement, marked, wild
        self.kind = np.full((count, count), background, np.uint8)
        self.taken = np.zeros((count, count), bool)
        self._centres = self.low + (np.arange(count) + 0.5) * self.cell
        # Streets need no finer raster: their distances are interpolated.
        coarse = int(min(np.ceil(size_m / 0.5), 1000))
        self.road_cell = size_m / coarse
        self.road = np.full((coarse, coarse, 4), 1e4, np.float32)
        self.road[..., 1] = 1.0
        self.road[..., 2] = 0.0
        self._course = np.zeros((coarse, coarse, 2), np.float32)
        self._road_centres = self.low + (np.arange(coarse) + 0.5) * self.road_cell

    def cover(self) -> Cover:
        """The raster for the shading kernel."""
        return Cover(
            self.low,
            self.low,
            self.size_m,
            self.kind,
            self.road,
            float(np.degrees(self.heading)),
            self.pavement,
            self.marked,
            self.wild,
        )

    def world(self, local: ArrayLike) -> Array:
        """World coordinates [..., 2] of the layout's own."""
        x, y = np.moveaxis(np.asarray(local, float), -1, 0)
        c, s = np.cos(self.heading), np.sin(self.heading)
        return np.stack([x * c - y * s, x * s + y * c], -1)

    def _window(self, low: Array, high: Array, cell: float = 0.0) -> tuple[slice, slice] | None:
        cell = cell or self.cell
        first = np.maximum(np.floor((low - self.low) / cell).astype(int), 0)
        last = np.minimum(np.ceil((high - self.low) / cell).astype(int), round(self.size_m / cell))
        if (first >= last).any():
            return None
        return slice(first[1], last[1]), slice(first[0], last[0])

    def _points(self, window: tuple[slice, slice]) -> tuple[Array, Array]:
        x, y = np.meshgrid(self._centres[window[1]], self._centres[window[0]])
        return x, y

    def area(self, centre: ArrayLike, angle: float, size: ArrayLike, kind: int | None, *, take: bool = False) -> None:
        """Paint a rectangle of ``size`` [2] (``kind`` None leaves the colour); ``take`` marks it as an object's."""
        centre, (length, width) = np.asarray(centre, float), np.asarray(size, float)
        reach = np.hypot(length, width) / 2 + self.cell
        window = self._window(centre - reach, centre + reach)
        if window is None:
            return
        x, y = self._points(window)
        c, s = np.cos(angle), np.sin(angle)
        u, v = (x - centre[0]) * c + (y - centre[1]) * s, (y - centre[1]) * c - (x - centre[0]) * s
        inside = (np.abs(u) <= length / 2) & (np.abs(v) <= width / 2)
        if kind is not None:
            self.kind[window][inside] = kind
        if take:
            self.taken[window][inside] = True

    def disc(self, centre: ArrayLike, radius: float, kind: int, *, take: bool = False) -> None:
        centre = np.asarray(centre, float)
        window = self._window(centre - radius - self.cell, centre + radius + self.cell)
        if window is None:
            return
        x, y = self._points(window)
        inside = np.hypot(x - centre[0], y - centre[1]) <= radius
        self.kind[window][inside] = kind
        if take:
            self.taken[window][inside] = True

    def where(self, mask: NDArray[np.bool_], kind: int) -> None:
        """Paint the cells of a mask of the whole raster."""
        self.kind[mask] = kind

    def grid(self) -> Array:
        """Centres of all cells [rows, cols, 2]."""
        return np.stack(np.meshgrid(self._centres, self._centres), -1)

    def path(self, line: ArrayLike, width: float, kind: int) -> None:
        """Paint a footpath or track along a line [k, 2]."""
        for start, end, _ in _pieces(np.asarray(line, float)):
            middle, along = (start + end) / 2, end - start
            length = float(np.hypot(*along)) + width * 0.8
            self.area(middle, float(np.arctan2(along[1], along[0])), (length, width), kind)

    def street(self, line: ArrayLike, half_width: float) -> None:
        """Paint a street along a line [k, 2]; where streets meet, the nearer edge wins."""
        reach = half_width + self.pavement + 3 * self.road_cell
        for start, end, before in _pieces(np.asarray(line, float)):
            window = self._window(np.minimum(start, end) - reach, np.maximum(start, end) + reach, self.road_cell)
            if window is None:
                continue
            x, y = np.meshgrid(self._road_centres[window[1]], self._road_centres[window[0]])
            along = end - start
            length = float(np.hypot(*along))
            t = ((x - start[0]) * along[0] + (y - start[1]) * along[1]) / length**2
            held = np.clip(t, 0, 1)
            away = np.hypot(x - start[0] - held * along[0], y - start[1] - held * along[1])
            side = np.where((x - start[0]) * along[1] - (y - start[1]) * along[0] >= 0, 1.0, -1.0)
            part = self.road[window]
            nearer = (away - half_width < np.abs(part[..., 0]) - part[..., 1]) & (away <= reach)
            part[nearer, 0] = (side * away)[nearer]
            part[nearer, 1] = half_width
            part[nearer, 2] = (before + held * length)[nearer]
            part[nearer, 3] = 1e4
            self._course[window][nearer] = along / length

    def crossings(self, points: ArrayLike, reach: ArrayLike) -> None:
        """Tell the streets where they cross (``points`` [n, 2]) and how far the crossing reaches ([n], metres)."""
        points, reach = np.asarray(points, float).reshape(-1, 2), np.asarray(reach, float).ravel()
        rows, cols = np.nonzero(np.abs(self.road[..., 0]) < 1e3)
        if len(points) and len(rows):
            here = np.stack([self._road_centres[cols], self._road_centres[rows]], -1)
            nearest = cKDTree(points).query(here)[1]
            way = ((here - points[nearest]) * self._course[rows, cols]).sum(-1)
            self.road[rows, cols, 3] = np.abs(way) - reach[nearest]

    def _cells(self, xy: Array, count: int) -> tuple[NDArray, NDArray, NDArray]:
        index = np.floor((xy - self.low) * (count / self.size_m)).astype(int)
        inside = ((index >= 0) & (index < count)).all(-1)
        index = np.clip(index, 0, count - 1)
        return index[..., 1], index[..., 0], np.asarray(inside)

    def _beside(self, xy: Array) -> Array:
        """Distance to the edge of the nearest painted street, metres; negative on it, large where none is near."""
        row, col, _ = self._cells(xy, len(self.road))
        road = self.road[row, col]
        return np.abs(road[..., 0]) - road[..., 1]

    def free(self, xy: ArrayLike, margin: float = 0.0) -> NDArray[np.bool_]:
        """Whether places [..., 2] are inside the landscape, off the streets and not taken, ``margin`` metres around."""
        xy = np.asarray(xy, float)
        result = np.ones(xy.shape[:-1], bool)
        ring = np.array([(0, 0)] + [(np.cos(a), np.sin(a)) for a in np.arange(8) * np.pi / 4])
        for offset in ring[: 9 if margin > 0 else 1] * margin:
            row, col, inside = self._cells(xy + offset, len(self.kind))
            result &= inside & ~self.taken[row, col] & (self._beside(xy + offset) > 0)
        return result

    def fits(self, centre: ArrayLike, angle: float, length: float, width: float, *, inside: bool = True) -> bool:
        """Whether a rectangle is free everywhere, pavements included; ``inside`` False lets it reach over the rim."""
        steps_u, steps_v = (np.linspace(-0.5, 0.5, max(3, int(s / 2) + 2)) * s for s in (length, width))
        u, v = np.meshgrid(steps_u, steps_v)
        c, s = np.cos(angle), np.sin(angle)
        xy = np.stack([u * c - v * s, u * s + v * c], -1) + np.asarray(centre, float)
        row, col, here = self._cells(xy, len(self.kind))
        return bool(((here | (not inside)) & ~self.taken[row, col] & (self._beside(xy) > self.pavement)).all())

    def kind_at(self, xy: ArrayLike) -> NDArray[np.uint8]:
        row, col, _ = self._cells(np.asarray(xy, float), len(self.kind))
        return self.kind[row, col]


def _pieces(line: Array) -> list[tuple[Array, Array, float]]:
    """Short straight pieces of a line: start, end and the way before."""
    pieces, before = [], 0.0
    for start, end in pairwise(line):
        length = float(np.hypot(*(end - start)))
        count = max(1, int(np.ceil(length / PIECE_M)))
        for i in range(count):
            a, b = start + (end - start) * i / count, start + (end - start) * (i + 1) / count
            if length > 1e-6:
                pieces.append((a, b, before + length * i / count))
        before += length
    return pieces


def along(line: ArrayLike, step: float, start: float = 0.0) -> tuple[Array, Array]:
    """Places [n, 2] every ``step`` metres along a line [k, 2], and the direction there [n] in radians."""
    line = np.asarray(line, float)
    length = np.hypot(*np.diff(line, axis=0).T)
    total = np.concatenate([[0], np.cumsum(length)])
    at = np.arange(start, total[-1], step)
    index = np.clip(np.searchsorted(total, at, side="right") - 1, 0, len(length) - 1)
    share = (at - total[index]) / np.maximum(length[index], 1e-9)
    direction = line[index + 1] - line[index]
    return line[index] + share[:, None] * direction, np.arctan2(direction[:, 1], direction[:, 0])
