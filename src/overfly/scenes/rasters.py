"""Scenes from height rasters: a DSM with an orthophoto, or any grid of heights."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from overfly.errors import InputError
from overfly.geodesy import Origin, enu_from_crs, epsg_codes
from overfly.scenes import materials as m
from overfly.scenes.envelope import lower_envelope, nearest_fill
from overfly.scenes.scene import Scene

Array = NDArray[np.float64]

MAX_CELLS = 3_000_000
"""Finer rasters are read at a coarser cell, so that a scene stays below six million triangles."""

MAX_TEXTURE = 8192


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
        back = ~placed
        u, v = back.a * px + back.b * py + back.c, back.d * px + back.e * py + back.f
        uv = np.stack([u / image.shape[2], 1 - v / image.shape[1]], -1).reshape(rows, cols, 2)
        if not ((uv >= 0) & (uv <= 1)).all(-1).mean() > 0.01:
            raise InputError(f"The orthophoto {photo} does not cover the height raster {path}: check their CRS.")
        texture = np.moveaxis(image.filled(0), 0, -1)
        if texture.dtype != np.uint8:
            top = max(float(np.percentile(texture, 99.5)), 1e-9)
            texture = np.clip(texture / top * 255, 0, 255)
        texture = np.ascontiguousarray(texture.astype(np.uint8))
    step = float(np.hypot(transform.a, transform.d))
    return grid_scene(path.stem, x, y, z, uv, texture, epsg, step)


def _read(path: Path, bands: int, most: int, resampling: Any) -> tuple[np.ma.MaskedArray, Any, int | None, float]:
    """Bands, their affine transform, EPSG code and metres per vertical unit of a raster, thinned to ``most`` cells."""
    import rasterio
    from affine import Affine
    from pyproj import CRS
    from rasterio.errors import RasterioError

    try:
        with rasterio.open(path) as file:
            if file.count < bands and bands > 1:
                raise InputError(f"The orthophoto {path} has {file.count} bands: give one with red, green and blue.")
            thin = max(1.0, float(np.sqrt(file.width * file.height / most)))
            rows, cols = max(1, int(file.height / thin)), max(1, int(file.width / thin))
            data = file.read(
                list(range(1, bands + 1)), out_shape=(bands, rows, cols), masked=True, resampling=resampling
            )
            a, b, c, d, e, f = file.transform[:6]
            across, down = file.width / cols, file.height / rows
            transform = Affine(a * across, b * down, c, d * across, e * down, f)
            # Heights are taken as they are, whatever they refer to: rendering asks for no geoid.
            epsg = epsg_codes(CRS.from_user_input(file.crs))[0] if file.crs else None
            # A DSM in a CRS of feet has its heights in feet too.
            factor = float(file.crs.linear_units_factor[1]) if file.crs and file.crs.is_projected else 1.0
    except RasterioError as error:
        raise InputError(f"{path} is not a readable raster ({error}): give a GeoTIFF.") from error
    return data.astype(np.float64 if bands == 1 else data.dtype), transform, epsg, factor


def grid_scene(
    name: str, x: Array, y: Array, z: Array, uv: Array | None, texture: NDArray | None, epsg: int | None, cell: float
) -> Scene:
    """A scene from places [rows, cols] (row 0 north) in file coordinates; cells without height are left out."""
    known = np.isfinite(z)
    origin, offset = None, np.zeros(3)
    if epsg is not None:
        middle = np.array([[np.mean([x.min(), x.max()]), np.mean([y.min(), y.max()]), float(np.median(z[known]))]])
        origin = _origin(middle[0], epsg)
        local = enu_from_crs(
            np.stack([x.ravel(), y.ravel(), np.where(known, z, middle[0, 2]).ravel()], -1), origin, epsg
        )
        x, y, z = (
            local[:, 0].reshape(z.shape),
            local[:, 1].reshape(z.shape),
            np.where(known, local[:, 2].reshape(z.shape), np.nan),
        )
        cell = float(np.hypot(x[0, 1] - x[0, 0], y[0, 1] - y[0, 0]))
    elif max(np.abs(x).max(), np.abs(y).max()) > 10_000:
        offset = np.round([np.mean([x.min(), x.max()]), np.mean([y.min(), y.max()]), 0.0])
        x, y = x - offset[0], y - offset[1]
    index = np.full(z.shape, -1)
    index[known] = np.arange(known.sum())
    a, b, c, d = (
        index[1:, :-1],
        index[1:, 1:],
        index[:-1, 1:],
        index[:-1, :-1],
    )  # from the south-west, counter-clockwise
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
        paint=np.tile(np.array([grey, grey, grey, 0], np.float32), (len(faces), 1)),
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
    return Origin(float(lat), float(lon), float(middle[2]), None if is_geographic(epsg) else epsg)


def is_geographic(epsg: int) -> bool:
    """Whether a CRS has degrees for units."""
    from pyproj import CRS

    return bool(CRS.from_epsg(epsg).is_geographic)
