"""Heights on a finer grid by hand, and the affine maps of chunks against PROJ."""

from __future__ import annotations

import numpy as np

from overfly.geodesy import Origin, crs_from_enu, enu_from_crs
from overfly.geometry import invert, pose, rotation_from_gimbal, transform
from overfly.mapping.lattice import CHUNK, chunks, on_finer, placing
from overfly.mapping.raster import Grid


def test_heights_are_interpolated_but_not_across_walls_and_beside_holes() -> None:
    heights = np.array([[0.0, 2.0, 12.0, 12.0, np.nan]])
    fine = on_finer(np.repeat(heights, 2, axis=0), Grid(10.0, 20.0, 2.0, 2, 5), Grid(10.0, 19.0, 1.0, 2, 10))
    np.testing.assert_allclose(fine[0], [0, 0.5, 1.5, 2, 12, 12, 12, 12, np.nan, np.nan])
    np.testing.assert_array_equal(fine[0], fine[1])


def test_beyond_the_surface_nothing_is_known() -> None:
    beyond = on_finer(np.ones((1, 1)), Grid(10.0, 20.0, 2.0, 1, 1), Grid(6.0, 22.0, 2.0, 3, 4))
    np.testing.assert_array_equal(np.isfinite(beyond), [[0, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0]])


def test_chunks_cover_the_grid_once_and_place_its_cells_to_the_millimetre() -> None:
    origin = Origin(52.2, 21.0, 100.0)
    east, north, _ = crs_from_enu([[0, 0, 0]], origin)[0]
    cell = 0.25
    grid = Grid(round(east) - 30.0, round(north) + 200.0, cell, 700, 900)
    centre = np.array([20.0, 30.0, 90.0])
    camera = pose(rotation_from_gimbal(30, -70, 5), centre)
    count = np.zeros((grid.rows, grid.columns), int)
    xy = grid.centres()
    for part in chunks(grid, placing(origin), 105.0):
        count[part.rows, part.columns] += 1
        assert max(len(part.x), len(part.y)) <= CHUNK
        heights = np.full((len(part.y), len(part.x)), 117.0, np.float32)
        found = part.from_camera(camera, part.x[None, :], part.y[:, None], heights)
        flat = np.c_[xy[part.rows, part.columns].reshape(-1, 2), heights.ravel()]
        world = enu_from_crs(flat, origin)
        wanted = np.c_[transform(invert(camera), world), centre[2] - world[:, 2]]
        np.testing.assert_allclose(np.stack([f.ravel() for f in found], 1), wanted, atol=1e-3)
    assert (count == 1).all()
