"""Where on the Earth the local ENU frame stands: geodetic and projected coordinates, through PROJ."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from overfly.errors import InputError
from overfly.geometry import Array


@dataclass(frozen=True)
class Origin:
    """Where the local ENU frame stands on the Earth (WGS 84; height above the ellipsoid in metres)."""

    latitude: float
    longitude: float
    height: float = 0.0
    epsg: int | None = None

    def __post_init__(self) -> None:
        if not (-90 <= self.latitude <= 90 and -180 <= self.longitude <= 180):
            raise InputError(
                f"The origin's latitude {self.latitude} and longitude {self.longitude} are not on the Earth: "
                "give degrees, latitude -90 to 90 and longitude -180 to 180."
            )

    @property
    def crs_epsg(self) -> int:
        """The projected CRS of the products: the one given, else the WGS 84 UTM zone."""
        return self.epsg or utm_epsg(self.latitude, self.longitude)


def utm_epsg(latitude: float, longitude: float) -> int:
    """EPSG code of the WGS 84 UTM zone of a place."""
    zone = min(60, int((longitude + 180) // 6) + 1)
    return (32600 if latitude >= 0 else 32700) + zone


@lru_cache(maxsize=64)
def _topocentric(latitude: float, longitude: float, height: float):
    from pyproj import Transformer

    return Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lat_0={float(latitude)!r} +lon_0={float(longitude)!r} "
        f"+h_0={float(height)!r}"
    )


def enu_from_geodetic(geodetic: ArrayLike, origin: Origin) -> Array:
    """Local ENU metres [N, 3] of (latitude, longitude, ellipsoidal height) [N, 3]."""
    lat, lon, height = np.atleast_2d(np.asarray(geodetic, float)).T
    pipeline = _topocentric(origin.latitude, origin.longitude, origin.height)
    return np.stack(pipeline.transform(lon, lat, height), axis=-1)


def geodetic_from_enu(points: ArrayLike, origin: Origin) -> Array:
    """(Latitude, longitude, ellipsoidal height) [N, 3] of local ENU metres [N, 3]."""
    east, north, up = np.atleast_2d(np.asarray(points, float)).T
    pipeline = _topocentric(origin.latitude, origin.longitude, origin.height)
    lon, lat, height = pipeline.transform(east, north, up, direction="INVERSE")
    return np.stack([lat, lon, height], axis=-1)


@lru_cache(maxsize=64)
def _projected(epsg: int):
    from pyproj import Transformer

    return Transformer.from_crs("EPSG:4979", f"EPSG:{epsg}", always_xy=True)


def crs_from_enu(points: ArrayLike, origin: Origin) -> Array:
    """Easting, northing and ellipsoidal height [N, 3] in ``origin.crs_epsg`` of local ENU metres [N, 3].

    Heights stay ellipsoidal: no geoid is applied.
    """
    lat, lon, height = geodetic_from_enu(points, origin).T
    east, north = _projected(origin.crs_epsg).transform(lon, lat)
    return np.stack([east, north, height], axis=-1)


def enu_from_crs(points: ArrayLike, origin: Origin, epsg: int | None = None) -> Array:
    """Local ENU metres [N, 3] of easting, northing and ellipsoidal height [N, 3] in ``epsg``."""
    east, north, height = np.atleast_2d(np.asarray(points, float)).T
    lon, lat = _projected(epsg or origin.crs_epsg).transform(east, north, direction="INVERSE")
    return enu_from_geodetic(np.stack([lat, lon, height], axis=-1), origin)
