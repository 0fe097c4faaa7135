"""The benchmark's F-score against its own steps, written out slowly."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest
from numpy.testing import assert_allclose

from overfly.errors import InputError
from overfly.metrics.tanks_and_temples import tanks_and_temples, voxel_means


def slow_means(points: np.ndarray, size: float) -> np.ndarray:
    """Open3D's voxel_down_sample in words: grid from the minimum less half a voxel, mean of the points."""
    low = points.min(0) - size / 2
    voxels = defaultdict(list)
    for point in points:
        voxels[tuple(np.floor((point - low) / size).astype(int))].append(point)
    return np.array([np.mean(v, axis=0) for _, v in sorted(voxels.items())])


def test_voxel_means() -> None:
    points = np.random.default_rng(0).uniform(0, 5, (400, 3)) + np.array([576_714, 5_188_161, 162])
    assert_allclose(voxel_means(points, 0.9), slow_means(points, 0.9), rtol=0, atol=1e-8)


def test_against_the_slow_steps() -> None:
    rng = np.random.default_rng(1)
    reference = rng.uniform(0, 10, (1500, 3)) * [1, 1, 0.05]
    cloud = reference[rng.random(1500) < 0.6] + rng.normal(0, 0.1, 3)
    shift = np.eye(4)
    shift[:3, 3] = [0.05, -0.1, 0.02]
    tau = 0.3
    a, b = cloud + shift[:3, 3], reference
    a, b = (slow_means(p[(p[:, 0] > 2) & (p[:, 0] < 8) & (p[:, 1] > 1) & (p[:, 1] < 9)], tau / 2) for p in (a, b))
    d = np.linalg.norm(a[:, None] - b[None], axis=-1)
    precision, recall = (d.min(1) < tau).mean(), (d.min(0) < tau).mean()
    score = tanks_and_temples(
        cloud, reference, tau, reference_from_cloud=shift, crop_polygon=[(2, 1), (8, 1), (8, 9), (2, 9)]
    )
    assert_allclose(score, [precision, recall, 2 * precision * recall / (precision + recall)], atol=1e-12)
    assert 0 < score.fscore < 1


def test_zero_where_nothing_fits_or_nothing_is_left() -> None:
    cloud = np.zeros((5, 3))
    assert tanks_and_temples(cloud, cloud + 100, 1.0) == (0, 0, 0)
    assert tanks_and_temples(cloud, cloud, 1.0, crop_heights=(5, 6)) == (0, 0, 0)
    assert tanks_and_temples(cloud, cloud, 1.0) == (1, 1, 1)


def test_concave_crop() -> None:
    grid = np.stack(np.meshgrid(np.arange(0.5, 4), np.arange(0.5, 4), [0.0]), -1).reshape(-1, 3)
    notch = [(0, 0), (4, 0), (4, 4), (2, 4), (2, 2), (0, 2)]  # an L of 12 of the 16 cells
    corner = grid[(grid[:, 0] < 2) & (grid[:, 1] > 2)]
    lost = tanks_and_temples(grid, corner, 0.5, crop_polygon=notch)
    assert lost == (0, 0, 0)
    assert tanks_and_temples(grid, grid, 0.5, crop_polygon=notch).fscore == 1


def test_bad_input() -> None:
    with pytest.raises(InputError, match="threshold"):
        tanks_and_temples(np.eye(3), np.eye(3), 0)
    with pytest.raises(InputError, match="three corners"):
        tanks_and_temples(np.eye(3), np.eye(3), 1, crop_polygon=[(0, 0), (1, 1)])
