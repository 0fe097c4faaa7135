"""The rasters made from a cloud: surface model (dsm.tif), its sources and orthophoto (orthophoto.tif), by windows.

A window is computed with as many cells around it as its filters look at, so that no border of a window shows. Windows
go to a plain GeoTIFF beside the target, which becomes a cloud-optimised one at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from overfly.cloud import Cloud, concatenate
from overfly.errors import InputError
from overfly.files import replacing
from overfly.geodesy import crs_code
from overfly.mapping.gaps import COARSE, INTERPOLATED, MEASURED, NODATA, PALETTE, PREDICTED, close_gaps
from overfly.mapping.raster import Grid, grid_over, surface
from overfly.mapping.tiles import Tiles
from overfly.mapping.windows import window_over, windows

MAX_CELLS = 200_000_000
"""Cells above which a map must be filled by its points: stray points make a large map of nothing."""

EMPTIEST = 50
"""Cells per point in a map so large, at most; a filled cell has three points or so."""

WINDOW = 1024
"""Cells along a window."""

SAMPLE = 2_000_000
"""Points by which a map's extent is told; twice as many, of whole tiles, tell the size of its cells."""

GDAL_CACHE = 64 * 2**20
"""Bytes that GDAL may hold: by itself it takes a twentieth of the machine."""


class Painter(Protocol):
    """Gives the orthophoto its colours: :class:`overfly.mapping.orthophoto.Orthophoto` from the photographs."""

    def halo(self, cell: float) -> float:
        """How far around a window of cells of that size it looks at the surface, in the grid's unit."""
        ...

    def window(
        self, grid: Grid, surface: Grid, heights: NDArray, doubtful: NDArray[np.bool_]
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """RGB [rows, columns, 3] and alpha [rows, columns] of the cells of ``grid``, from the surface model over it and
        ``halo`` around it, NaN where empty, and which of its cells are interpolated."""
        ...


PainterMaker = Callable[[Grid, NDArray], Painter]
"""Makes a painter from a coarse overview of the whole surface: its grid and heights, NaN where empty."""


def raster_products(
    cloud: Tiles,
    out: Path,
    *,
    gsd: float,
    fill: int = 2,
    painter: PainterMaker | None = None,
    window: int = WINDOW,
    sample: int = SAMPLE,
) -> tuple[Grid, dict[str, float]]:
    """Write ``dsm.tif``, ``dsm_source.tif`` and ``orthophoto.tif`` beside each other, as cloud-optimised GeoTIFFs.

    Args:
        cloud: coloured points; their CRS becomes the files', the vertical one only the surface model's.
        out: folder.
        gsd: ground sampling distance in the cloud's unit, of which two digits are used: the orthophoto's cells are
            as large, the surface model's a whole multiple (see :func:`cell_size`).
        fill: passes that close gaps of single cells; larger ones are closed as :mod:`overfly.mapping.gaps` says.
        painter: colours the orthophoto, in cells of one GSD; None takes the mean colours of the points, in the
            surface model's cells.
        window: cells computed at once, each way; what is written does not depend on it.
        sample: points by which the extent is told; twice as many tell the size of the cells.

    Returns:
        The grid of the surface model, and the share of its cells that is measured, predicted and interpolated.

    Raises:
        InputError: the cloud is empty, or its extent does not fit a raster (stray points or a wrong scale).
    """
    if len(cloud) == 0:
        raise InputError("The cloud holds no points, so there is no surface to draw: check the overlap of the images.")
    few = cloud.sample(sample)
    pixel = float(f"{gsd:.1e}")  # cells with a length that people can read, and that other maps of the place share
    parts = int(np.ceil(cell_size(cloud.some(2 * sample), pixel) / pixel - 0.25))
    grid = grid_over(few.points, float(f"{parts * pixel:.12g}"), trim=0.0005)
    if grid.rows * grid.columns > max(MAX_CELLS, EMPTIEST * len(cloud)):
        raise InputError(
            f"The surface would have {grid.rows} x {grid.columns} cells of {grid.cell:.3g}: the cloud's extent "
            "does not fit its resolution; check the cameras for strays."
        )
    photo, level = out / "orthophoto.tif", None if few.epsg is None else crs_code(few.epsg)
    with (
        _raster(out / "dsm.tif", grid, few.crs, 1, "float32", nodata=NODATA) as heights,
        _raster(out / "dsm_source.tif", grid, level, 1, "uint8", nodata=0) as sources,
    ):
        sources.write_colormap(1, PALETTE)
        if painter is None and few.colors is not None:
            with _raster(photo, grid, level, 4, "uint8") as colors:
                _draw(cloud, grid, fill, window, heights, sources, colors)
        else:
            _draw(cloud, grid, fill, window, heights, sources, None)
        shares = close_gaps(heights, sources, grid, window)
        if painter is not None:
            _paint(heights, sources, grid, painter, grid.cell / parts, photo, level, window)
    return grid, shares


def cell_size(clouds: Sequence[Cloud], gsd: float) -> float:
    """Twice the GSD, or as much more as it takes for three points in a filled cell on average.

    Args:
        clouds: the cloud, or some whole tiles of it.
        gsd: ground sampling distance in their unit.
    """
    count = sum(len(cloud) for cloud in clouds)
    spread = _hit(clouds, 16 * gsd)
    if spread is None:
        return 2 * gsd
    covered = spread * (16 * gsd) ** 2
    cell = max(2 * gsd, 0.5 * float(np.sqrt(3 * covered / count)))  # a first guess from below saves passes
    while (hit := _hit(clouds, cell)) is not None and 3 * hit > count and hit > 1:
        cell *= 1.25
    return cell


def _hit(clouds: Sequence[Cloud], cell: float) -> int | None:
    """Cells with points in them, None where the extent is absurd."""
    step = sum(len(cloud) for cloud in clouds) // 500_000 + 1
    grid = grid_over(np.concatenate([cloud.points[::step] for cloud in clouds]), cell, trim=0.0005)
    if grid.rows * grid.columns > 25 * MAX_CELLS:
        return None
    return grid.hit(*(cloud.points for cloud in clouds))


def _draw(cloud: Tiles, grid: Grid, fill: int, cells: int, heights: Any, sources: Any, colors: Any | None) -> None:
    """Write the surface, where it comes from and, if wanted, the mean colours of its points."""
    for window in windows(grid, cells):
        wide = window.wide(1 + fill)  # one cell for what stands apart, one for each pass that closes gaps
        seen = surface(_points_in(cloud, wide.grid), wide.grid, fill=fill)
        inner = window.inside(wide)
        filled = seen.filled[inner]
        if filled.any():
            shown = np.where(filled, seen.heights[inner], NODATA).astype(np.float32)
            heights.write(shown[None], window=window.place)
            guessed = False if seen.predicted is None else seen.predicted[inner] > 0.5
            source = np.where(seen.counts[inner] == 0, INTERPOLATED, np.where(guessed, PREDICTED, MEASURED))
            sources.write(np.where(filled, source, 0).astype(np.uint8)[None], window=window.place)
            if colors is not None and seen.colors is not None:
                colors.write(_bands(seen.colors[inner], (filled * 255).astype(np.uint8)), window=window.place)


def _points_in(cloud: Tiles, grid: Grid) -> Cloud:
    """What a surface needs of the points in a grid."""
    x_min, x_max, y_min, y_max = grid.extent
    low, high = np.array([x_min, y_min]) - grid.cell, np.array([x_max, y_max]) + grid.cell
    found = [Cloud(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), predicted=np.zeros(0, bool))]
    for i, (least, most) in enumerate(cloud.bounds):
        if (least[:2] <= high).all() and (most[:2] >= low).all():
            tile = cloud.tile(i)
            near = ((tile.points[:, :2] >= low) & (tile.points[:, :2] <= high)).all(1)
            kept = tile[np.asarray(near)]
            found.append(Cloud(kept.points, kept.colors, predicted=kept.predicted))
    return concatenate(found)


