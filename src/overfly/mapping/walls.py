"""Walls that one image shows and no pair matches: between a roof's measured edge and the measured ground before it.

A wall is seen from one side, at a flat angle, by few images: pairs find a quarter of it. What stands above and below it
is measured, though, and between the two nothing else can be.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from overfly.cloud import Cloud
from overfly.geometry import Array, Camera, project, unproject
from overfly.mapping.raster import Surface, grid_over, surface

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

LEVEL, FAR_PLANE, ROOF_M2 = 0.5, 4, 20.0
"""Share of a roof's cells that lie in a plane with those up to so many away, and least plan of a roof. Of the crowns of
large trees, which are as flat as roofs along two cells (Tampa), hardly one has so many."""

INWARD = 2
"""Ground pixels by which a wall stands inside the edge that was measured: matching carries roofs beyond their edges."""

FARTHEST = 3.0
"""Median depths beyond which an oblique image shows too little."""

TALLEST = 8.0
"""Ground pixels along the ray that one pixel shows of a wall: what lies farther is another wall, behind it."""

SLACK = 4.0
"""Ground pixels by which what was matched must stand before a wall to hide it."""

CONFIDENCE, SIGMA = 0.95, 2.5
"""Share of such points that lies within 1 % of the camera's height of a surface, and standard deviation across the wall
in ground pixels, on rendered flights at 50 % over blocks, suburb, campus, village and wood."""


def wall_points(
    depth: Map, measured: NDArray[np.bool_], camera: Camera, world_from_camera: Array
) -> tuple[Array, NDArray[np.intp], NDArray[np.intp]]:
    """Points on the walls that a frame shows in its blank pixels.

    Args:
        depth: [H, W] of the frame, metres, NaN where blank.
        measured: where pairs have matched it; elsewhere it is a guess, beside which no wall is told.
        camera: undistorted, of the same size.
        world_from_camera: [4, 4], z up.

    Returns:
        Points [N, 3] a ground pixel apart, and the rows and columns [N] that show them.
    """
    nothing = np.zeros((0, 3)), np.zeros(0, np.intp), np.zeros(0, np.intp)
    known = np.isfinite(depth)
    if not (known & measured).any():
        return nothing
    middle = float(np.median(depth[known & measured]))
    rows, columns = np.nonzero(known & (depth < FARTHEST * middle))
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=1)
    points = unproject(pixels, depth[rows, columns], camera, world_from_camera)
    gsd = middle / camera.fx
    cell = max(CELL_M, CELL_PIXELS * gsd)
    seen = surface(Cloud(points, predicted=~measured[rows, columns]), grid_over(points, cell, trim=0.0005), fill=2)
    found, outward = _curtains(seen, gsd)
    if not len(found):
        return nothing
    facing = ((world_from_camera[:2, 3] - found[:, :2]) * outward).sum(1) > 0
    found, outward = found[facing], outward[facing]
    at, away = project(found, camera, world_from_camera)
    column, row = np.floor(np.nan_to_num(at, nan=-1)).astype(np.intp).T
    inside = (away > 0) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    shown = np.flatnonzero(inside)
    with np.errstate(invalid="ignore"):
        shown = shown[~(depth[row[shown], column[shown]] < away[shown] - SLACK * gsd)]
    flat = row[shown] * camera.width + column[shown]
    nearest = np.full(camera.height * camera.width, np.inf)
    np.minimum.at(nearest, flat, away[shown])
    shown = shown[away[shown] < nearest[flat] + TALLEST * gsd]
    found[:, :2] -= INWARD * gsd * outward  # after it was looked for where its edge was seen
    return found[shown], row[shown], column[shown]


def _curtains(seen: Surface, gsd: float) -> tuple[Array, Array]:
    """Points [N, 3] one ground pixel apart under the edges of roofs, and the way [N, 2] that each wall faces."""
    cell, step = seen.grid.cell, max(STEP_M, STEP_PIXELS * gsd)
    told = seen.filled if seen.predicted is None else seen.filled & ~(seen.predicted > 0.5)
    measured = np.where(told, seen.heights, np.nan)
    firm = _firm(measured, ALIKE * cell)
    most = max(FLAT_M, FLAT_PIXELS * gsd)
    flat, level = (firm & _flat(measured, cell, most, reach) for reach in (PLANE, FAR_PLANE))
    roof = _roofs(measured, flat, level, ALIKE * cell, cell)
    margin = GAP + 1
    z = np.pad(seen.heights, margin, constant_values=np.nan)
    firm, roof = np.pad(firm, margin), np.pad(roof, margin)
    parts = max(1, round(cell / gsd))  # points side by side on the border of a cell
    aside = ((np.arange(parts) + 0.5) / parts - 0.5) * cell
    points, ways = [np.zeros((0, 3))], [np.zeros((0, 2))]
    for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        with np.errstate(invalid="ignore"):
            edge = roof & ~(np.roll(z, (-down, -right), (0, 1)) > z - step)
        row, column = np.nonzero(edge)
        ground = _ground(z, firm, row, column, (down, right), step)
        held = np.isfinite(ground)
        row, column, ground = row[held], column[held], ground[held]
        count = ((z[row, column] - ground) / gsd).astype(np.intp)
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
    count = np.zeros(heights.shape, np.uint8)
    for beside, _, _ in _shifted(heights, AROUND):
        with np.errstate(invalid="ignore"):
            count += np.abs(beside - heights) < alike
    return np.asarray(count >= FIRM)


def _flat(heights: Array, cell: float, most: float, reach: int) -> NDArray[np.bool_]:
    """Cells that lie in a plane with those up to so many away that may be of the same roof."""

    def of_the_roof() -> Iterator[tuple[Array, NDArray[np.bool_], int, int]]:
        for beside, down, right in _shifted(heights, reach):
            with np.errstate(invalid="ignore"):  # slopes of 45 degrees and a little more
                same = np.abs(beside - heights) < cell * (max(abs(down), abs(right)) + 2)
            yield np.where(same, beside - heights, 0.0), same, down, right

    sums = np.zeros((9, *heights.shape))
    for rise, same, down, right in of_the_roof():
        terms = (1, down, right, down * down, down * right, right * right)
        sums[:6] += np.array(terms, float)[:, None, None] * same
        sums[6:] += np.array([1, down, right], float)[:, None, None] * rise
    count, y, x, yy, xy, xx, z, zy, zx = sums
    normal = np.stack([count, y, x, y, yy, xy, x, xy, xx], axis=-1).reshape(*heights.shape, 3, 3) + 1e-6 * np.eye(3)
    plane = np.linalg.solve(normal, np.stack([z, zy, zx], axis=-1)[..., None])[..., 0]
    squares = np.zeros(heights.shape)
    for rise, same, down, right in of_the_roof():
        squares += np.where(same, rise - plane @ np.array([1.0, down, right]), 0.0) ** 2
    return np.asarray((count >= 0.4 * (2 * reach + 1) ** 2) & (squares < most**2 * count))


def _shifted(heights: Array, reach: int) -> Iterator[tuple[Array, int, int]]:
    """The heights of the cells up to so many down and to the right of each, and how far."""
    padded = np.pad(heights, reach, constant_values=np.nan)
    rows, columns = heights.shape
    for down in range(-reach, reach + 1):
        for right in range(-reach, reach + 1):
            first, left = reach + down, reach + right
            yield padded[first : first + rows, left : left + columns], down, right


def _roofs(
    heights: Array, flat: NDArray[np.bool_], level: NDArray[np.bool_], alike: float, cell: float
) -> NDArray[np.bool_]:
    """The flat cells [rows, columns] that hang together in pieces as large and as ``level`` as a roof."""
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
    _, piece = connected_components(graph, directed=False)
    size, of_planes = (np.bincount(piece, weights=part.ravel()) for part in (flat, flat & level))
    roof = (size * cell**2 >= ROOF_M2) & (of_planes >= LEVEL * size)
    return flat & roof[piece].reshape(heights.shape)


def _ground(
    z: Array,
    firm: NDArray[np.bool_],
    row: NDArray[np.intp],
    column: NDArray[np.intp],
    way: tuple[int, int],
    step: float,
) -> Array:
    """Height [N] of the measured ground before each edge, NaN where there is none, or something else before it."""
    top, ground = z[row, column], np.full(len(row), np.nan)
    open_ = np.ones(len(row), bool)
    for k in range(1, GAP + 1):
        at = row + k * way[0], column + k * way[1]
        there = z[at]
        with np.errstate(invalid="ignore"):
            low = open_ & (top - there > step) & firm[at]
            # The first cell may hold points of both, roof and ground.
            open_ &= ~low & ~(np.isfinite(there) & ((k > 1) | (top - there < 0.25 * step)))
        ground[low] = there[low]
    return ground
