"""A shift, rotation or scale that was applied is found again, on clouds of differing density, coverage and noise."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from overfly.cloud import Cloud, read_cloud
from overfly.errors import InputError
from overfly.geodesy import Origin, crs_from_enu
from overfly.geometry import invert, transform
from overfly.metrics.alignment import MODES, align
from overfly.metrics.functional import distances

UTM = np.array([576_714.97, 5_188_161.59, 162.28])


def park(n: int, seed: int) -> np.ndarray:
    """Points on the top surface of a 120 m x 100 m park: undulating lawn, a pavilion, cars and round trees."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, 120, n), rng.uniform(0, 100, n)
    z = 1.5 * np.sin(x / 35) + np.cos(y / 28) + 0.01 * x
    z = np.where((abs(x - 60) < 6) & (abs(y - 45) < 4), 5 - 0.5 * abs(y - 45), z)  # the pavilion's gable
    for i in range(6):
        z = np.where((abs(x - 20 - 6 * i) < 2.2) & (abs(y - 20) < 0.9), z + 1.5, z)
    trees = np.random.default_rng(99).uniform([5, 5, 2], [115, 95, 5], (25, 3))
    for tree_x, tree_y, radius in trees:
        inside = radius**2 - (x - tree_x) ** 2 - (y - tree_y) ** 2
        z = np.where(inside > 0, np.maximum(z, 2 + radius + np.sqrt(np.maximum(inside, 0))), z)
    return np.column_stack([x, y, z])


def pair(noise: float = 0.08) -> tuple[np.ndarray, np.ndarray]:
    """A sparse, noisy cloud of three quarters of the park with 2 % outliers, and a dense one of all of it."""
    rng = np.random.default_rng(5)
    cloud = park(7_000, 1)
    cloud = cloud[cloud[:, 0] < 95] + rng.normal(0, noise, (np.sum(cloud[:, 0] < 95), 3))
    wild = rng.random(len(cloud)) < 0.02
    cloud[wild, 2] += rng.uniform(-15, 15, wild.sum())
    return cloud, park(20_000, 2)


@pytest.mark.parametrize("shift", [(0.7, -0.7, 10.0), (-2.5, 3.0, -11.0), (0, 0, 0), (9, -8, 40)], ids=str)
def test_shift(shift: tuple[float, float, float]) -> None:
    cloud, reference = pair()
    matrix, moved = align(cloud - np.array(shift), reference, "shift")
    assert_array_equal(matrix[:3, :3], np.eye(3))
    assert_allclose(matrix[:3, 3], shift, atol=0.06)
    assert_allclose(moved, cloud - np.array(shift) + matrix[:3, 3], atol=1e-9)


def test_shift_from_a_local_frame_to_utm() -> None:
    cloud, reference = pair()
    matrix, moved = align(cloud, reference + UTM, "shift")
    assert_allclose(matrix[:3, 3], UTM, atol=0.06)
    assert_allclose(moved, cloud + UTM, atol=0.06)


def small(yaw: float, tilt: float, scale: float, shift: tuple[float, float, float]) -> np.ndarray:
    """A similarity about the park's centre."""
    matrix, centre = np.eye(4), np.array([60, 50, 0])
    matrix[:3, :3] = scale * Rotation.from_euler("zx", [yaw, tilt], degrees=True).as_matrix()
    matrix[:3, 3] = centre - matrix[:3, :3] @ centre + shift
    return matrix


def test_rigid() -> None:
    cloud, reference = pair()
    wanted = small(-9.0, 1.0, 1.0, (1, -2, 10))
    matrix, _ = align(transform(invert(wanted), cloud), reference, "rigid")
    assert_allclose(transform(matrix @ invert(wanted), cloud), cloud, atol=0.2)
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1, abs=1e-9)


def test_similarity() -> None:
    cloud, reference = pair()
    wanted = small(2, 0.5, 1.02, (1, -2, 10))
    matrix, _ = align(transform(invert(wanted), cloud), reference, "similarity")
    assert np.cbrt(np.linalg.det(matrix[:3, :3])) == pytest.approx(1.02, abs=0.004)
    assert_allclose(transform(matrix @ invert(wanted), cloud), cloud, atol=0.35)


def test_more_freedom_never_fits_much_worse_and_none_changes_nothing() -> None:
    cloud, reference = pair()
    cloud = transform(invert(small(3, 1, 1, (0, 0, 5))), cloud)
    medians = []
    for mode in ("none", "shift", "rigid"):
        matrix, moved = align(cloud, reference, mode)
        medians.append(distances(moved, reference).accuracy_m())
        assert_allclose(transform(matrix, cloud), moved, atol=1e-9)
    assert medians[0] > medians[1] > medians[2]
    assert_array_equal(align(cloud, reference, "none")[0], np.eye(4))


def test_deterministic() -> None:
    cloud, reference = pair()
    assert_array_equal(align(cloud, reference, "shift")[0], align(cloud, reference, "shift")[0])


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    "points",
    [np.zeros((1, 3)), np.arange(6.0).reshape(2, 3), np.zeros((20, 3)), np.eye(3), np.tile([[0, 0, 1.0]], (9, 1))],
)
def test_degenerate_clouds_stay_finite(mode: str, points: np.ndarray) -> None:
    matrix, moved = align(points, points + np.array([1, 2, 3]), mode)
    assert np.isfinite(matrix).all()
    assert np.isfinite(moved).all()


def test_bad_input() -> None:
    with pytest.raises(InputError, match="did you mean 'rigid'"):
        align(np.eye(3), np.eye(3), "rigit")
    with pytest.raises(InputError, match="The cloud has no points"):
        align(np.zeros((0, 3)), np.eye(3), "shift")


def test_real_sparse_cloud_on_the_odm_cloud(shared_data) -> None:
    """The set's README: a constant height offset of about 10 m."""
    folder = shared_data("brighton_beach")
    enu_from_colmap = np.loadtxt(folder / "reference_colmap" / "colmap_to_enu_4x4.txt")
    sparse = transform(enu_from_colmap, read_cloud(folder / "reference_colmap" / "points.ply").points)
    utm = crs_from_enu(sparse, Origin(46.842656667, -91.994008025, epsg=32615))
    reference: Cloud = read_cloud(folder / "reference_odm" / "model.laz")
    matrix, moved = align(utm, reference.points, "shift")
    assert matrix[2, 3] == pytest.approx(10, abs=0.8)
    assert np.abs(matrix[:2, 3]).max() < 1.5
    assert distances(moved, reference.points).accuracy_m() < 0.25
