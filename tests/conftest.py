"""Fixtures that several test folders share."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Callable[[str], Path]:
    """The folder of a real data set, which is not part of this project; the test is skipped where it is absent."""

    def folder(name: str) -> Path:
        path = SHARED / name
        if not path.exists():
            pytest.skip(f"the real data set {name} is absent (expected beside the project, in shared/data)")
        return path

    return folder


def undulation(longitude: float) -> float:
    """Height of the sea above the ellipsoid in the grid of ``geoid``, metres."""
    return 40.0 + (longitude + 180.0) / 36.0


@pytest.fixture
def no_geoid() -> None:
    """PROJ has no grid for EGM96; the test is skipped where it has one, as users of ``--heights`` need it."""
    from pyproj.transformer import TransformerGroup

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        ways = TransformerGroup("EPSG:4979", "EPSG:32631+5773", allow_ballpark=False).transformers
    if ways:
        pytest.skip("PROJ has the geoid grid of EGM96 on this machine")


@pytest.fixture
def geoid(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[float], float]]:
    """PROJ finds a grid for EGM96, coarse and made up; the value is :func:`undulation`."""
    import pyproj
    import rasterio
    from rasterio.transform import Affine

    from overfly import geodesy

    folder = tmp_path_factory.mktemp("proj")
    values = np.tile(np.float32([undulation(x) for x in range(-180, 181)]), (181, 1))
    size = {"width": 361, "height": 181, "count": 1, "dtype": "float32"}
    grid = folder / "us_nga_egm96_15.tif"
    place = Affine(1, 0, -180.5, 0, -1, 90.5)
    with rasterio.open(grid, "w", driver="GTiff", crs="EPSG:4326", transform=place, **size) as file:
        file.write(values, 1)
        file.update_tags(AREA_OR_POINT="Point", TYPE="VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL")
        file.set_band_description(1, "geoid_undulation")
        file.set_band_unit(1, "metre")
    usual = pyproj.datadir.get_data_dir()
    geodesy._projected.cache_clear()
    pyproj.datadir.append_data_dir(str(folder))
    yield undulation
    pyproj.datadir.set_data_dir(usual)
    geodesy._projected.cache_clear()
