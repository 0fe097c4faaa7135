"""The rough mesh: a dense cloud as a triangulated height field, with colours, within a budget of faces.

Steep faces stand where walls are: their vertices are free to move in all three directions afterwards.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from overfly.cloud import Cloud
from overfly.errors import InputError
from overfly.mapping.raster import Grid, grid_over, surface
from overfly.mesh import Mesh

FILL = 12
"""Cells from the nearest measured one up to which gaps are closed."""

PARTS = 4
"""Parts of a cell along each side, of which the one with the median height is taken."""

TRIM = 0.001
"""Share of the points left out on each side of the grid: single stray points."""

SPIKE = 3.0
"""Cells by which a vertex of a spike differs in height from its neighbours."""

NO_GROUND = "The cloud covers no connected ground: a mesh needs points that lie beside each other."


def rough_mesh(cloud: Cloud, *, faces: int) -> Mesh:
    """Triangulate the upper surface of a cloud.

    Args:
        cloud: N points, z up.
        faces: about so many triangles; within a tenth from 1000 on, where a row of cells counts for less.

    Returns:
        One connected height field or several, counter-clockwise seen from above, with the cloud's colours if it has
        any. Vertices stand in the middle of grid cells; each has a face.

    Raises:
        InputError: fewer than 8 faces are asked for, or the cloud covers too little for a mesh.
    """
    if faces < 8:
        raise InputError(f"A mesh of {faces} faces shows no landscape: ask for 1000 or more.")
    if len(cloud) < 8:
        raise InputError(f"{len(cloud)} points are too few for a mesh: give a dense cloud.")
    low, high = np.quantile(cloud.points[:, :2], [TRIM, 1 - TRIM], axis=0)
    width, depth = high - low
    if min(width, depth) * faces <= max(width, depth):  # a line: its cells would be without number
        raise InputError(NO_GROUND)
    cell = float(np.sqrt(2 * width * depth / faces))
    mesh = _triangulated(cloud, grid_over(cloud.points, cell, trim=TRIM))
    for _ in range(4):  # the covered share of the grid depends a little on its cells
        if not len(mesh.faces) or 0.9 * faces <= len(mesh.faces) <= 1.05 * faces:
            break
        cell *= max(float(np.sqrt(len(mesh.faces) / (0.98 * faces))), 0.5)  # not at once to cells without number
        mesh = _triangulated(cloud, grid_over(cloud.points, cell, trim=TRIM))
    if not len(mesh.faces):
        raise InputError(NO_GROUND)
    return mesh


def filled_share(mesh: Mesh, cloud: Cloud) -> float:
    """Share of a height field's plan that only closes gaps: faces with no point near their middle, seen from above.

    Args:
        mesh: of :func:`rough_mesh`.
        cloud: it was made from.
    """
    from scipy.spatial import cKDTree

    corners = mesh.vertices[mesh.faces][:, :, :2]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    plan = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / 2
    near = np.sqrt(2 * float(np.median(plan)))  # a cell: each holds two faces
    away, _ = cKDTree(cloud.points[:, :2]).query(corners.mean(1), distance_upper_bound=near)
    return float(plan[~np.isfinite(away)].sum() / plan.sum())


def _triangulated(cloud: Cloud, grid: Grid) -> Mesh:
    heights, colors = _medians(cloud, grid)
    known = np.isfinite(heights)
    quads = known[:-1, :-1] & known[:-1, 1:] & known[1:, :-1] & known[1:, 1:]
    row, column = np.nonzero(quads)
    north_west = row * grid.columns + column
    corners = np.stack([north_west, north_west + grid.columns, north_west + grid.columns + 1, north_west + 1], axis=1)
    z = heights.ravel()[corners]
    # The diagonal between the two corners that are nearer in height follows edges of roofs instead of cutting them.
    falling = np.abs(z[:, 0] - z[:, 2]) <= np.abs(z[:, 1] - z[:, 3])
    triangles = np.concatenate(
        [
            corners[falling][:, [0, 1, 2]],
            corners[falling][:, [0, 2, 3]],
            corners[~falling][:, [0, 1, 3]],
            corners[~falling][:, [1, 2, 3]],
        ]
    )
    used, faces = np.unique(triangles, return_inverse=True)
    xy = grid.centres().reshape(-1, 2)[used]
    vertices = np.column_stack([xy, heights.ravel()[used]])
    return Mesh(vertices, faces.reshape(-1, 3).astype(np.int32), None if colors is None else colors[used])


def _medians(cloud: Cloud, grid: Grid) -> tuple[NDArray[np.float64], NDArray[np.uint8] | None]:
    """Height [rows, columns] (NaN where unknown) and colour [cells, 3]: those of the part with the median height.

    A mean over a cell that is half roof and half street would be neither.
    """
    fine = Grid(grid.x_min, grid.y_max, grid.cell / PARTS, grid.rows * PARTS, grid.columns * PARTS)
    seen = surface(cloud, fine, fill=FILL * PARTS)

    def parts(values: NDArray) -> NDArray:
        blocks = values.reshape(grid.rows, PARTS, grid.columns, PARTS, -1).swapaxes(1, 2)
        return np.asarray(blocks.reshape(grid.rows * grid.columns, PARTS**2, -1))

    heights = parts(seen.heights)[..., 0]
    order, known = heights.argsort(axis=1), np.isfinite(heights).sum(1)  # NaN last
    cell = np.arange(len(heights))
    middle = order[cell, np.maximum(known - 1, 0) // 2]
    colors = None if seen.colors is None else parts(seen.colors)[cell, middle]
    return np.where(known > 0, heights[cell, middle], np.nan).reshape(grid.rows, grid.columns), colors


def without_spikes(mesh: Mesh) -> Mesh:
    """A height field without single vertices and pairs that stand apart from all others: stray points, bare stems.

    A vertex with three neighbours or more of which fewer than two join it within :data:`SPIKE` cells in height takes
    the median height, and the colour, of those that are no spikes.
    """
    z = mesh.vertices[:, 2]
    ends = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]).astype(np.int64)
    # Sides inside the mesh appear once each way, those of its outline once.
    keys = np.unique(np.concatenate([ends, ends[:, ::-1]]) @ [len(z), 1])
    ends = np.column_stack(np.divmod(keys, len(z)))
    near, count = np.abs(z[ends[:, 0]] - z[ends[:, 1]]) <= SPIKE * cell_of(mesh), np.bincount(ends[:, 0])
    spike = (count >= 3) & (np.bincount(ends[:, 0], near) < 2)
    ends = ends[spike[ends[:, 0]] & ~spike[ends[:, 1]]]
    order = np.lexsort((z[ends[:, 1]], ends[:, 0]))
    spikes, first, beside = np.unique(ends[order, 0], return_index=True, return_counts=True)
    middle = ends[order, 1][first + beside // 2]
    vertices, colors = mesh.vertices.copy(), None if mesh.colors is None else mesh.colors.copy()
    vertices[spikes, 2] = z[middle]
    if colors is not None:
        colors[spikes] = colors[middle]
    return Mesh(vertices, mesh.faces, colors)


def cell_of(mesh: Mesh) -> float:
    """Side of the squares of which two faces each make one."""
    a, b, c = (mesh.vertices[mesh.faces[:, i], :2] for i in range(3))
    (u, v), (x, y) = (b - a).T, (c - a).T
    return float(np.sqrt(np.median(np.abs(u * y - v * x))))
