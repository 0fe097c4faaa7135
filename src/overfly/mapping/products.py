"""The rasters made from a cloud: surface model (dsm.tif) and orthophoto (orthophoto.tif)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from overfly.cloud import Cloud
from overfly.errors import InputError
from overfly.files import replacing
from overfly.mapping.raster import Grid, Surface, grid_over, surface

NODATA = -9999.0
MAX_CELLS = 200_000_000


def raster_products(cloud: Cloud, out: Path, *, gsd: float, fill: int = 2) -> Surface:
    """Write ``dsm.tif`` and ``orthophoto.tif`` beside each other, as cloud-optimised GeoTIFFs.

    Args:
        cloud: coloured points; its ``epsg`` becomes the files' CRS, None writes none.
        out: folder.
        gsd: ground sampling distance in the cloud's unit; see :func:`cell_size`.
        fill: passes that close gaps of single cells.

    Returns:
        The surface that was written.

    Raises:
        InputError: the cloud is empty, or its extent does not fit a raster (stray points or a wrong scale).
    """
    if len(cloud) == 0:
        raise InputError("The cloud holds no points, so there is no surface to draw: check the overlap of the images.")
    grid = grid_over(cloud.points, cell_size(cloud, gsd), trim=0.0005)
    if grid.rows * grid.columns > MAX_CELLS:
        raise InputError(
            f"The surface would have {grid.rows} x {grid.columns} cells of {grid.cell:.3g}: the cloud's extent "
            "does not fit its resolution; check the cameras for strays."
        )
    made = surface(cloud, grid, fill=fill)
    heights = np.where(made.filled, made.heights, NODATA).astype(np.float32)
    write_raster(out / "dsm.tif", heights[None], grid, cloud.epsg, nodata=NODATA)
    if made.colors is not None:
        alpha = (made.filled * 255).astype(np.uint8)
        bands = np.concatenate([np.moveaxis(made.colors, -1, 0), alpha[None]])
        write_raster(out / "orthophoto.tif", bands, grid, cloud.epsg)
    return made


def cell_size(cloud: Cloud, gsd: float) -> float:
    """Twice the GSD, or as much more as it takes for three points in a filled cell on average."""
    spread = grid_over(cloud.points, 16 * gsd, trim=0.0005)
    if spread.rows * spread.columns > MAX_CELLS:
        return 2 * gsd
    covered = spread.hit(cloud.points) * spread.cell**2
    cell = max(2 * gsd, 0.5 * float(np.sqrt(3 * covered / len(cloud))))  # a first guess from below saves passes
    while True:
        grid = grid_over(cloud.points, cell, trim=0.0005)
        if grid.rows * grid.columns > MAX_CELLS:
            return cell
        if 3 * (hit := grid.hit(cloud.points)) <= len(cloud) or hit == 1:
            return cell
        cell *= 1.25


def write_raster(path: Path, bands: NDArray, grid: Grid, epsg: int | None, *, nodata: float | None = None) -> None:
    """Write bands [C, rows, columns] as a tiled, deflated GeoTIFF with overviews; atomic.

    Four uint8 bands are red, green, blue and alpha.
    """
    import rasterio
    from rasterio.enums import ColorInterp
    from rasterio.shutil import copy
    from rasterio.transform import Affine

    with rasterio.MemoryFile() as memory, replacing(path) as temporary:
        with memory.open(
            driver="GTiff",
            width=grid.columns,
            height=grid.rows,
            count=len(bands),
            dtype=bands.dtype,
            crs=None if epsg is None else f"EPSG:{epsg}",
            transform=Affine(grid.cell, 0.0, grid.x_min, 0.0, -grid.cell, grid.y_max),
            nodata=nodata,
        ) as source:
            source.write(bands)
            if len(bands) == 4:
                source.colorinterp = [ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha]
        with memory.open() as source:
            predictor = 3 if bands.dtype.kind == "f" else 2
            copy(source, temporary, driver="COG", compress="deflate", predictor=predictor)
