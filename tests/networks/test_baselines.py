from __future__ import annotations

import numpy as np
import pytest
import torch

from overfly.errors import InputError
from overfly.networks.baselines import NearestWindow, interpolated, lifted, mean_heights
from overfly.networks.ground import initial_cloud
from terrain import make_batch


def test_mean_heights_are_those_of_each_place() -> None:
    first, second = make_batch(2), make_batch(1)
    shape = (initial_cloud(16, first)[0, :, 0] > 0).float()  # every window of make_batch has the same cameras
    first["reference"] = lifted(initial_cloud(16, first), torch.stack([shape, 1 + shape]))
    second["reference"] = lifted(initial_cloud(16, second), 5 + shape)[:, torch.randperm(16)]
    assert torch.allclose(mean_heights([first, second], 16), 2 + shape)
    with pytest.raises(InputError, match="training window"):
        mean_heights([], 16)


def test_nearest_window_answers_with_the_most_similar_windows_reference() -> None:
    nearest = NearestWindow()
    descriptors = torch.eye(3)[:, None]  # [B, K = 1, D]
    nearest.add({"descriptor": descriptors}, {"reference": torch.arange(3.0).reshape(3, 1, 1).expand(3, 4, 3)})
    asked = torch.tensor([[[0.1, 0.2, 0.9]], [[0.8, 0.2, 0.1]]])
    assert nearest({"descriptor": asked})[:, 0, 0].tolist() == [2.0, 0.0]
    with pytest.raises(InputError, match="no training window"):
        NearestWindow()({"descriptor": asked})


def test_heights_between_points_are_weighed_by_distance() -> None:
    points = np.array([[0, 0, 1.0], [4, 0, 5.0]])
    found = interpolated(np.array([[0.0, 0], [2, 0], [1, 0]]), points)
    assert found == pytest.approx([1, 3, 2])
    assert interpolated(np.array([[9.0, 9]]), points[:1]) == pytest.approx([1])
