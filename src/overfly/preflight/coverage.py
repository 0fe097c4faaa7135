"""How often the ground is seen: views per cell, overlaps along and across the lines, bases, blocks."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray

from overfly.data.footprints import footprint, ground_overlaps
from overfly.geometry import Array
from overfly.mapping.needs import SIZE
from overfly.mapping.raster import Grid
from overfly.preflight.accuracy import sigma_xy_m, sigma_z_m
from overfly.preflight.ground import Placement, lines_of

CELLS = 500
"""Cells along the longer side of the raster."""

STEREO_OVERLAP = 0.5
"""Pairs that share at least so much are matched well: among them the longest base measures a place."""

CONNECTED = 0.2
"""Pairs that share at least so much hold a block together."""


@dataclass(frozen=True, eq=False)
class Coverage:
    """Of n images.

    Attributes:
        grid, views: how many images see each cell of the ground [rows, columns].
        flown: cells inside the flight: its border, which every flight sees once only, is left out [rows, columns].
        outlines: footprints [n, 4, 2]; NaN where an image sees no ground.
        overlaps: share of footprint i inside footprint j [n, n].
        lines: straight runs of images.
        direction: of the lines, degrees clockwise from north, 0..180; None without two lines.
        forward: overlap of each image with the next of its line.
        side: overlap of each image with the best one of the next line.
        base_to_height: of each image and its stereo partner [n]; NaN without partner.
        gsd_m: metres per pixel on the ground [n].
        matched_gsd_m: the same at the size at which ``overfly map`` matches images unless told otherwise [n].
        blocks: number of the group of overlapping images to which each belongs [n], the largest is 0.
    """

    grid: Grid
    views: NDArray[np.int64]
    flown: NDArray[np.bool_]
    outlines: Array
    overlaps: Array
    lines: list[NDArray[np.int64]]
    direction: float | None
    forward: Array
    side: Array
    base_to_height: Array
    gsd_m: Array
    matched_gsd_m: Array
    blocks: NDArray[np.int64]

    @property
    def shares(self) -> tuple[float, float, float, float]:
        """Of the flown area seen by 0, 1, 2 and by 3 or more images."""
        inside = self.views[self.flown]
        if not inside.size:
            return 1.0, 0.0, 0.0, 0.0
        return (
            float((inside == 0).mean()),
            float((inside == 1).mean()),
            float((inside == 2).mean()),
            float((inside > 2).mean()),
        )

    @property
    def footprint_across(self) -> float:
        """Median width of the footprints across the lines, metres."""
        seeing = self.outlines[np.isfinite(self.outlines).all((1, 2))]
        angle = np.radians(self.direction or 0.0)
        across = seeing @ np.array([np.cos(angle), -np.sin(angle)])
        return float(np.median(np.ptp(across, axis=1)))

    @property
    def sigma_z_m(self) -> float:
        """Median over the images, see :func:`overfly.preflight.accuracy.sigma_z_m`; inf where none has a partner."""
        known = np.isfinite(self.base_to_height)
        values = [sigma_z_m(g, b) for g, b in zip(self.matched_gsd_m[known], self.base_to_height[known])]
        return float(np.median(values)) if values else np.inf

    @property
    def sigma_xy_m(self) -> float:
        return sigma_xy_m(float(np.median(self.matched_gsd_m)))


def cover(placed: Placement) -> Coverage | None:
    """Rasterise what cameras over level ground see; None where no camera sees the ground."""
    outlines = np.stack([footprint(c, p, placed.ground) for c, p in zip(placed.cameras, placed.poses)])
    seeing = np.isfinite(outlines).all((1, 2))
    if not seeing.any():
        return None
    grid = _grid(outlines[seeing])
    views = _views(grid, outlines[seeing])
    overlaps = ground_overlaps(outlines)
    xy = placed.poses[:, :2, 3]
    lines = lines_of(xy)
    direction = _direction(xy, lines)
    forward = np.array([overlaps[i, j] for line in lines for i, j in pairwise(line)])
    ahead = np.abs(placed.poses[:, 2, 2])
    focal = np.array([c.fx for c in placed.cameras])
    heights = np.maximum(placed.heights, 1e-9)
    gsd = heights / np.maximum(ahead, 0.2) / focal
    longest = np.array([max(c.width, c.height) for c in placed.cameras])
    return Coverage(
        grid=grid,
        views=views,
        flown=_flown(grid, views, outlines[seeing]),
        outlines=outlines,
        overlaps=overlaps,
        lines=lines,
        direction=direction,
        forward=forward,
        side=_side(xy, lines, overlaps, direction),
        base_to_height=_bases(placed.poses[:, :3, 3], overlaps) / heights,
        gsd_m=gsd,
        matched_gsd_m=gsd * np.maximum(longest / SIZE, 1),
        blocks=_blocks(overlaps),
    )


def across_of(xy: Array, direction: float) -> tuple[Array, Array]:
    """Positions [..., 2] along and across lines of a direction (degrees from north)."""
    angle = np.radians(direction)
    along = np.asarray(xy) @ np.array([np.sin(angle), np.cos(angle)])
    return along, np.asarray(xy) @ np.array([np.cos(angle), -np.sin(angle)])


def parallel(xy: Array, lines: list[NDArray[np.int64]], direction: float) -> list[NDArray[np.int64]]:
    """The lines within 20 degrees of a direction, in their order across it; two images are a step and no line."""
    kept = [line for line in lines if len(line) > 2 and abs((_bearing(xy, line) - direction + 90) % 180 - 90) < 20]
    return sorted(kept, key=lambda line: float(np.median(across_of(xy[line], direction)[1])))


def _bearing(xy: Array, line: NDArray[np.int64]) -> float:
    east, north = xy[line[-1]] - xy[line[0]]
    return float(np.degrees(np.arctan2(east, north)) % 180)


def _direction(xy: Array, lines: list[NDArray[np.int64]]) -> float | None:
    """The direction that most images in lines share; None where fewer than two lines do."""
    best: tuple[int, float] = (0, 0.0)
    for line in lines:
        bearing = _bearing(xy, line)
        alike = parallel(xy, lines, bearing)
        if len(alike) > 1 and (weight := sum(map(len, alike))) > best[0]:
            doubled = np.radians([2 * _bearing(xy, other) for other in alike])
            sizes = np.array([len(other) for other in alike])
            mean = np.arctan2((sizes * np.sin(doubled)).sum(), (sizes * np.cos(doubled)).sum())
            best = weight, float(np.degrees(mean) / 2 % 180)
    return best[1] if best[0] else None


def _grid(outlines: Array) -> Grid:
    low, high = outlines.reshape(-1, 2).min(0), outlines.reshape(-1, 2).max(0)
    cell = float(max((high - low).max() / CELLS, 1e-6))
    rows, columns = (int(np.ceil(side / cell)) + 1 for side in (high - low)[::-1])
    return Grid(float(low[0]), float(high[1]), cell, rows, columns)


def _views(grid: Grid, outlines: Array) -> NDArray[np.int64]:
    """Footprints are convex: a cell's centre lies inside where it is on one side of all four edges."""
    views = np.zeros((grid.rows, grid.columns), np.int64)
    for outline in outlines:
        (left, bottom), (right, top) = outline.min(0), outline.max(0)
        c0, c1 = int((left - grid.x_min) / grid.cell), int((right - grid.x_min) / grid.cell) + 1
        r0, r1 = int((grid.y_max - top) / grid.cell), int((grid.y_max - bottom) / grid.cell) + 1
        x = grid.x_min + (np.arange(c0, min(c1, grid.columns)) + 0.5) * grid.cell
        y = grid.y_max - (np.arange(r0, min(r1, grid.rows)) + 0.5) * grid.cell
        sides = []
        for (ax, ay), (bx, by) in zip(outline, np.roll(outline, -1, axis=0)):
            sides.append((bx - ax) * (y[:, None] - ay) - (by - ay) * (x[None] - ax) >= 0)
        stack = np.array(sides)
        views[r0 : r0 + len(y), c0 : c0 + len(x)] += stack.all(0) | (~stack).all(0)
    return views


