"""The sweep's kernels against the same operation in plain torch."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from overfly.errors import InputError
from overfly.networks.ground import align, pixel_centres, rays
from overfly.networks.sweep import Lines, agreement, lines, seen
from terrain import make_batch

WIDTH, HEIGHT, STRIDE, GROUPS = 64, 32, 2, 2


def plainly(reference: Tensor, others: Tensor, cast: Lines, heights: Tensor) -> tuple[Tensor, Tensor]:
    """``agreement`` as one would write it first: every sample of every frame is a tensor of its own."""
    b, v, c, h, w = others.shape
    at = cast.q[:, :, None] + heights[:, None, ..., None] * cast.r[:, :, None]
    size = torch.tensor([w, h]) * STRIDE
    grid = at[..., :2] / at[..., 2:].clamp(min=1e-4) / size * 2 - 1
    visible = seen(cast, heights) & (at[..., 2] > 1e-4) & (grid.abs() < 1).all(-1)
    sampled = F.grid_sample(others.flatten(0, 1), grid.flatten(0, 1), align_corners=False).unflatten(0, (b, v))
    likeness = (sampled * reference[:, None, :, None]).unflatten(2, (GROUPS, c // GROUPS)).sum(3) * GROUPS
    likeness = torch.where(visible[:, :, None], likeness, 0)
    count = visible.float().sum(1, keepdim=True)
    best = torch.where(visible[:, :, None], likeness, -9).amax(1)
    best = torch.where(count > 0, best, 0)
    return torch.cat([likeness.sum(1) / count.clamp(min=1), best, count / v], 1), visible


def make_inputs(width: int = WIDTH, height: int = HEIGHT, channels: int = 16) -> tuple[Tensor, Tensor, Lines, Tensor]:
    """Random features of two windows of four frames, the lines of their rays and heights to try."""
    batch = make_batch(2, frames=4, width=width, height=height)
    aligned = align(batch["images"], batch["intrinsics"], batch["camera_from_window"])
    cells = pixel_centres(width, height, width // 2, height // 2, torch.device("cpu"))
    cast = rays(cells, batch["intrinsics"][:, 0], batch["camera_from_window"][:, 0])
    found = lines(cast, aligned.intrinsics, batch["intrinsics"], batch["camera_from_window"], aligned.size)
    random = torch.Generator().manual_seed(0)
    h, w = (height + 2 * (height // 8)) // STRIDE, (width + 2 * (width // 8)) // STRIDE
    others = F.normalize(torch.randn(2, 3, channels, h, w, generator=random), dim=2)
    reference = F.normalize(torch.randn(2, channels, len(cells), generator=random), dim=1)
    return reference, others, found, torch.rand(2, 7, len(cells), generator=random) - 0.5


@pytest.fixture(scope="module")
def inputs() -> tuple[Tensor, Tensor, Lines, Tensor]:
    return make_inputs()


def test_similarities_and_visibility_are_those_of_plain_torch(inputs) -> None:  # type: ignore[no-untyped-def]
    volume, visible = agreement(*inputs, stride=STRIDE, groups=GROUPS)
    expected, expected_visible = plainly(*inputs)
    assert 0.2 < visible.float().mean() < 0.98
    assert torch.equal(visible, expected_visible)
    assert torch.allclose(volume, expected, atol=1e-5)


def test_gradients_are_those_of_plain_torch(inputs) -> None:  # type: ignore[no-untyped-def]
    reference, others, cast, heights = inputs
    weight = torch.randn(2, 2 * GROUPS + 1, *heights.shape[1:], generator=torch.Generator().manual_seed(1))
    found = []
    for operation in (plainly, lambda *given: agreement(*given, stride=STRIDE, groups=GROUPS)):
        leaves = reference.clone().requires_grad_(), others.clone().requires_grad_()
        (operation(*leaves, cast, heights)[0] * weight).sum().backward()
        found.append([leaf.grad for leaf in leaves])
    for plain, fused in zip(*found, strict=True):
        assert float(plain.abs().max()) > 0.1
        assert torch.allclose(plain, fused, atol=1e-4)


def test_channels_come_in_fours(inputs) -> None:  # type: ignore[no-untyped-def]
    reference, others, cast, heights = inputs
    with pytest.raises(InputError, match="do not split into 8 groups"):
        agreement(reference, others, cast, heights, stride=STRIDE, groups=8)
