"""What one camera sees of a surface model: where each cell falls in the image, and which cells others hide."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import affinity

from overfly.flights.footprint import border_pixels
from overfly.geometry import Array, Camera, fold, rays
from overfly.mapping.lattice import STEP, Chunk, Map

STEEPEST = 2.0
"""Tangent of the largest angle off the vertical under which the ground is looked at (63 degrees)."""

FINENESS = 1.5
"""Side of a depth buffer's pixel in projected cells: a turned lattice leaves squares of up to the root of 2 empty."""

SLACK = 4.0
"""A cell is hidden where something stands more than this many pixels of the buffer, on the ground, before it."""


@dataclass(frozen=True)
class Walls:
    """Points on the steps of one chunk, which no cell's centre samples: x, y from its middle and heights, each [N]."""

    chunk: Chunk
    x: Array
    y: Array
    z: Map


def walls(heights: NDArray, cell: float, parts: Iterable[Chunk]) -> list[Walls]:
    """Points under cells that stand more than :data:`STEP` cells over a neighbour, down to it.

    Args:
        heights: [rows, columns], NaN where empty.
        cell: side of a cell; also the distance of the points.
        parts: the chunks of that grid.
    """
    padded = np.pad(heights, 1, constant_values=np.nan)
    beside = np.stack([padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]])
    drop = heights - np.fmin.reduce(beside)  # NaN compares false
    found = []
    for part in parts:
        here = drop[part.rows, part.columns]
        row, column = np.nonzero(here > STEP * cell)
        count = (here[row, column] / cell).astype(np.int64)
        row, column = np.repeat(row, count), np.repeat(column, count)
        down = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + 1
        z = heights[part.rows, part.columns][row, column] - down * cell
        found.append(Walls(part, part.x[column], part.y[row], z.astype(np.float32)))
    return found


