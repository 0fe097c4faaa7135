"""Walls that one image shows and no pair matches: between a roof's measured edge and the measured ground before it.

A wall is seen from one side, at a flat angle, by few images: pairs find a quarter to a half of it. What stands above
and below it is measured, though, and what lies between the two is wall, or stands before it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from overfly.cloud import Cloud
from overfly.geometry import Array, Camera, project, unproject
from overfly.mapping.raster import Surface, grid_over, surface
from overfly.mapping.thinning import BLOCK

Map = NDArray[np.float32]

CELL_M, CELL_PIXELS = 0.4, 2
"""Side of a cell of the plan, metres and ground pixels, whichever is more: on less, leaves are as flat as roofs."""

STEP_M, STEP_PIXELS = 2.5, 8
"""Least height of a wall, metres and ground pixels, whichever is more."""

GAP = 20
"""Cells between the edge and the ground before it that may be blank: what the roof hides from other images."""

AROUND, FIRM, ALIKE = 3, 10, 1.5
"""A cell stands firm where so many of those up to so many cells away are measured and differ by fewer cells."""

FLAT_M, FLAT_PIXELS, PLANE = 0.12, 2, 2
"""Root mean square, metres and ground pixels, whichever is more, by which the cells up to so many away on a roof may
miss a plane."""

LEVEL, FAR_PLANE, ROOF_M2, ROOF_CELLS = 0.5, 4, 12.0, 24
"""Share of a roof's cells that lie in a plane with those up to so many away, and least plan of a roof, in square metres
and in cells. Of the crowns of large trees, which are as flat as roofs along two cells (Tampa), few have so many. With
20 m², which hardly any crown has, small gables have no walls: F-scores at 1 m are 0.003 less."""

GROUND_M2 = 60.0
"""Least plan of the ground before a wall: else a pit of wrong matches would get walls, too."""

INWARD = 2
"""Ground pixels by which a wall stands inside the edge that was measured: matching carries roofs beyond their edges."""

FARTHEST = 2.0
"""Median depths beyond which an oblique image shows too little."""

DIVISORS = tuple(size for size in range(2, 61) if BLOCK % size == 0)
"""Sides of cubes, in voxels, that no border of a tile cuts."""

PIXELS = 2
"""Pixels along a cell that are looked at."""

AT_ONCE = 20_000
"""Cells whose planes are fitted at once."""

TALLEST = 8.0
"""Ground pixels along the ray that one pixel shows of a wall: what lies farther is another wall, behind it."""

CONFIDENCE, SIGMA = 0.95, 2.5
"""Share of such points that lies within 1 % of the camera's height of a surface, and standard deviation across the wall
in ground pixels, on rendered flights at 50 % over blocks, campus and suburb."""


class WallPoints(NamedTuple):
    """What a frame shows of walls.

    Attributes:
        points: [N, 3], a ground pixel apart.
        rows, columns: [N] of the pixels that show them.
        voxels: how many ground pixels wide the cubes are in which other points make them needless.
    """

    points: Array
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    voxels: int


def wall_points(
    depth: Map, measured: NDArray[np.bool_], camera: Camera, world_from_camera: Array, around: Sequence[Array] = ()
) -> WallPoints:
    """Points on the walls that a frame shows in its blank pixels.

    Args:
        depth: [H, W] of the frame, metres, NaN where nothing stands but perhaps a lone word of the network, infinite
            where the lens shows nothing.
        measured: where pairs have matched it; elsewhere it is a guess, of which no roof and no ground is made.
        camera: undistorted, of the same size.
        world_from_camera: [4, 4], z up.
        around: points [M, 3] inside the image that other frames have measured: what hides the ground here need not hide
            it there.
    """
    nothing = WallPoints(np.zeros((0, 3)), np.zeros(0, np.intp), np.zeros(0, np.intp), 1)
    blank = np.isnan(depth)
    points = measured_points(np.where(measured, depth, np.nan), camera, world_from_camera, PIXELS)
    if not len(points):
        return nothing
    gsd = _middle(depth[measured]) / camera.fx
    cell = max(CELL_M, CELL_PIXELS * gsd)
    points = np.concatenate([points, *around])
    seen = surface(Cloud(points), grid_over(points, cell, trim=0.0005))
    found, outward = _curtains(seen, gsd)
    if not len(found):
        return nothing
    facing = ((world_from_camera[:2, 3] - found[:, :2]) * outward).sum(1) > 0
    found, outward = found[facing], outward[facing]
    row, column, away, inside = looked_up(found, camera, world_from_camera)
    shown = np.flatnonzero(inside)
    shown = shown[blank[row[shown], column[shown]]]
    block = max(1, int(np.ceil(cell / gsd)))
    hidden = _hidden(points, row[shown], column[shown], away[shown], block, camera, world_from_camera, TALLEST * gsd)
    shown = shown[~hidden]
    flat = row[shown] * camera.width + column[shown]
    nearest = np.full(camera.height * camera.width, np.inf)
    np.minimum.at(nearest, flat, away[shown])
    shown = shown[away[shown] < nearest[flat] + TALLEST * gsd]
    found[:, :2] -= INWARD * gsd * outward  # after it was looked for where its edge was seen
    voxels = next(size for size in DIVISORS if size >= cell / gsd - 1e-6 or size == DIVISORS[-1])
    return WallPoints(found[shown], row[shown], column[shown], voxels)


def _hidden(
    points: Array,
    row: NDArray[np.intp],
    column: NDArray[np.intp],
    away: Array,
    block: int,
    camera: Camera,
    world_from_camera: Array,
    tallest: float,
) -> NDArray[np.bool_]:
    """Which pixels [N], so far away, have measured points [M, 3] before them, in blocks that surely hold one."""
    there, beside, nearer, inside = looked_up(points, camera, world_from_camera)
    nearest = np.full((-(-camera.height // block), -(-camera.width // block)), np.inf)
    np.minimum.at(nearest, (there[inside] // block, beside[inside] // block), nearer[inside])
    return np.asarray(nearest[row // block, column // block] < away - block * tallest)


def looked_up(
    points: Array, camera: Camera, world_from_camera: Array
) -> tuple[NDArray[np.intp], NDArray[np.intp], Array, NDArray[np.bool_]]:
    """Row, column and depth [N] at which an image has points [N, 3], and which of them lie inside of it."""
    at, away = project(points, camera, world_from_camera)
    column, row = np.floor(np.nan_to_num(at, nan=-1)).astype(np.intp).T
    return row, column, away, (away > 0) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)


def measured_points(depth: Map, camera: Camera, world_from_camera: Array, pixels: int = 1) -> Array:
    """What a depth map [H, W] holds, so many pixels along a cell: points [N, 3]; not what is farther than most."""
    if np.isnan(middle := _middle(depth)):
        return np.zeros((0, 3))
    gsd = middle / camera.fx
    step = max(1, int(max(CELL_M, CELL_PIXELS * gsd) / gsd / pixels))
    with np.errstate(invalid="ignore"):
        rows, columns = (k * step for k in np.nonzero(depth[::step, ::step] < FARTHEST * middle))
    at = np.stack([columns + 0.5, rows + 0.5], axis=1)
    return unproject(at, depth[rows, columns], camera, world_from_camera)


def _middle(depth: Map) -> float:
    """The median of the depths that are known, NaN of none."""
    known = depth[np.isfinite(depth)]
    return float(np.median(known)) if len(known) else float("nan")


def _curtains(seen: Surface, gsd: float) -> tuple[Array, Array]:
    """Points [N, 3] one ground pixel apart under the edges of roofs, and the way [N, 2] that each wall faces."""
    cell, step = seen.grid.cell, max(STEP_M, STEP_PIXELS * gsd)
    roof, ground, flat = _roofs(seen.heights, cell, max(FLAT_M, FLAT_PIXELS * gsd))
    margin = GAP + 1
    z = np.pad(seen.heights, margin, constant_values=np.nan)
    roof, ground, flat = (np.pad(part, margin) for part in (roof, ground, flat))
    parts = max(1, round(cell / gsd))  # points side by side on the border of a cell
    aside = ((np.arange(parts) + 0.5) / parts - 0.5) * cell
    points, ways = [np.zeros((0, 3))], [np.zeros((0, 2))]
    for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        with np.errstate(invalid="ignore"):
            edge = roof & ~(np.roll(z, (-down, -right), (0, 1)) > z - step)
        row, column = np.nonzero(edge)
        foot = _foot(z, ground, flat, row, column, (down, right), step)
        held = np.isfinite(foot)
        row, column, foot = row[held], column[held], foot[held]
        count = ((z[row, column] - foot) / gsd).astype(np.intp)
        own = np.repeat(np.arange(len(row)), count)
        below = (np.arange(len(own)) - np.repeat(np.cumsum(count) - count, count) + 0.5) * gsd
        x = seen.grid.x_min + (column - margin + 0.5 + 0.5 * right) * cell
        y = seen.grid.y_max - (row - margin + 0.5 + 0.5 * down) * cell
        middle = np.stack([x[own], y[own], z[row, column][own] - below], axis=1)
        along = np.array([abs(down), abs(right), 0.0])
        points.append((middle[:, None] + aside[:, None] * along).reshape(-1, 3))
        ways.append(np.tile([float(right), float(-down)], (len(points[-1]), 1)))
    return np.concatenate(points), np.concatenate(ways)


def _firm(heights: Array, alike: float) -> NDArray[np.bool_]:
    """Cells with enough others around them that are about as high."""
    padded = np.pad(heights, AROUND, constant_values=np.nan)
    rows, columns = heights.shape
    count = np.zeros(heights.shape, np.uint8)
    with np.errstate(invalid="ignore"):
        for down in range(2 * AROUND + 1):
            for right in range(2 * AROUND + 1):
                count += np.abs(padded[down : down + rows, right : right + columns] - heights) < alike
    return np.asarray(count >= FIRM)


def _roofs(heights: Array, cell: float, most: float) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    """Firm cells [rows, columns] of pieces as large and as flat as a roof, of those as large as ground, and all flat
    ones."""
    firm = _firm(heights, ALIKE * cell)
    flat = np.zeros(heights.shape, bool)
    flat[firm] = _flat(heights, np.argwhere(firm), cell, most, PLANE)
    piece, count = _pieces(heights, flat, ALIKE * cell)
    size = np.bincount(piece.ravel(), weights=flat.ravel(), minlength=count) * cell**2
    large = size >= max(ROOF_M2, ROOF_CELLS * cell**2)
    asked = flat & large[piece]
    asked[1::2] = asked[:, 1::2] = False  # every second row and column tell as much
    level = _flat(heights, np.argwhere(asked), cell, most, FAR_PLANE)
    of_all = np.bincount(piece[asked], minlength=count)
    share = np.bincount(piece[asked], weights=level, minlength=count) / np.maximum(of_all, 1)
    return flat & (large & (share >= LEVEL))[piece], flat & (size >= GROUND_M2)[piece], flat


def _flat(heights: Array, asked: NDArray[np.intp], cell: float, most: float, reach: int) -> NDArray[np.bool_]:
    """Whether cells [N, 2] (row, column) lie in a plane with those up to so many away that may be of the same roof."""
    steps = np.arange(-reach, reach + 1)
    down, right = (part.ravel() for part in np.meshgrid(steps, steps, indexing="ij"))
    base = np.stack([np.ones(len(down)), down, right], axis=1)
    products = (base[:, :, None] * base[:, None]).reshape(-1, 9)
    allowed = cell * (np.maximum(np.abs(down), np.abs(right)) + 2)  # slopes of 45 degrees and a little more
    padded = np.pad(heights, reach, constant_values=np.nan)
    found = np.zeros(len(asked), bool)
    for start in range(0, len(asked), AT_ONCE):
        some = slice(start, start + AT_ONCE)
        r, c = asked[some].T
        rise = padded[r[:, None] + reach + down, c[:, None] + reach + right] - heights[r, c][:, None]
        with np.errstate(invalid="ignore"):
            same = np.abs(rise) < allowed
        rise = np.where(same, rise, 0.0)
        count, right_side = same.sum(1), rise @ base
        normal = (same @ products).reshape(-1, 3, 3) + 1e-6 * np.eye(3)
        plane = np.linalg.solve(normal, right_side[:, :, None])[:, :, 0]
        squares = (rise**2).sum(1) - (plane * right_side).sum(1)
        found[some] = (count >= 0.4 * len(down)) & (squares < most**2 * count)
    return found


def _pieces(heights: Array, flat: NDArray[np.bool_], alike: float) -> tuple[NDArray[np.intp], int]:
    """The number [rows, columns] of the piece that each flat cell hangs together with, side by side, and how many."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    number = np.arange(heights.size).reshape(heights.shape)
    ends = []
    later, earlier, all_ = slice(1, None), slice(None, -1), slice(None)
    for one, other in (((later, all_), (earlier, all_)), ((all_, later), (all_, earlier))):
        with np.errstate(invalid="ignore"):
            joined = flat[one] & flat[other] & (np.abs(heights[one] - heights[other]) < alike)
        ends.append(np.stack([number[one][joined], number[other][joined]]))
    first, second = np.concatenate(ends, axis=1)
    graph = coo_array((np.ones(len(first), bool), (first, second)), shape=(heights.size, heights.size))
    count, piece = connected_components(graph, directed=False)
    return np.asarray(piece, np.intp).reshape(heights.shape), int(count)


def _foot(
    z: Array,
    ground: NDArray[np.bool_],
    flat: NDArray[np.bool_],
    row: NDArray[np.intp],
    column: NDArray[np.intp],
    way: tuple[int, int],
    step: float,
) -> Array:
    """Height [N] of the ``ground`` before each edge, NaN where there is none, or something as high before it.

    Low things before the wall that are not ``flat`` (trees, bushes, cars) do not count: what they hide of it is not
    blank, or is told hidden. Before flat ones no wall is told: it would end on the roof of an annex.
    """
    top, foot = z[row, column], np.full(len(row), np.nan)
    open_ = np.ones(len(row), bool)
    for k in range(1, GAP + 1):
        at = row + k * way[0], column + k * way[1]
        there = z[at]
        with np.errstate(invalid="ignore"):
            low = top - there > step
            foot_here = open_ & low & ground[at]
            # The first cell may hold points of both, roof and ground.
            stops = np.isfinite(there) & (~low | flat[at]) & ((k > 1) | (top - there < 0.25 * step))
        foot[foot_here] = there[foot_here]
        open_ &= ~foot_here & ~stops
    return foot
