from __future__ import annotations

import pytest
import torch

from overfly.errors import InputError
from overfly.networks.baselines import NearestWindow, flat_ground, mean_cloud
from overfly.networks.blocks import initial_cloud


def lifted(height: float) -> torch.Tensor:
    cloud = initial_cloud(16).clone()
    cloud[:, 2] = height + (cloud[:, 0] > 0)
    return cloud


def test_flat_ground_is_the_initial_cloud_for_every_window() -> None:
    assert torch.equal(flat_ground(3, 16)[2], initial_cloud(16))


def test_mean_cloud_has_the_mean_height_of_each_place() -> None:
    batches = [torch.stack([lifted(0.0), lifted(1.0)]), lifted(5.0)[None, torch.randperm(16)]]
    assert torch.allclose(mean_cloud(batches, 16), lifted(2.0))
    with pytest.raises(InputError, match="training window"):
        mean_cloud([], 16)


def test_nearest_window_answers_with_the_most_similar_windows_reference() -> None:
    nearest = NearestWindow()
    descriptors = torch.eye(3)[:, None]  # [B, K = 1, D]
    nearest.add({"descriptor": descriptors}, {"reference": torch.arange(3.0).reshape(3, 1, 1).expand(3, 4, 3)})
    asked = torch.tensor([[[0.1, 0.2, 0.9]], [[0.8, 0.2, 0.1]]])
    assert nearest({"descriptor": asked})[:, 0, 0].tolist() == [2.0, 0.0]
    with pytest.raises(InputError, match="no training window"):
        NearestWindow()({"descriptor": asked})
