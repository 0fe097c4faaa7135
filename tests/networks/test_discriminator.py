"""What the discriminator looks at."""

from __future__ import annotations

import pytest
import torch

from overfly.errors import InputError
from overfly.networks.discriminator import patches


def grid(side: int) -> torch.Tensor:
    axis = (torch.arange(side) + 0.5) * 2 / side - 1
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    return torch.stack([x, y, 0.1 * x * y], -1).reshape(1, -1, 3)


def test_patches_are_neighbourhoods_about_their_own_centre() -> None:
    cloud = grid(32)[:, torch.randperm(1024, generator=torch.Generator().manual_seed(0))]
    local = patches(cloud, 16)
    assert local.shape == (16, 64, 3)
    assert torch.allclose(local.mean(1), torch.zeros(16, 3), atol=1e-5)
    assert torch.allclose(local[..., :2].amax((1, 2)), torch.full((16,), 0.875), atol=1e-3)  # 8 x 8 points, 4 x larger


def test_one_patch_is_the_cloud_itself() -> None:
    cloud = grid(8)
    assert patches(cloud, 1) is cloud


def test_patches_divide_the_cloud() -> None:
    with pytest.raises(InputError, match="do not split into 5 patches"):
        patches(grid(8), 5)
