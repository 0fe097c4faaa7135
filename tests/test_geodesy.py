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
