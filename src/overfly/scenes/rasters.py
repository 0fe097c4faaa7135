"""Scenes from height rasters: a DSM with an orthophoto, and lidar clouds, which become one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from overfly.cloud import Cloud
from overfly.errors import InputError
from overfly.geometry import Origin, enu_from_crs
from overfly.scenes import materials as m
from overfly.scenes.envelope import lower_envelope, nearest_fill
from overfly.scenes.scene import Scene

Array = NDArray[np.float64]

MAX_CELLS = 3_000_000
"""Finer rasters are read at a coarser cell, so that a scene stays below six million triangles."""

MAX_TEXTURE = 8192


def from_cloud(cloud: Cloud, name: str) -> Scene:
    """A coloured surface from a lidar cloud.

    Cells are about the spacing of the points (0.1 m at least). A cell takes its highest point, unless that stands alone
    more than 12 m above the cells around it (a bird). Gaps of single cells take the mean of their neighbours; larger
    holes (occlusions beside walls, water) are filled from their lower rim, because what is hidden from above is ground.
    """
    points = cloud.points
    low, high = points[:, :2].min(0), points[:, :2].max(0)
    if len(points) < 100 or not (high - low > 0).all():
        raise InputError(f"The cloud {name} has {len(points)} points over no area: a scene needs at least 100, spread out.")
    if cloud.epsg and _is_geographic(cloud.epsg):
        raise InputError(f"The cloud {name} is in degrees (EPSG:{cloud.epsg}): give it in a projected CRS, for example UTM.")
    probe = max(float((high - low).max()) / 400, 1e-6)
    cells = len(np.unique(np.floor((points[:, :2] - low) / probe).astype(np.int64) @ [100_000, 1]))
    cell = max(0.1, 1.25 * np.sqrt(cells * probe**2 / len(points)), np.sqrt(np.prod(high - low) / MAX_CELLS))
    cols, rows = (int(v) for v in np.floor((high - low) / cell) + 1)
    index = np.floor((points[:, :2] - low) / cell).astype(np.int64)
    flat = (rows - 1 - index[:, 1]) * cols + index[:, 0]  # row 0 is the north
    top = np.full(rows * cols, -np.inf)
    np.maximum.at(top, flat, points[:, 2])
    known = np.isfinite(top)
    surface = np.where(known, top, np.nan).reshape(rows, cols)
    surface = _without_spikes(surface)
    texture = None
    if cloud.colors is not None:
        near_top = points[:, 2] >= np.nan_to_num(surface.ravel()[flat], nan=np.inf) - 0.5
        count = np.bincount(flat[near_top], minlength=rows * cols)
        colors = np.stack(
            [np.bincount(flat[near_top], cloud.colors[near_top, k], minlength=rows * cols) for k in range(3)], -1
        )
        mean = (colors / np.maximum(count, 1)[:, None]).reshape(rows, cols, 3)
        row, col = ndimage.distance_transform_edt((count == 0).reshape(rows, cols), return_distances=False, return_indices=True)
        texture = np.rint(mean[row, col]).astype(np.uint8)
    surface = _fill_holes(surface)
    x = low[0] + (np.arange(cols) + 0.5) * cell
    y = low[1] + (rows - np.arange(rows) - 0.5) * cell
    gx, gy = np.meshgrid(x, y)
    return _grid_scene(name, gx, gy, surface, None, texture, cloud.epsg, cell)


def _is_geographic(epsg: int) -> bool:
    from pyproj import CRS

    return bool(CRS.from_epsg(epsg).is_geographic)


def _without_spikes(z: Array, jump: float = 12.0) -> Array:
    around = ndimage.median_filter(nearest_fill(z), 5, mode="nearest")
    high = np.isfinite(z) & (z > around + jump)
    labels, count = ndimage.label(high, np.ones((3, 3)))
    small = np.concatenate([[False], np.bincount(labels.ravel(), minlength=count + 1)[1:] <= 3])
    return np.where(small[labels], np.nan, z)


def _fill_holes(z: Array) -> Array:
    """Fill gaps and enclosed holes; what lies outside the cloud stays NaN."""
    eight = np.ones((3, 3))
    missing = ~np.isfinite(z)
    # The cloud's area: known cells, closed over gaps of up to 8 cells, and everything enclosed.
    padded = np.pad(~missing, 8)
    area = ndimage.binary_fill_holes(ndimage.binary_closing(padded, eight, iterations=8))[8:-8, 8:-8]
    neighbours = ndimage.convolve((~missing).astype(float), eight, mode="constant")
    total = ndimage.convolve(np.where(missing, 0.0, z), eight, mode="constant")
    single = missing & (neighbours >= 5)
    spread = ndimage.maximum_filter(np.where(missing, -np.inf, z), 3) - ndimage.minimum_filter(np.where(missing, np.inf, z), 3)
    single &= spread < 1.0  # across an edge the lower side is right
    z = np.where(single, total / np.maximum(neighbours, 1), z)
    for _ in range(4 * max(z.shape)):
        missing = ~np.isfinite(z) & area
        if not missing.any():
            break
        lowest = ndimage.minimum_filter(np.where(np.isfinite(z), z, np.inf), 3, mode="constant", cval=np.inf)
        grown = missing & np.isfinite(lowest)
        if not grown.any():
            break
        z = np.where(grown, lowest, z)
    return z


def from_dsm(path: Path, orthophoto: Path | None) -> Scene:
    """A surface from a height raster; coloured by an orthophoto that is given or lies beside it."""
    from rasterio.enums import Resampling

    data, transform, epsg, factor = _read(path, 1, MAX_CELLS, Resampling.average)
    z = np.where(data[0].mask | ~np.isfinite(data[0].filled(np.nan)), np.nan, data[0].filled(np.nan)) * factor
    if min(z.shape) < 2 or np.isfinite(z).sum() < 4:
        raise InputError(f"The height raster {path} holds no heights (all nodata or NaN): give a DSM.")
    rows, cols = z.shape
    col, row = np.meshgrid(np.arange(cols) + 0.5, np.arange(rows) + 0.5)
    x = transform.a * col + transform.b * row + transform.c
    y = transform.d * col + transform.e * row + transform.f
    uv, texture = None, None
    photo = orthophoto or next(
        (p for p in (path.with_name(f"{path.stem}_ortho.tif"), path.with_name("orthophoto.tif")) if p.is_file()), None
    )
    if photo is not None:
        if not photo.is_file():
            raise InputError(f"The orthophoto {photo} does not exist.")
        image, placed, photo_epsg, _ = _read(photo, 3, MAX_TEXTURE**2, Resampling.average)
        px, py = x.ravel(), y.ravel()
        if photo_epsg != epsg and photo_epsg and epsg:
            from pyproj import Transformer

            px, py = Transformer.from_crs(epsg, photo_epsg, always_xy=True).transform(px, py)
        u, v = (~placed) * (px, py)
        uv = np.stack([u / image.shape[2], 1 - v / image.shape[1]], -1).reshape(rows, cols, 2)
        if not ((uv >= 0) & (uv <= 1)).all(-1).mean() > 0.01:
            raise InputError(f"The orthophoto {photo} does not cover the height raster {path}: check their CRS.")
        texture = np.moveaxis(image.filled(0), 0, -1)
        if texture.dtype != np.uint8:
            top = max(float(np.percentile(texture, 99.5)), 1e-9)
            texture = np.clip(texture / top * 255, 0, 255)
        texture = np.ascontiguousarray(texture.astype(np.uint8))
    step = float(np.hypot(transform.a, transform.d))
    return _grid_scene(path.stem, x, y, z, uv, texture, epsg, step)


def _read(path: Path, bands: int, most: int, resampling: Any) -> tuple[np.ma.MaskedArray, Any, int | None, float]:
    """Bands, their affine transform, EPSG code and metres per vertical unit of a raster, thinned to ``most`` cells."""
    import rasterio
    from rasterio.errors import RasterioError

    try:
        with rasterio.open(path) as file:
            if file.count < bands and bands > 1:
                raise InputError(f"The orthophoto {path} has {file.count} bands: give one with red, green and blue.")
            thin = max(1.0, float(np.sqrt(file.width * file.height / most)))
            rows, cols = max(1, int(file.height / thin)), max(1, int(file.width / thin))
            data = file.read(list(range(1, bands + 1)), out_shape=(bands, rows, cols), masked=True, resampling=resampling)
            transform = file.transform * file.transform.scale(file.width / cols, file.height / rows)
            epsg = file.crs.to_epsg() if file.crs else None
            # A DSM in a CRS of feet has its heights in feet too.
            factor = float(file.crs.linear_units_factor[1]) if file.crs and file.crs.is_projected else 1.0
    except RasterioError as error:
        raise InputError(f"{path} is not a readable raster ({error}): give a GeoTIFF.") from error
    return data.astype(np.float64 if bands == 1 else data.dtype), transform, epsg, factor


def _grid_scene(
    name: str, x: Array, y: Array, z: Array, uv: Array | None, texture: NDArray | None, epsg: int | None, cell: float
) -> Scene:
    """A scene from a grid of places [rows, cols] (row 0 north) in file coordinates; cells without height are left out."""
    known = np.isfinite(z)
    origin, offset = None, np.zeros(3)
    if epsg is not None:
        middle = np.array([[np.mean([x.min(), x.max()]), np.mean([y.min(), y.max()]), float(np.median(z[known]))]])
        origin = _origin(middle[0], epsg)
        local = enu_from_crs(np.stack([x.ravel(), y.ravel(), np.where(known, z, middle[0, 2]).ravel()], -1), origin, epsg)
        x, y, z = local[:, 0].reshape(z.shape), local[:, 1].reshape(z.shape), np.where(known, local[:, 2].reshape(z.shape), np.nan)
        cell = float(np.hypot(x[0, 1] - x[0, 0], y[0, 1] - y[0, 0]))
    elif max(np.abs(x).max(), np.abs(y).max()) > 10_000:
        offset = np.round([np.mean([x.min(), x.max()]), np.mean([y.min(), y.max()]), 0.0])
        x, y = x - offset[0], y - offset[1]
    index = np.full(z.shape, -1)
    index[known] = np.arange(known.sum())
    a, b, c, d = index[1:, :-1], index[1:, 1:], index[:-1, 1:], index[:-1, :-1]  # from the south-west, counter-clockwise
    whole = (a >= 0) & (b >= 0) & (c >= 0) & (d >= 0)
    if not whole.any():
        raise InputError(f"The height raster {name} has no four neighbouring cells with heights: nothing to render.")
    # The diagonal that is nearer to level keeps ridges and eaves straight.
    rising = np.abs(z[1:, :-1] - z[:-1, 1:])[whole] <= np.abs(z[1:, 1:] - z[:-1, :-1])[whole]
    a, b, c, d = a[whole], b[whole], c[whole], d[whole]
    first = np.where(rising[:, None], np.stack([a, b, c], -1), np.stack([a, b, d], -1))
    second = np.where(rising[:, None], np.stack([a, c, d], -1), np.stack([b, c, d], -1))
    faces = np.stack([first, second], 1).reshape(-1, 3).astype(np.int32)
    filled = nearest_fill(z)
    slope_y, slope_x = np.gradient(filled, cell)
    normal = np.stack([-slope_x, slope_y, np.ones_like(filled)], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    vertices = np.stack([x, y, filled], -1)[known].astype(np.float32).astype(np.float64)
    if uv is None and texture is not None:
        rows, cols = z.shape
        col, row = np.meshgrid((np.arange(cols) + 0.5) / cols, 1 - (np.arange(rows) + 0.5) / rows)
        uv = np.stack([col, row], -1)
    shape = np.zeros((len(faces), 4), np.float32)
    if texture is not None and uv is not None:
        shape[:, 0] = np.median(np.abs(np.diff(uv[..., 0], axis=1))) * texture.shape[1] / cell
    half = cell / 2
    low, high = vertices.min(0), vertices.max(0)
    coarse = max(1, round(2.0 / cell))
    ground_z = filled[::-1][: z.shape[0] // coarse * coarse, : z.shape[1] // coarse * coarse]
    blocks = ground_z.reshape(ground_z.shape[0] // coarse, coarse, ground_z.shape[1] // coarse, coarse).min((1, 3))
    lines_x = low[0] - half + (np.arange(blocks.shape[1]) + 0.5) * coarse * cell
    lines_y = low[1] - half + (np.arange(blocks.shape[0]) + 0.5) * coarse * cell
    if min(blocks.shape) < 2:
        raise InputError(f"The height raster {name} covers less than two cells of ground: give a larger one.")
    grey = 0.3
    return Scene(
        name=name,
        vertices=vertices,
        faces=faces,
        normals=normal[known].astype(np.float32),
        material=np.full(len(faces), m.PAINT if texture is None else m.TEXTURE, np.int32),
        paint=np.tile(np.float32([grey, grey, grey, 0]), (len(faces), 1)),
        shape=shape,
        terrain=lower_envelope(lines_x, lines_y, blocks),
        extent=(float(low[0]), float(low[1]), float(high[0]), float(high[1])),
        uv=None if uv is None else uv[known].astype(np.float32),
        texture=texture,
        origin=origin,
        offset=(float(offset[0]), float(offset[1]), float(offset[2])),
    )


def _origin(middle: Array, epsg: int) -> Origin:
    from pyproj import Transformer

    lon, lat = Transformer.from_crs(epsg, 4979, always_xy=True).transform(middle[0], middle[1])[:2]
    return Origin(float(lat), float(lon), float(middle[2]), None if _is_geographic(epsg) else epsg)
