"""Where on the Earth the local ENU frame stands: geodetic and projected coordinates, through PROJ."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from overfly.errors import InputError
from overfly.geometry import Array

if TYPE_CHECKING:
    from pyproj import CRS

VERTICAL = {"egm96": "5773", "egm2008": "3855"}
"""Vertical CRS that go by a name of their own, worldwide geoids."""


@dataclass(frozen=True)
class Origin:
    """Where the local ENU frame stands on the Earth (WGS 84; height above the ellipsoid in metres).

    ``epsg`` is the projected CRS of the products, None for the UTM zone; ``vertical_epsg`` the vertical CRS of their
    heights, None for heights above the ellipsoid.
    """

    latitude: float
    longitude: float
    height: float = 0.0
    epsg: int | None = None
    vertical_epsg: int | None = None

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
def _projected(epsg: int, vertical_epsg: int | None = None):
    from pyproj import Transformer

    if vertical_epsg is None:
        return Transformer.from_crs("EPSG:4979", crs_code(epsg), always_xy=True)
    vertical_crs(str(vertical_epsg))
    # Without its grid PROJ would take heights over the sea for heights over the ellipsoid, and say nothing.
    return Transformer.from_crs(
        "EPSG:4979", crs_code(epsg, vertical_epsg), always_xy=True, allow_ballpark=False, only_best=True
    )


def crs_code(epsg: int, vertical_epsg: int | None = None) -> str:
    """What PROJ, GDAL and LAS headers call a CRS: ``EPSG:32632``, with a vertical one ``EPSG:32632+5773``."""
    return f"EPSG:{epsg}" if vertical_epsg is None else f"EPSG:{epsg}+{vertical_epsg}"


def epsg_codes(crs: CRS) -> tuple[int | None, int | None]:
    """EPSG codes of the horizontal and of the vertical part of a CRS; None where there is none, or no code."""
    horizontal, vertical = crs.sub_crs_list if crs.is_compound else (crs, None)
    return horizontal.to_epsg(), None if vertical is None else vertical.to_epsg()


def crs_from_enu(points: ArrayLike, origin: Origin) -> Array:
    """Easting, northing and height [N, 3] in the origin's projected and vertical CRS of local ENU metres [N, 3].

    Without a vertical CRS heights stay above the ellipsoid: no geoid is applied.

    Raises:
        InputError: PROJ lacks the grid of the vertical CRS, or it does not cover the place.
    """
    lat, lon, height = geodetic_from_enu(points, origin).T
    if origin.vertical_epsg is None:
        east, north = _projected(origin.crs_epsg).transform(lon, lat)
        return np.stack([east, north, height], axis=-1)
    found = np.stack(_projected(origin.crs_epsg, origin.vertical_epsg).transform(lon, lat, height), axis=-1)
    return _covered(found, origin.vertical_epsg)


def enu_from_crs(points: ArrayLike, origin: Origin, epsg: int | None = None, vertical_epsg: int | None = None) -> Array:
    """Local ENU metres [N, 3] of easting, northing and height [N, 3].

    Args:
        points: in ``epsg`` and ``vertical_epsg``; without ``epsg`` in the CRS of the origin.
        origin: of the local frame.

    Raises:
        InputError: PROJ lacks the grid of the vertical CRS, or it does not cover the place.
    """
    if epsg is None:
        epsg, vertical_epsg = origin.crs_epsg, origin.vertical_epsg
    east, north, height = np.atleast_2d(np.asarray(points, float)).T
    if vertical_epsg is None:
        lon, lat = _projected(epsg).transform(east, north, direction="INVERSE")
    else:
        found = _projected(epsg, vertical_epsg).transform(east, north, height, direction="INVERSE")
        lon, lat, height = _covered(np.stack(found, axis=-1), vertical_epsg).T
    return enu_from_geodetic(np.stack([lat, lon, height], axis=-1), origin)


def _covered(points: Array, vertical_epsg: int) -> Array:
    if not np.isfinite(points).all():
        raise InputError(
            f"The geoid grid of EPSG:{vertical_epsg} does not cover this place: choose a vertical CRS of the region."
        )
    return points


def vertical_crs(text: str) -> int | None:
    """The EPSG code of a vertical CRS by its name: ellipsoidal (None), egm96, egm2008, or a code such as EPSG:5703.

    Raises:
        InputError: it is no vertical CRS in metres upwards, or PROJ lacks the grid that it needs.
    """
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    name = text.strip().lower()
    if name == "ellipsoidal":
        return None
    code = VERTICAL.get(name, name.removeprefix("epsg:"))
    try:
        crs = CRS.from_epsg(int(code))
    except (ValueError, CRSError):
        crs = None
    if (
        crs is None
        or not crs.is_vertical
        or (crs.axis_info[0].unit_name, crs.axis_info[0].direction) != ("metre", "up")
    ):
        raise InputError(
            f"The heights {text!r} are not known: give ellipsoidal, {', '.join(VERTICAL)}, or the EPSG code of a "
            "vertical CRS in metres, such as EPSG:5773."
        )
    _check_grid(int(code), crs.name)
    return int(code)


def _check_grid(vertical_epsg: int, name: str) -> None:
    from pyproj import datadir
    from pyproj.transformer import TransformerGroup

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # says that a grid is missing, as is said below
        found = TransformerGroup("EPSG:4979", crs_code(32631, vertical_epsg), always_xy=True, allow_ballpark=False)
    if found.transformers:
        return  # whether it reaches this place is seen there
    missing = [[g.short_name for g in way.grids if not g.available] for way in found.unavailable_operations]
    fewest = min(map(len, missing), default=0)  # there are ways through many older datums as well
    grids = list(dict.fromkeys(names[-1] for names in missing if fewest and len(names) == fewest))[:3]
    if not grids:
        raise InputError(f"PROJ knows no way from heights over the ellipsoid to {name} (EPSG:{vertical_epsg}).")
    raise InputError(
        f"Heights in {name} need the geoid grid {' or '.join(grids)}, which is not on this machine: copy it from "
        f"https://cdn.proj.org to {datadir.get_user_data_dir()}, or map with --heights ellipsoidal."
    )
