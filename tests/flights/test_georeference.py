"""Known cameras, put through a known similarity, come back to where they stood."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from overfly.errors import InputError
from overfly.flights.georeference import by_gps, by_ground, on_a_line
from overfly.geometry import rotation_from_gimbal, transform

GIMBALS = [(20.0 * i, -80.0 + i, 0.0) for i in range(8)]
ROTATIONS = np.stack([rotation_from_gimbal(*g) for g in GIMBALS])
GRID = np.array([[30.0 * (i % 4), 40.0 * (i // 4), 100.0 + 2 * (i % 3)] for i in range(8)])
LINE = np.array([[30.0 * i, 10.0 * i, 100.0 + 0.1 * (i % 2)] for i in range(8)])


def disturbed(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same cameras in a frame that is turned, scaled and shifted."""
    turn = Rotation.from_euler("xyz", [25, -40, 130], degrees=True).as_matrix()
    return 0.1 * positions @ turn.T + [3.0, -2, 7], turn @ ROTATIONS


def test_gps_on_a_grid_gives_the_cameras_back() -> None:
    positions, rotations = disturbed(GRID)
    matrix = by_gps(positions, GRID, list(GIMBALS), rotations)
    np.testing.assert_allclose(transform(matrix, positions), GRID, atol=1e-6)


def test_one_wrong_fix_moves_nothing_by_more_than_a_metre() -> None:
    positions, rotations = disturbed(GRID)
    told = GRID + np.random.default_rng(0).normal(0, 0.2, GRID.shape)
    told[3] += [60.0, -40, 15]
    found = transform(by_gps(positions, told, list(GIMBALS), rotations), positions)
    assert np.abs(np.delete(found - GRID, 3, axis=0)).max() < 1.0


@pytest.mark.parametrize("heights", [True, False])
def test_a_flight_along_a_line_is_levelled_by_its_gimbals(heights: bool) -> None:
    positions, rotations = disturbed(LINE)
    told = LINE.copy()
    if not heights:
        told[:, 2] = np.nan
    assert on_a_line(told)
    found = transform(by_gps(positions, told, list(GIMBALS), rotations), positions)
    shift = found[:, 2] - LINE[:, 2]
    np.testing.assert_allclose(found[:, :2], LINE[:, :2], atol=0.05)
    assert np.ptp(shift) < 0.2
    if heights:
        assert abs(shift.mean()) < 0.2


@pytest.mark.parametrize("told", [np.full((8, 3), np.nan), np.tile([1.0, 2, 3], (8, 1))])
def test_gps_that_cannot_scale_a_map_is_refused(told: np.ndarray) -> None:
    positions, rotations = disturbed(GRID)
    with pytest.raises(InputError, match="cannot scale"):
        by_gps(positions, told, list(GIMBALS), rotations)


def test_without_gps_the_ground_is_level_and_the_cameras_stand_100_units_above() -> None:
    rng = np.random.default_rng(1)
    ground = np.column_stack([rng.uniform(-50, 150, (400, 2)), rng.normal(0, 0.3, 400)])
    ground[:80, 2] += rng.uniform(3, 20, 80)  # houses
    positions, rotations = disturbed(GRID)
    points, _ = disturbed(ground)
    matrix = by_ground(positions, points, rotations, seed=0)
    found = transform(matrix, points)
    level = found[80:, 2]
    assert abs(np.median(level)) < 0.5
    assert level.std() < 0.8
    assert np.median(transform(matrix, positions)[:, 2]) == pytest.approx(100, abs=1.5)
