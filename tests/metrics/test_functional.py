"""The metrics against hand values, brute force and other libraries' published formulas."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from overfly.cloud import Cloud
from overfly.errors import InputError
from overfly.metrics import functional as f

UTM = np.array([576_714.97, 5_188_161.59, 162.28])
PAIRWISE = [f.chamfer_m2, f.chamfer_m, f.chamfer_sum, f.hausdorff_m, f.accuracy_m, f.completeness_m]
ALL = [*PAIRWISE, f.emd_m, f.emd_sum]


def clouds(n: int = 300, m: int = 300, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(-20, 20, (n, 3)) * [1, 1, 0.2], rng.uniform(-20, 20, (m, 3)) * [1, 1, 0.2]


def test_hand_values() -> None:
    a = np.array([[0, 0, 0], [4, 0, 0.0]])
    b = np.array([[0, 0, 1], [4, 0, 0], [4, 3, 0.0]])
    # a to b: 1 and 0; b to a: 1, 0 and 3
    assert f.chamfer_m2(a, b) == pytest.approx(1 / 2 + 10 / 3)
    assert f.chamfer_m(a, b) == pytest.approx(1 / 2 + 4 / 3)
    assert f.chamfer_sum(a, b) == pytest.approx(1 + 10)
    assert f.hausdorff_m(a, b) == 3
    assert f.precision(a, b, 0.5) == 0.5
    assert f.recall(a, b, 1.5) == pytest.approx(2 / 3)
    assert f.fscore(a, b, 1.5) == pytest.approx(2 * 1 * (2 / 3) / (1 + 2 / 3))
    assert f.accuracy_m(a, b) == 0.5
    assert f.completeness_m(a, b) == 1
    assert f.completeness_m(a, b, 0.9) == pytest.approx(1 + 0.8 * 2)
    assert f.emd_sum(a, b[:2]) == 1
    assert f.emd_m(a, b[:2]) == 0.5


def test_thresholds_are_strict_and_fscore_has_no_zero_division() -> None:
    a, b = np.zeros((1, 3)), np.array([[1.0, 0, 0]])
    assert f.precision(a, b, 1.0) == 0
    assert f.fscore(a, b, 1.0) == 0
    assert f.fscore(a, b, 1.0 + 1e-9) == 1


def brute(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    d = cdist(a, b)
    return d.min(1), d.min(0)


@pytest.mark.parametrize(("n", "m"), [(1, 1), (1, 50), (300, 200), (1500, 700)])
def test_published_formulas_of_other_libraries(n: int, m: int) -> None:
    a, b = clouds(n, m)
    forward, backward = brute(a, b)
    # Open3D's compute_metrics and point-cloud-utils' chamfer_distance
    assert f.chamfer_m(a, b) == pytest.approx(forward.mean() + backward.mean(), rel=1e-12)
    # PyTorch3D's chamfer_distance(norm=2, point_reduction="mean")
    assert f.chamfer_m2(a, b) == pytest.approx((forward**2).mean() + (backward**2).mean(), rel=1e-12)
    assert f.chamfer_sum(a, b) == pytest.approx((forward**2).sum() + (backward**2).sum(), rel=1e-12)
    # Open3D's Hausdorff distance and F-score (there in percent)
    assert f.hausdorff_m(a, b) == pytest.approx(max(forward.max(), backward.max()), rel=1e-12)
    precision, recall = (forward < 2).mean(), (backward < 2).mean()
    expected = 2 * precision * recall / (precision + recall) if precision + recall else 0
    assert f.fscore(a, b, 2.0) == pytest.approx(expected, rel=1e-12)


def test_parallel_search_gives_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    a, b = clouds(2000, 3000)
    alone = f.distances(a, b)
    monkeypatch.setattr(f, "PARALLEL_FROM", 10)
    together = f.distances(a, b)
    assert_array_equal(alone.to_reference, together.to_reference)
    assert_array_equal(alone.to_cloud, together.to_cloud)


def test_emd_against_all_permutations() -> None:
    a, b = clouds(6, 6)
    cost = cdist(a, b)
    best = min(cost[np.arange(6), list(p)].sum() for p in permutations(range(6)))
    assert f.emd_sum(a, b) == pytest.approx(best, rel=1e-12)
    assert f.emd_m(a, b) == pytest.approx(best / 6, rel=1e-12)


@pytest.mark.parametrize("metric", ALL)
def test_identity_permutation_and_rigid_motion(metric) -> None:
    a, b = clouds()
    rng = np.random.default_rng(1)
    assert metric(a, a) == pytest.approx(0, abs=1e-12)
    value = metric(a, b)
    assert value > 0
    assert metric(rng.permutation(a), rng.permutation(b)) == pytest.approx(value, rel=1e-12)
    turn = Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_matrix()
    assert metric(a @ turn.T + 5, b @ turn.T + 5) == pytest.approx(value, rel=1e-9)


@pytest.mark.parametrize("metric", ALL)
def test_utm_coordinates_lose_nothing(metric) -> None:
    a, b = clouds()
    assert metric(a + UTM, b + UTM) == pytest.approx(metric(a, b), rel=1e-8)


def test_scale_laws() -> None:
    a, b = clouds()
    assert f.chamfer_m2(3 * a, 3 * b) == pytest.approx(9 * f.chamfer_m2(a, b))
    assert f.emd_m(3 * a, 3 * b) == pytest.approx(3 * f.emd_m(a, b))
    assert f.distances(a, b).scaled(3).chamfer_m == pytest.approx(f.chamfer_m(3 * a, 3 * b))


def test_chamfer_is_symmetric_and_precision_is_the_others_recall() -> None:
    a, b = clouds(200, 500)
    assert f.chamfer_m2(a, b) == pytest.approx(f.chamfer_m2(b, a))
    assert f.precision(a, b, 2.0) == f.recall(b, a, 2.0)


def test_tensors_arrays_and_clouds_alike() -> None:
    a, b = clouds(50, 50)
    expected = f.chamfer_m(a, b)
    assert f.chamfer_m(torch.tensor(a, requires_grad=True), Cloud(b)) == expected
    assert f.chamfer_m(a.tolist(), b) == expected
    assert f.emd_m(Cloud(a), torch.tensor(b)) == f.emd_m(a, b)


@pytest.mark.parametrize("metric", ALL)
def test_bad_input_says_what_is_wrong(metric) -> None:
    a, _ = clouds(5)
    with pytest.raises(InputError, match="The cloud has no points"):
        metric(np.zeros((0, 3)), a)
    with pytest.raises(InputError, match="The reference has no points"):
        metric(a, np.zeros((0, 3)))
    with pytest.raises(InputError, match=r"shape \(5, 2\)"):
        metric(a[:, :2], a)
    with pytest.raises(InputError, match="NaN"):
        metric(a, np.where(a == a[0, 0], np.nan, a))


def test_emd_refuses_unequal_and_huge_clouds() -> None:
    a, b = clouds(5, 6)
    with pytest.raises(InputError, match="5 and 6"):
        f.emd_m(a, b)
    with pytest.raises(InputError, match="subset"):
        f.emd_sum(np.zeros((9000, 3)), np.zeros((9000, 3)))


def test_gsd_thresholds() -> None:
    assert f.gsd_thresholds(0.05) == {1: 0.05, 2: 0.1, 3: pytest.approx(0.15), 5: 0.25}
    for bad in (0, -1, np.nan):
        with pytest.raises(InputError, match="ground sampling distance"):
            f.gsd_thresholds(bad)


def test_subset_is_seeded_and_without_repetition() -> None:
    a, _ = clouds(200)
    assert_array_equal(f.subset(a, 50, 1, 2), f.subset(a, 50, 1, 2))
    assert not np.array_equal(f.subset(a, 50, 1, 2), f.subset(a, 50, 1, 3))
    assert len(np.unique(f.subset(a, 50, 0), axis=0)) == 50
    assert_array_equal(f.subset(a, 200, 0), a)


def test_gridded_and_repeated_points() -> None:
    """Equal coordinates, which an unbalanced tree could trip over."""
    grid = np.stack(np.meshgrid(np.arange(40.0), np.arange(40.0), [0.0]), -1).reshape(-1, 3)
    repeated = np.repeat(grid, 5, axis=0)
    assert f.chamfer_m(grid, repeated) == 0
    assert_allclose(f.chamfer_m(repeated, grid + np.array([0, 0, 1])), 2)
