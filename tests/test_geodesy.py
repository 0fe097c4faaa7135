"""Local ENU, geodetic and projected coordinates, against PROJ asked in another way."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from overfly import geodesy
from overfly.errors import InputError

PLACES = [
    (46.8427, -91.9940, 200.0),
    (-33.9, 151.2, 30.0),
    (52.2, 21.0, 110.0),
    (0.0001, -179.9, 5.0),
    (69.6, 18.9, 0.0),
]


@pytest.mark.parametrize("place", PLACES)
def test_enu_round_trip_and_against_pyproj(place: tuple[float, float, float]) -> None:
    origin = geodesy.Origin(*place)
    rng = np.random.default_rng(0)
    points = rng.uniform(-1000, 1000, (50, 3))
    geodetic = geodesy.geodetic_from_enu(points, origin)
    assert_allclose(geodesy.enu_from_geodetic(geodetic, origin), points, atol=1e-6)
    assert_allclose(geodesy.enu_from_geodetic([place], origin), [[0, 0, 0]], atol=1e-6)
    # independently: through Earth-centred coordinates
    from pyproj import Transformer

    ecef = np.stack(Transformer.from_crs(4979, 4978).transform(*geodetic.T), axis=-1)
    start = np.array(Transformer.from_crs(4979, 4978).transform(*place))
    lat, lon = np.radians(place[:2])
    axes = np.array([
        [-np.sin(lon), np.cos(lon), 0],
        [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
        [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
    ])  # fmt: skip
    assert_allclose((ecef - start) @ axes.T, points, atol=1e-6)


@pytest.mark.parametrize("place", PLACES)
def test_utm_round_trip_and_against_pyproj(place: tuple[float, float, float]) -> None:
    origin = geodesy.Origin(*place)
    points = np.random.default_rng(0).uniform(-500, 500, (50, 3)) * [1, 1, 0.02]
    projected = geodesy.crs_from_enu(points, origin)
    assert_allclose(geodesy.enu_from_crs(projected, origin), points, atol=1e-5)
    from pyproj import Transformer

    geodetic = geodesy.geodetic_from_enu(points, origin)
    east, north = Transformer.from_crs(4326, origin.crs_epsg).transform(geodetic[:, 0], geodetic[:, 1])
    assert_allclose(projected, np.column_stack([east, north, geodetic[:, 2]]), atol=1e-6)
    # UTM's scale is within 1 per mille, and lengths stay lengths
    spread = np.linalg.norm(np.diff(projected[:, :2], axis=0), axis=1)
    assert_allclose(spread, np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1), rtol=1.2e-3)


def test_enu_in_another_crs() -> None:
    origin = geodesy.Origin(52.2, 21.0, 110.0, epsg=2180)  # Poland's national grid
    assert origin.crs_epsg == 2180
    points = np.array([[0, 0, 0], [100, 200, 5.0]])
    assert_allclose(geodesy.enu_from_crs(geodesy.crs_from_enu(points, origin), origin), points, atol=1e-5)
    utm = geodesy.crs_from_enu(points, geodesy.Origin(52.2, 21.0, 110.0))
    assert_allclose(geodesy.enu_from_crs(utm, origin, epsg=32634), points, atol=1e-5)


@pytest.mark.parametrize(
    ("latitude", "longitude", "epsg"),
    [
        (46.8, -92.0, 32615),
        (-33.9, 151.2, 32756),
        (0.0, 0.0, 32631),
        (10, 180, 32660),
        (10, -180, 32601),
        (52, 18, 32634),
    ],
)
def test_utm_zones(latitude: float, longitude: float, epsg: int) -> None:
    assert geodesy.utm_epsg(latitude, longitude) == epsg


@pytest.mark.parametrize(("latitude", "longitude"), [(91, 0), (0, 181), (np.nan, 0), (-90.1, 0)])
def test_origins_off_the_earth_are_refused(latitude: float, longitude: float) -> None:
    with pytest.raises(InputError, match="latitude -90 to 90"):
        geodesy.Origin(latitude, longitude)


@pytest.mark.parametrize("place", [(46.0, 8.0, 450.0), (-33.9, 151.25, 30.0)])
def test_heights_above_the_sea_are_lower_by_the_geoid(geoid, place: tuple[float, float, float]) -> None:  # type: ignore[no-untyped-def]
    code = geodesy.vertical_crs("egm96")
    assert code == 5773
    origin = geodesy.Origin(*place, vertical_epsg=code)
    points = np.array([[0.0, 0, 0], [500, -300, 40]])
    above_sea = geodesy.crs_from_enu(points, origin)
    above_ellipsoid = geodesy.crs_from_enu(points, geodesy.Origin(*place))
    assert_allclose(above_ellipsoid[0, 2] - above_sea[0, 2], geoid(place[1]), atol=1e-3)
    assert_allclose(above_sea[:, :2], above_ellipsoid[:, :2], atol=1e-6)
    assert_allclose(geodesy.enu_from_crs(above_sea, origin), points, atol=1e-5)
    assert_allclose(geodesy.enu_from_crs(above_ellipsoid, origin, origin.crs_epsg), points, atol=1e-5)


def test_a_missing_geoid_grid_is_named_and_never_passed_over(no_geoid: None) -> None:
    with pytest.raises(InputError, match=r"us_nga_egm96_15\.tif, which is not on this machine: copy it from"):
        geodesy.vertical_crs("egm96")
    with pytest.raises(InputError, match=r"need the geoid grid us_nga_egm96_15\.tif"):
        geodesy.crs_from_enu([[0, 0, 0]], geodesy.Origin(46.0, 8.0, 450.0, vertical_epsg=5773))
    with pytest.raises(InputError, match=r"EPSG:5701|uk_os_OSGM15_GB"):
        geodesy.vertical_crs("EPSG:5701")


@pytest.mark.parametrize("text", ["sea", "EPSG:4326", "32632", "6360", "5715", ""])
def test_what_is_no_vertical_crs_in_metres_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="are not known: give ellipsoidal, egm96, egm2008, or the EPSG code"):
        geodesy.vertical_crs(text)


def test_ellipsoidal_heights_have_no_vertical_crs() -> None:
    assert geodesy.vertical_crs("Ellipsoidal") is None
    assert geodesy.crs_code(32632) == "EPSG:32632"
    assert geodesy.crs_code(32632, 5773) == "EPSG:32632+5773"