def _flown(grid: Grid, views: NDArray[np.int64], outlines: Array) -> NDArray[np.bool_]:
    """Cells between the middles of the footprints; bays that are wider than two footprints do not belong to it."""
    from scipy.ndimage import binary_closing

    size = float(np.sqrt(np.median(shapely.area(shapely.polygons(outlines)))))
    hull = shapely.MultiPoint(outlines.mean(1)).convex_hull.buffer(0.05 * size)
    centres = grid.centres()
    inside = shapely.contains_xy(hull, centres[..., 0], centres[..., 1])
    # Closed on a coarse copy: a footprint may be hundreds of cells wide.
    step = max(1, int(size / grid.cell / 12))
    coarse = views[::step, ::step] > 0
    reach = max(1, round(size / grid.cell / step))
    y, x = np.ogrid[-reach : reach + 1, -reach : reach + 1]
    closed = binary_closing(np.pad(coarse, reach), x**2 + y**2 <= reach**2)[reach:-reach, reach:-reach]
    fine = np.repeat(np.repeat(closed, step, 0), step, 1)[: grid.rows, : grid.columns]
    return np.asarray(inside & (fine | (views > 0)))


def _side(xy: Array, lines: list[NDArray[np.int64]], overlaps: Array, direction: float | None) -> Array:
    if direction is None:
        return np.zeros(0)
    ordered = parallel(xy, lines, direction)
    return np.array([overlaps[i, after].max() for line, after in pairwise(ordered) for i in line])


def _bases(centres: Array, overlaps: Array) -> Array:
    """Distance to the stereo partner: the furthest of those that share enough, else the one that shares most [n]."""
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    mutual = np.minimum(overlaps, overlaps.T)
    np.fill_diagonal(mutual, 0)
    good = (mutual >= STEREO_OVERLAP) & (apart > 0)
    furthest = np.where(good, apart, 0).max(1)
    most = mutual.argmax(1)
    nearest = np.where(mutual.max(1) > 0.05, apart[np.arange(len(apart)), most], np.nan)
    bases = np.where(good.any(1), furthest, nearest)
    return np.where(bases > 0, bases, np.nan)


def _blocks(overlaps: Array) -> NDArray[np.int64]:
    from scipy.sparse.csgraph import connected_components

    _, labels = connected_components(np.minimum(overlaps, overlaps.T) >= CONNECTED, directed=False)
    sizes = np.bincount(labels)
    rank = np.empty(len(sizes), np.int64)
    rank[np.argsort(-sizes, kind="stable")] = np.arange(len(sizes))
    return rank[labels]