class Sight:
    """One camera over a surface between two heights.

    Args:
        camera: its distortion is honoured.
        world_from_camera: [4, 4].
        low, high: heights between which the surface lies, in the world's z; the camera stands above ``low``.

    Attributes:
        outline: polygon in x, y that holds all the ground the image can show, down to :data:`STEEPEST`.
        bounds: x_min, y_min, x_max, y_max of the image in ideal coordinates x/z, y/z.
        above: height of the camera over the lowest surface.
        near: height of the camera over the highest surface, at least a tenth of ``above``.
        gsd: ground sampling distance straight down, half way between the two.
        steepest: tangent of the largest angle off the vertical at which it looks at the ground.
    """

    def __init__(self, camera: Camera, world_from_camera: Array, low: float, high: float) -> None:
        self.camera, self.pose = camera, np.asarray(world_from_camera, float)
        self.fold = np.float32(fold(camera))
        border = rays(border_pixels(camera), camera)
        border = border[np.isfinite(border).all(1)]  # a strong barrel has no rays at its corners
        self.bounds = (*border[:, :2].min(0), *border[:, :2].max(0))
        above = self.pose[2, 3] - low
        self.above, self.near = above, max(self.pose[2, 3] - high, 0.1 * above)
        world = border @ self.pose[:3, :3].T
        flat = np.maximum(np.linalg.norm(world[:, :2], axis=1, keepdims=True), 1e-12)
        # Rays to the horizon are bent down to the steepest angle, so that the outline stays a closed one.
        aside = world[:, :2] / np.maximum(-world[:, 2:], flat / STEEPEST)
        ends = np.concatenate([aside * above, aside * max(self.pose[2, 3] - high, 0.0)])
        self.steepest = float((flat / np.maximum(-world[:, 2:], flat / STEEPEST)).max())
        self.gsd = (above + self.near) / 2 / camera.fx
        self.outline = shapely.MultiPoint(ends + self.pose[:2, 3]).convex_hull

    def touches(self, part: Chunk, margin: float) -> bool:
        """Whether the image can show anything of a chunk, or of its surroundings as far as ``margin``."""
        return bool(shapely.dwithin(self.outline, part.outline, margin))

    def between(self, ground: shapely.Geometry, low: float, high: float) -> shapely.Geometry:
        """What may stand between the camera and some ground: a polygon in x, y.

        Args:
            ground: in x, y.
            low, high: heights between which that ground and all around it lie.
        """
        x, y = (float(c) for c in self.pose[:2, 3])
        share = min((high - low) / max(self.pose[2, 3] - low, 1e-9), 1.0)  # of the way up to the camera
        nearer = affinity.scale(ground, 1 - share, 1 - share, origin=(x, y))
        return shapely.convex_hull(shapely.union_all([ground, nearer]))

    def coarseness(self, cell: float) -> float:
        """How far, on the ground, points decide of each other in a :meth:`buffer` of that cell: its pixel, then two."""
        return 3 * FINENESS * cell * self.above * float(np.hypot(1, self.steepest)) / self.near

    def ideal(self, part: Chunk, x: Array, y: Array, z: Map) -> tuple[Map, Map, Map, Map]:
        """Ideal coordinates x/z, y/z, depth and squared tangent off the vertical of a chunk's points.

        Everything NaN behind the camera, above it and beyond :data:`STEEPEST`.
        """
        a, b, depth, under = part.from_camera(self.pose, x, y, z)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            slope = (a * a + b * b + depth * depth) / (under * under) - 1
            ok = (depth > 0.05 * np.float32(self.near)) & (under > 0) & (slope < np.float32(STEEPEST**2))
            depth = np.where(ok, depth, np.float32(np.nan))
            return a / depth, b / depth, depth, slope

    def pixels(self, u: Map, v: Map, camera: Camera) -> tuple[Map, Map]:
        """Image coordinates of ideal ones, lens included; NaN beyond the fold. ``camera`` may be a resized one."""
        if camera.is_distorted:
            k1, k2, p1, p2, k3 = (np.float32(k) for k in camera.distortion)
            with np.errstate(over="ignore", invalid="ignore"):
                r2 = u * u + v * v
                radial = np.where(r2 < self.fold, 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), np.float32(np.nan))
                uv = 2 * u * v
                u, v = u * radial + p1 * uv + p2 * (r2 + 2 * u * u), v * radial + p1 * (r2 + 2 * v * v) + p2 * uv
        return (
            u * np.float32(camera.fx) + np.float32(camera.cx),
            v * np.float32(camera.fy) + np.float32(camera.cy),
        )

    def buffer(self, heights: Map, cell: float, parts: Iterable[Chunk], steps: Iterable[Walls]) -> DepthBuffer:
        """The nearest depth in every direction, of a surface [rows, columns] and its :func:`walls`."""
        side = FINENESS * cell / self.near  # ideal coordinates; the same in every window
        x_min, y_min, x_max, y_max = self.bounds
        columns, rows = int((x_max - x_min) / side) + 1, int((y_max - y_min) / side) + 1
        nearest = np.full(rows * columns, np.inf, np.float32)
        points = [(p, p.x[None, :], p.y[:, None], heights[p.rows, p.columns]) for p in parts]
        for part, x, y, z in [*points, *((w.chunk, w.x, w.y, w.z) for w in steps)]:
            u, v, depth, _ = self.ideal(part, x, y, z)
            column, row = (u - np.float32(x_min)) / np.float32(side), (v - np.float32(y_min)) / np.float32(side)
            inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
            place = row[inside].astype(np.int32) * np.int32(columns) + column[inside].astype(np.int32)
            np.minimum.at(nearest, place, depth[inside])
        return DepthBuffer(_closed(nearest.reshape(rows, columns)), float(x_min), float(y_min), side, cell)


@dataclass(frozen=True)
class DepthBuffer:
    """Depths [rows, columns] over ideal coordinates from x_min, y_min in pixels of ``side``; inf where nothing is."""

    nearest: Map
    x_min: float
    y_min: float
    side: float
    cell: float

    def hides(self, u: Map, v: Map, depth: Map) -> NDArray[np.bool_]:
        """Whether something stands before points at ideal coordinates u, v and ``depth``; False where these are NaN."""
        rows, columns = self.nearest.shape
        column = (u - np.float32(self.x_min)) / np.float32(self.side)
        row = (v - np.float32(self.y_min)) / np.float32(self.side)
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        place = np.where(inside, row, 0).astype(np.int32) * np.int32(columns)
        place += np.where(inside, column, 0).astype(np.int32)
        before = np.take(self.nearest.ravel(), place) + np.float32(SLACK * FINENESS * self.cell)
        return inside & (depth > before)


def _closed(nearest: Map) -> Map:
    """Close single pixels through which the ground shines between the points of a roof."""
    import cv2

    kernel = np.ones((3, 3), np.uint8)
    big = np.where(np.isfinite(nearest), nearest, np.float32(3e38))
    grown = cv2.erode(big, kernel, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.dilate(grown, kernel, borderType=cv2.BORDER_REPLICATE))
