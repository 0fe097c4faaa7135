"""The critic: a sound start at any depth, one score per image, and a training step with the gradient penalty."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from overfly.errors import InputError
from overfly.image_losses import critic as critic_loss
from overfly.image_losses import gradient_penalty
from overfly.networks.critic import Critic


def seeded(**options: int) -> Critic:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return Critic(**options)


def photographs(batch: int, size: int, seed: int = 0) -> Tensor:
    """Smooth random images."""
    coarse = torch.rand(batch, 3, 8, 8, generator=torch.Generator().manual_seed(seed))
    return nn.functional.interpolate(coarse, (size, size), mode="bilinear", align_corners=False)


@pytest.mark.parametrize("depth", [18, 50, 101])
@pytest.mark.parametrize("size", [64, 128])
def test_an_untrained_critic_has_a_slope_of_order_1(depth: int, size: int) -> None:
    images = photographs(3, size).requires_grad_()
    scores = seeded(depth=depth, width=16)(images)
    (slope,) = torch.autograd.grad(scores.sum(), images)
    assert scores.shape == (3,)
    assert scores.abs().max() < 10
    assert 0.01 < scores.std() < 10
    norms = slope.flatten(1).norm(dim=1)
    assert norms.min() > 0.1
    assert norms.max() < 10
    assert (slope == 0).float().mean() < 0.01  # strides leave no pixel unseen


def test_every_layer_gets_a_gradient_of_like_size_at_101_layers() -> None:
    network = seeded(depth=101, width=8)
    network(photographs(2, 64)).sum().backward()
    norms = torch.stack([m.weight.grad.norm() / m.weight.norm() for m in network.modules() if isinstance(m, nn.Conv2d)])
    assert torch.isfinite(norms).all()
    assert norms.max() < 1e3 * norms.min()


def test_depths_are_those_of_the_paper_and_nothing_is_normalised() -> None:
    for depth in (18, 50, 101):
        network = seeded(depth=depth, width=8)
        inside = [m for name, m in network.named_modules() if isinstance(m, nn.Conv2d) and "shortcut" not in name]
        assert len(inside) + 1 == depth  # and the last, linear one
        assert not [m for m in network.modules() if isinstance(m, nn.ReLU) or "Norm" in type(m).__name__]
    assert sum(p.numel() for p in seeded(depth=101).parameters()) == pytest.approx(42.5e6, rel=0.01)


def test_scores_do_not_depend_on_the_rest_of_the_batch() -> None:
    network, images = seeded(depth=18, width=8), photographs(3, 64)
    torch.testing.assert_close(network(images)[1:2], network(images[1:2]))


def test_a_step_with_the_gradient_penalty() -> None:
    network = seeded(depth=101, width=8)
    real, fake = photographs(2, 128), photographs(2, 128, seed=1)
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-4, betas=(0.0, 0.9))
    start = critic_loss(network(real), network(fake)).mean()
    for _ in range(2):
        optimiser.zero_grad()
        penalty = gradient_penalty(network, real, fake, torch.tensor([0.3, 0.8]))
        (critic_loss(network(real), network(fake)) + 10 * penalty).mean().backward()
        assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in network.parameters())
        optimiser.step()
    assert critic_loss(network(real), network(fake)).mean() < start


def test_the_penalty_s_gradient_is_that_of_finite_differences() -> None:
    network = seeded(depth=18, width=4).double()
    real, fake = photographs(2, 32).double(), photographs(2, 32, seed=1).double()
    mix = torch.tensor([0.3, 0.8])
    weight = network.blocks[0].branch[0].weight
    direction = torch.randn(weight.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    (gradient,) = torch.autograd.grad(gradient_penalty(network, real, fake, mix).sum(), weight)
    values = []
    for sign in (1, -1):
        with torch.no_grad():
            weight += sign * 1e-6 * direction
            values.append(gradient_penalty(network, real, fake, mix).sum().item())
            weight -= sign * 1e-6 * direction
    assert (values[0] - values[1]) / 2e-6 == pytest.approx((gradient * direction).sum().item(), rel=1e-4)


def test_other_depths_do_not_exist() -> None:
    with pytest.raises(InputError, match=r"depth 34 does not exist: take depth=18, .* 18, 50, 101"):
        Critic(depth=34)
