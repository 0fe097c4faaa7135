"""Gaps of the surface model, closed by interpolation between the cells around them, and told apart from what is known.

What lies between known ground is worth a height to whoever looks at the map, and no more than that: beside the surface
model, ``dsm_source.tif`` says of every cell whether it was measured, predicted or interpolated.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from overfly.mapping.raster import Grid
from overfly.mapping.windows import Window, windows

MEASURED, PREDICTED, INTERPOLATED = 1, 2, 3
"""Values of ``dsm_source.tif``; 0 where the surface model is empty."""

SOURCES = {MEASURED: "measured", PREDICTED: "predicted", INTERPOLATED: "interpolated"}

PALETTE = {
    0: (0, 0, 0, 0),
    MEASURED: (92, 176, 153, 255),
    PREDICTED: (242, 158, 69, 255),
    INTERPOLATED: (90, 80, 140, 255),
}
"""Colours in which ``dsm_source.tif`` opens: those of the report, told apart by eyes that mix red and green, too."""

NODATA = -9999.0

COARSE = 8
"""Cells along a cell of the overview in which gaps are interpolated."""

REACH = 6
"""Cells of the overview from known ones up to which open gaps and bays are closed: a strip of twice as many."""

HOLE = 24
"""The same for a hole with known cells all around: beyond that it may be a lake, or ground that nobody flew over."""


def close_gaps(heights: Any, sources: Any, grid: Grid, cells: int) -> dict[str, float]:
    """Fill the empty cells between known ones in an open raster of heights, and mark them in another.

    Args:
        heights: rasterio data set of the surface model, :data:`NODATA` where empty; altered.
        sources: rasterio data set of the same cells, with :data:`MEASURED` and :data:`PREDICTED`; altered.
        grid: of both.
        cells: of a window, each way; what is written does not depend on it.

    Returns:
        Share of the filled cells that are ``measured``, ``predicted`` and ``interpolated``.
    """
    coarse = _overview(heights, grid)
    between = _between(np.isfinite(coarse))
    smooth = _interpolated(coarse, between)
    counts = np.zeros(len(SOURCES) + 1, np.int64)
    for window in windows(grid, cells):
        z = heights.read(1, window=window.place)
        source = sources.read(1, window=window.place)
        said, inside = (_on_cells(layer, window) for layer in (smooth, between.astype(np.float32)))
        gap = (z == NODATA) & (inside >= 0.5) & np.isfinite(said)
        if gap.any():
            heights.write(np.where(gap, said, z).astype(np.float32)[None], window=window.place)
            source = np.where(gap, np.uint8(INTERPOLATED), source)
            sources.write(source[None], window=window.place)
        counts += np.bincount(source.ravel(), minlength=len(counts))
    return {name: round(float(counts[value] / max(counts[1:].sum(), 1)), 4) for value, name in SOURCES.items()}


def _overview(heights: Any, grid: Grid) -> NDArray[np.float32]:
    """Mean of the known cells in every :data:`COARSE` x :data:`COARSE` of them, NaN without any."""
    rows, columns = -(-grid.rows // COARSE), -(-grid.columns // COARSE)
    coarse = np.full((rows, columns), np.nan, np.float32)
    for row in range(rows):
        strip = (row * COARSE, min((row + 1) * COARSE, grid.rows)), (0, grid.columns)
        z = np.full((COARSE, columns * COARSE), np.nan)
        part = heights.read(1, window=strip)
        z[: len(part), : grid.columns] = np.where(part == NODATA, np.nan, part)
        cells = z.reshape(COARSE, columns, COARSE)
        known = np.isfinite(cells).sum((0, 2))
        total = np.nansum(cells, axis=(0, 2))
        coarse[row, known > 0] = total[known > 0] / known[known > 0]
    return coarse


def _between(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells of the overview that known ones enclose or nearly so; without the outermost ones, known in part."""
    from scipy.ndimage import binary_erosion, binary_fill_holes, distance_transform_edt, label, maximum

    padded = np.pad(known, REACH + 1)
    grown = distance_transform_edt(~padded) <= REACH
    closed = (distance_transform_edt(grown) > REACH) | padded
    holes = binary_fill_holes(closed) & ~closed
    numbers, count = label(holes)
    if count:
        deepest = maximum(distance_transform_edt(~padded), numbers, np.arange(count + 1))
        small = np.asarray(deepest) <= HOLE
        small[0] = False
        closed |= small[numbers]
    inner = slice(REACH + 1, -REACH - 1)
    return np.asarray(binary_erosion(closed, np.ones((3, 3), bool))[inner, inner])


def _interpolated(coarse: NDArray[np.float32], between: NDArray[np.bool_]) -> NDArray[np.float32]:
    """The overview with the heights of a membrane that hangs between known cells; NaN where nothing holds it.

    Laplace's equation with free ends where a bay is open: a plane is carried on as a plane, and no height lies beyond
    those around it.
    """
    from scipy.ndimage import binary_dilation
    from scipy.sparse import csc_array
    from scipy.sparse.linalg import spsolve

    known = np.isfinite(coarse)
    # One cell more all around, so that heights between the middles of cells are there, too.
    asked = binary_dilation(between, np.ones((3, 3), bool)) & ~known
    asked &= _held(asked, known)
    full = coarse.copy()
    if not asked.any():
        return full
    number = np.cumsum(asked.ravel()).reshape(asked.shape) - 1
    count = int(asked.sum())
    ends, values, degree = [], np.zeros(count), np.zeros(count)
    later, earlier = slice(1, None), slice(None, -1)
    for axis in (0, 1):
        for one, other in ((later, earlier), (earlier, later)):
            at = tuple(one if k == axis else slice(None) for k in (0, 1))
            by = tuple(other if k == axis else slice(None) for k in (0, 1))
            fixed = asked[at] & known[by]
            free = asked[at] & asked[by]
            np.add.at(values, number[at][fixed], coarse[by][fixed].astype(np.float64))
            np.add.at(degree, number[at][fixed | free], 1.0)
            ends.append(np.stack([number[at][free], number[by][free]]))
    row, column = np.concatenate(ends, axis=1)
    own = np.arange(count)
    matrix = csc_array(
        (np.concatenate([-np.ones(len(row)), degree]), (np.concatenate([row, own]), np.concatenate([column, own]))),
        shape=(count, count),
    )
    full[asked] = spsolve(matrix, values)
    return full


def _held(asked: NDArray[np.bool_], known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which asked cells hang together, side by side, with a known one."""
    from scipy.ndimage import binary_dilation, label

    numbers, count = label(asked)
    touched = np.zeros(count + 1, bool)
    touched[numbers[binary_dilation(known) & asked]] = True
    touched[0] = False
    return np.asarray(touched[numbers])


def _on_cells(coarse: NDArray[np.float32], window: Window) -> NDArray[np.float32]:
    """A layer of the overview at the cells of a window, bilinear."""
    import cv2

    places, parts = [], []
    for part, size in zip((window.rows, window.columns), coarse.shape, strict=True):
        first = max(part.start // COARSE - 1, 0)
        parts.append(slice(first, min(-(-part.stop // COARSE) + 1, size)))  # OpenCV takes no side of 32,767 and more
        at = (np.arange(part.start, part.stop) + 0.5) / COARSE - 0.5
        places.append((np.clip(at, 0, size - 1) - first).astype(np.float32))
    x, y = np.meshgrid(places[1], places[0])
    piece = np.ascontiguousarray(coarse[parts[0], parts[1]])
    return np.asarray(cv2.remap(piece, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
