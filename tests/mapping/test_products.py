"""Rasters of a cloud: hand values, and what a GIS program reads back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from overfly.cloud import Cloud
from overfly.errors import InputError
from overfly.mapping.gaps import COARSE, HOLE, INTERPOLATED, MEASURED, NODATA, PALETTE, PREDICTED, REACH, _on_cells
from overfly.mapping.products import cell_size, raster_products
from overfly.mapping.raster import Grid, grid_over, surface
from overfly.mapping.tiles import Tiles, write_tiles
from overfly.mapping.windows import Window


def tiled(cloud: Cloud, folder: Path, side: float = 1e9) -> Tiles:
    """A cloud in a folder, cut into squares of the plan."""
    owner = np.unique(np.floor(cloud.points[:, :2] / side), axis=0, return_inverse=True)[1].reshape(-1)
    return write_tiles(folder, [cloud[owner == k] for k in range(owner.max() + 1 if len(owner) else 0)])


def rough_ground(n: int = 30_000) -> Cloud:
    """40 x 25 m of thin, noisy, coloured points with houses, a hole, a missing corner and single strays."""
    rng = np.random.default_rng(4)
    points = rng.uniform([100, -50, 0], [140, -25, 0.3], (n, 3))
    points[(np.floor(points[:, :2] / 7).sum(1) % 3) == 0, 2] += 6
    points = points[np.hypot(*(points[:, :2] - [117, -38]).T) > 3]
    points = points[(points[:, 0] < 120) | (points[:, 1] < -37)]
    points[::500, 2] += rng.uniform(-20, 20, len(points[::500]))
    return Cloud(points, rng.integers(0, 255, (len(points), 3), dtype=np.uint8))


def bands(folder: Path) -> dict[str, np.ndarray]:
    import rasterio

    found = {}
    for name in ("dsm", "dsm_source", "orthophoto"):
        with rasterio.open(folder / f"{name}.tif") as file:
            found[name] = file.read()
    return found


@pytest.mark.parametrize(("side", "window"), [(9.0, 64), (4.0, 33), (1e9, 50)])
def test_no_seam_of_tiles_or_windows_shows(tmp_path: Path, side: float, window: int) -> None:
    cloud = rough_ground()
    one, many = tmp_path / "one", tmp_path / "many"
    raster_products(tiled(cloud, one / "tiles"), one, gsd=0.1)
    raster_products(tiled(cloud, many / "tiles", side), many, gsd=0.1, window=window)
    whole, cut = bands(one), bands(many)
    assert (whole["dsm"] == NODATA).any()
    assert np.unique(whole["dsm_source"]).tolist() == [0, MEASURED, INTERPOLATED]
    np.testing.assert_array_equal(cut["dsm_source"], whole["dsm_source"])
    np.testing.assert_allclose(cut["dsm"], whole["dsm"], atol=1e-5)
    np.testing.assert_array_equal(cut["orthophoto"], whole["orthophoto"])


class Checks:
    """Paints what it is given: heights under the cell, and how far the surface reaches around the window."""

    def __init__(self, overview: Grid, heights: np.ndarray) -> None:
        self.overview, self.heights, self.windows = overview, heights, 0

    def halo(self, cell: float) -> float:
        return 3 * cell

    def window(
        self, grid: Grid, around: Grid, heights: np.ndarray, doubtful: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        assert np.isfinite(heights[doubtful]).all()
        self.windows += 1
        at = around.cells(grid.centres().reshape(-1, 2))
        z = np.where(at >= 0, heights.ravel()[np.maximum(at, 0)], np.nan).reshape(grid.rows, grid.columns)
        filled = np.isfinite(z)
        colors = np.repeat(np.where(filled, 100 + 10 * np.nan_to_num(z), 0)[..., None], 3, -1)
        return np.clip(colors, 0, 255).astype(np.uint8), (filled * 255).astype(np.uint8)


@pytest.mark.parametrize(("gsd", "times"), [(0.3, 2), (0.1, 3)])
def test_a_painter_colours_the_windows_from_the_surface_around_them(tmp_path: Path, gsd: float, times: int) -> None:
    made: list[Checks] = []

    def make(overview: Grid, heights: np.ndarray) -> Checks:
        made.append(Checks(overview, heights))
        return made[-1]

    cloud = rough_ground()
    grid, _ = raster_products(tiled(cloud, tmp_path / "tiles"), tmp_path, gsd=gsd, painter=make, window=25)
    found = bands(tmp_path)
    assert made[0].windows > 4
    extent = made[0].overview.extent
    assert extent[0] == grid.extent[0]
    assert extent[1] >= grid.extent[1]
    assert -1 < np.nanmedian(made[0].heights) < 7
    heights = found["dsm"][0].repeat(times, 0).repeat(times, 1)
    photo = found["orthophoto"]
    assert photo.shape[1:] == heights.shape
    np.testing.assert_array_equal(photo[3] > 0, heights != NODATA)
    known = (heights != NODATA) & (np.abs(heights) < 9)
    np.testing.assert_allclose(photo[0][known], 100 + 10 * heights[known], atol=1)


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
    raster_products(tiled(cloud, tmp_path / "tiles"), tmp_path, gsd=0.1034)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["dsm.tif", "dsm_source.tif", "orthophoto.tif", "tiles"]
    with rasterio.open(tmp_path / "dsm.tif") as dsm:
        assert (dsm.crs.to_epsg() if dsm.crs else None) == epsg
        assert dsm.nodata == NODATA
        assert dsm.profile["tiled"]
        # Whole multiples of two digits of the GSD, counted from zero.
        assert abs(dsm.res[0] / 0.1 - round(dsm.res[0] / 0.1)) < 1e-9
        assert -0.03 < dsm.res[0] - cell_size([cloud], 0.1) < 0.1
        assert abs(np.remainder(dsm.transform.c / dsm.res[0] + 0.5, 1) - 0.5) < 1e-6
        values = [v[0] for v in dsm.sample([(600_035, 5_000_010), (600_020, 5_000_010), (600_010, 5_000_010)])]
        assert values == pytest.approx([12.0, 0.0, 0.0], abs=0.02)
    with rasterio.open(tmp_path / "dsm_source.tif") as source:
        assert source.nodata == 0
        assert source.colormap(1)[INTERPOLATED] == PALETTE[INTERPOLATED]
        places = [(600_035, 5_000_010), (600_020, 5_000_010), (600_010, 5_000_010)]
        assert [v[0] for v in source.sample(places)] == [MEASURED, MEASURED, INTERPOLATED]
    with rasterio.open(tmp_path / "orthophoto.tif") as photo:
        assert [v.tolist() for v in photo.sample([(600_035, 5_000_010), (600_010, 5_000_010)])] == [
            [200, 100, 50, 255], [0, 0, 0, 0],
        ]  # fmt: skip


def plain(size: int = 640) -> Cloud:
    """A slope of 1 in 10 with four points in every cell of a metre, two of three predicted in its eastern quarter."""
    x, y = np.meshgrid(np.arange(2 * size) / 2 + 0.25, np.arange(2 * size) / 2 + 0.25)
    points = np.column_stack([x.ravel(), y.ravel(), x.ravel() / 10])
    guessed = (points[:, 0] > 0.75 * size) & (np.arange(len(points)) % 3 > 0)
    return Cloud(points, np.zeros((len(points), 3), np.uint8), predicted=guessed)


@pytest.mark.parametrize(
    ("radius", "at", "filled"),
    [
        (0.9 * HOLE * COARSE, (300, 320), True),  # enclosed
        (1.2 * HOLE * COARSE, (300, 320), False),  # so large that it may be a lake
        (0.8 * REACH * COARSE, (0, 320), True),  # a bay
        (2.5 * REACH * COARSE, (0, 320), False),
    ],
)
def test_gaps_between_known_cells_are_interpolated_and_marked(
    tmp_path: Path, radius: float, at: tuple[float, float], filled: bool
) -> None:
    import rasterio

    cloud = plain()
    gone = np.hypot(*(cloud.points[:, :2] - at).T) < radius
    grid, shares = raster_products(tiled(cloud[~gone], tmp_path / "tiles"), tmp_path, gsd=0.5, window=100)
    assert grid.cell == 1
    inside = (at[0] + 25.5, at[1] + 0.5)
    with rasterio.open(tmp_path / "dsm.tif") as dsm, rasterio.open(tmp_path / "dsm_source.tif") as source:
        height, origin = (next(file.sample([inside]))[0] for file in (dsm, source))
        assert [next(source.sample([(x, 600)]))[0] for x in (20, 600)] == [MEASURED, PREDICTED]
        counts = np.bincount(source.read(1).ravel(), minlength=4)
    assert origin == (INTERPOLATED if filled else 0)
    # Inside an enclosed hole the plane goes on; a bay's ends are free.
    assert height == pytest.approx(inside[0] / 10 if filled else NODATA, abs=0.3 if at[0] else 2)
    assert shares["interpolated"] == pytest.approx(counts[INTERPOLATED] / counts[1:].sum(), abs=1e-4)
    assert sum(shares.values()) == pytest.approx(1, abs=2e-4)
    assert 0.1 < shares["predicted"] < 0.3


def test_no_rim_is_added_and_a_stray_cell_stays_alone(tmp_path: Path) -> None:
    import rasterio

    cloud = plain(400)
    x, y = cloud.points[:, :2].T
    kept = (x < 197) | ((np.abs(x - 340) < 5) & (np.abs(y - 100) < 5))
    _, shares = raster_products(tiled(cloud[kept], tmp_path / "tiles"), tmp_path, gsd=0.5, window=100)
    assert shares["interpolated"] < 0.012  # two cells along every edge, by the passes that close single ones
    with rasterio.open(tmp_path / "dsm.tif") as dsm:
        values = [v[0] for v in dsm.sample([(195.5, 150.5), (199.5, 150.5), (340.5, 100.5), (348.5, 100.5)])]
    assert values == pytest.approx([19.55, NODATA, 34.05, NODATA], abs=0.2)


def test_a_speckle_that_is_taken_out_is_not_called_measured(tmp_path: Path) -> None:
    import rasterio

    cloud = plain(100)
    lone = np.abs(cloud.points[:, :2] - 50.5).max(1) < 0.5
    points = cloud.points + np.where(lone[:, None], [0, 0, 50.0], 0)
    raster_products(tiled(cloud.with_points(points), tmp_path / "tiles"), tmp_path, gsd=0.5)
    with rasterio.open(tmp_path / "dsm.tif") as dsm, rasterio.open(tmp_path / "dsm_source.tif") as source:
        height, origin = (next(file.sample([(50.5, 50.5)]))[0] for file in (dsm, source))
    assert (height, origin) == (pytest.approx(5.05, abs=0.1), INTERPOLATED)


def test_long_maps_are_interpolated_piece_by_piece() -> None:
    """OpenCV takes no pictures of 32,767 pixels and more."""
    coarse = np.tile(np.arange(40_000, dtype=np.float32), (4, 1))
    window = Window(Grid(0, 32, 1, 32, 320_000), slice(8, 24), slice(300_000, 300_100))
    np.testing.assert_allclose(_on_cells(coarse, window)[0], (np.arange(300_000, 300_100) + 0.5) / 8 - 0.5, atol=0.02)


def test_sparse_clouds_get_larger_cells() -> None:
    points = np.random.default_rng(0).uniform([0, 0, 0], [100, 100, 1], (1000, 3))
    assert cell_size([Cloud(points)], 5.0) == 10.0
    assert 4 < cell_size([Cloud(points)], 0.05) < 8  # three points on 30 square metres
    assert 0.1 <= cell_size([Cloud(points[:1])], 0.05) < 1


def test_empty_or_absurd_clouds_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no points"):
        raster_products(tiled(Cloud(np.zeros((0, 3))), tmp_path / "a"), tmp_path, gsd=0.1)
    points = np.random.default_rng(0).uniform(0, 1e7, (1000, 3))
    with pytest.raises(InputError, match="extent"):
        raster_products(tiled(Cloud(points), tmp_path / "b"), tmp_path, gsd=0.01)
    assert not list(tmp_path.glob("*.tif"))