def _paint(
    heights: Any, sources: Any, grid: Grid, make: PainterMaker, cell: float, path: Path, crs: str | None, cells: int
) -> None:
    """Write the orthophoto in the colours of a painter, from the surface model that was written before."""
    known = COARSE * grid.cell
    rows, columns = -(-grid.rows // COARSE), -(-grid.columns // COARSE)
    coarse = np.full((rows, columns), np.nan, np.float32)
    for row in range(rows):  # the middle of each cell; one row in memory, whatever the size of the map
        at = min(row * COARSE + COARSE // 2, grid.rows - 1)
        line = heights.read(1, window=((at, at + 1), (0, grid.columns)))[0]
        picked = line[np.minimum(np.arange(columns) * COARSE + COARSE // 2, grid.columns - 1)]
        coarse[row] = np.where(picked == NODATA, np.nan, picked)
    painter = make(Grid(grid.x_min, grid.y_max, known, rows, columns), coarse)
    x_min, x_max, y_min, y_max = grid.extent
    left, top = np.floor(x_min / cell + 1e-6) * cell, np.ceil(y_max / cell - 1e-6) * cell
    size = int(np.ceil((top - y_min) / cell - 1e-6)), int(np.ceil((x_max - left) / cell - 1e-6))
    fine = Grid(float(left), float(top), cell, *size)
    margin = int(np.ceil(painter.halo(cell) / grid.cell)) + 2
    with _raster(path, fine, crs, 4, "uint8") as photo:
        for window in windows(fine, cells):
            around = window_over(grid, window.grid).wide(margin)
            below = heights.read(1, window=around.place)
            below = np.where(below == NODATA, np.nan, below)
            if np.isfinite(below).any():
                doubtful = sources.read(1, window=around.place) == INTERPOLATED
                colors, alpha = painter.window(window.grid, around.grid, below, doubtful)
                photo.write(_bands(colors, alpha), window=window.place)


def _bands(colors: NDArray[np.uint8], alpha: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.concatenate([np.moveaxis(colors, -1, 0), alpha[None]])


@contextmanager
def _raster(
    path: Path, grid: Grid, crs: str | None, count: int, kind: str, *, nodata: float | None = None
) -> Iterator[Any]:
    """A plain GeoTIFF to write windows into, which becomes a cloud-optimised one with overviews, atomically.

    Four bands are red, green, blue and alpha.
    """
    import rasterio
    from rasterio.enums import ColorInterp
    from rasterio.shutil import copy
    from rasterio.transform import Affine

    with rasterio.Env(GDAL_CACHEMAX=GDAL_CACHE), replacing(path) as temporary:
        plain = temporary.with_name("plain.tif")
        with rasterio.open(
            plain,
            "w+",
            driver="GTiff",
            width=grid.columns,
            height=grid.rows,
            count=count,
            dtype=kind,
            crs=crs,
            transform=Affine(grid.cell, 0.0, grid.x_min, 0.0, -grid.cell, grid.y_max),
            nodata=nodata,
            tiled=True,
            blockxsize=512,
            blockysize=512,
            sparse_ok=True,
            bigtiff="if_safer",
        ) as target:
            if count == 4:
                target.colorinterp = [ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha]
            yield target
        predictor = 3 if np.dtype(kind).kind == "f" else 2
        with rasterio.open(plain) as source:
            copy(source, temporary, driver="COG", compress="deflate", predictor=predictor, bigtiff="if_safer")
