"""Rasters of a cloud: hand values, and what a GIS program reads back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from overfly.cloud import Cloud
from overfly.errors import InputError
from overfly.mapping.products import NODATA, cell_size, raster_products
from overfly.mapping.raster import Grid, grid_over, surface


def test_cells_by_hand() -> None:
    grid = Grid(10.0, 20.0, 2.0, 3, 4)
    assert grid.extent == (10, 18, 14, 20)
    assert grid.cells([[10.5, 19.5], [17.9, 14.1], [12, 18], [9.9, 19], [18.1, 19], [11, 20.1]]).tolist() == [
        0, 11, 5, -1, -1, -1,
    ]  # fmt: skip
    np.testing.assert_allclose(grid.centres()[0, 0], [11, 19])
    np.testing.assert_allclose(grid.centres()[2, 3], [17, 15])


def test_grid_over_holds_every_point_and_forgets_strays() -> None:
    points = np.random.default_rng(0).uniform([5e5, 4e6], [5e5 + 30, 4e6 + 20], (4000, 2))
    grid = grid_over(points, 0.7)
    assert (grid.cells(points) >= 0).all()
    assert grid.rows <= 30
    stray = np.concatenate([points, [[9e5, 4e6]]])
    assert grid_over(stray, 0.7, trim=0.001).columns < 50


def test_surface_takes_the_roof_and_averages_its_noise() -> None:
    points = np.array([[0.5, 0.5, 0.0], [0.4, 0.5, 10.0], [0.6, 0.5, 10.4], [1.5, 0.5, 2.0], [3.5, 0.5, 4.0]])
    colors = np.array([[255, 0, 0], [0, 100, 0], [0, 200, 0], [9, 9, 9], [7, 7, 7]], np.uint8)
    cloud = Cloud(points, colors, views=np.array([1, 2, 4, 1, 1], np.uint8), predicted=np.array([1, 0, 1, 0, 0], bool))
    seen = surface(cloud, Grid(0, 1, 1, 1, 4))
    np.testing.assert_allclose(seen.heights, [[10.2, 2.0, np.nan, 4.0]])
    assert seen.colors is not None
    assert seen.colors[0, 0].tolist() == [0, 150, 0]
    assert seen.counts.tolist() == [[2, 1, 0, 1]]
    assert seen.views is not None
    assert seen.predicted is not None
    assert (seen.views[0, 0], seen.predicted[0, 0]) == (3, 0.5)


def test_small_gaps_are_closed_and_large_ones_stay() -> None:
    x, y = np.meshgrid(np.arange(20) + 0.5, np.arange(20) + 0.5)
    points = np.column_stack([x.ravel(), y.ravel(), 0.1 * x.ravel()])
    hole = (np.abs(points[:, 0] - 5.5) < 0.1) & (np.abs(points[:, 1] - 5.5) < 0.1)
    lake = (np.abs(points[:, 0] - 14) < 4) & (np.abs(points[:, 1] - 14) < 4)
    seen = surface(Cloud(points[~hole & ~lake]), Grid(0, 20, 1, 20, 20), fill=1)
    assert seen.heights[14, 5] == pytest.approx(0.55)
    assert np.isnan(seen.heights[5, 14])


@pytest.mark.parametrize("epsg", [None, 32615])
def test_files_read_back(tmp_path: Path, epsg: int | None) -> None:
    import rasterio

    rng = np.random.default_rng(1)
    points = rng.uniform([600_000, 5_000_000, 0], [600_040, 5_000_020, 0.01], (40_000, 3))
    points[points[:, 0] > 600_030, 2] += 12.0
    points = points[~((np.abs(points[:, 0] - 600_010) < 4) & (np.abs(points[:, 1] - 5_000_010) < 4))]
    colors = np.full((len(points), 3), (200, 100, 50), np.uint8)
    cloud = Cloud(points, colors, epsg=epsg)
    raster_products(cloud, tmp_path, gsd=0.1)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["dsm.tif", "orthophoto.tif"]
    with rasterio.open(tmp_path / "dsm.tif") as dsm:
        assert (dsm.crs.to_epsg() if dsm.crs else None) == epsg
        assert dsm.nodata == NODATA
        assert dsm.profile["tiled"]
        assert dsm.res[0] == pytest.approx(max(0.2, cell_size(cloud, 0.1)))
        values = [v[0] for v in dsm.sample([(600_035, 5_000_010), (600_020, 5_000_010), (600_010, 5_000_010)])]
        assert values == pytest.approx([12.0, 0.0, NODATA], abs=0.02)
    with rasterio.open(tmp_path / "orthophoto.tif") as photo:
        assert [v.tolist() for v in photo.sample([(600_035, 5_000_010), (600_010, 5_000_010)])] == [
            [200, 100, 50, 255], [0, 0, 0, 0],
        ]  # fmt: skip


def test_sparse_clouds_get_larger_cells() -> None:
    points = np.random.default_rng(0).uniform([0, 0, 0], [100, 100, 1], (1000, 3))
    assert cell_size(Cloud(points), 5.0) == 10.0
    assert 4 < cell_size(Cloud(points), 0.05) < 8  # three points on 30 square metres
    assert 0.1 <= cell_size(Cloud(points[:1]), 0.05) < 1


def test_empty_or_absurd_clouds_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no points"):
        raster_products(Cloud(np.zeros((0, 3))), tmp_path, gsd=0.1)
    points = np.random.default_rng(0).uniform(0, 1e7, (1000, 3))
    with pytest.raises(InputError, match="extent"):
        raster_products(Cloud(points), tmp_path, gsd=0.01)
    assert list(tmp_path.iterdir()) == []
