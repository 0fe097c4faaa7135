"""Chamfer and EMD as losses: the metrics' values, true gradients, nothing reduced over the batch."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck
from torch.nn.functional import mse_loss

from overfly.losses import chamfer, emd
from overfly.metrics import functional as f


def clouds(batch: int = 3, n: int = 40, m: int = 50, seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    first = torch.rand(batch, n, 3, generator=generator, dtype=torch.float64)
    return first, torch.rand(batch, m, 3, generator=generator, dtype=torch.float64)


def slow_chamfer(predicted: Tensor, target: Tensor) -> Tensor:
    """All pairwise differences through autograd."""
    squared = (predicted[:, :, None] - target[:, None]).square().sum(-1)
    return squared.amin(2).mean(1) + squared.amin(1).mean(1)


def test_hand_values() -> None:
    a = torch.tensor([[[0, 0, 0], [4, 0, 0.0]]])
    b = torch.tensor([[[0, 0, 1], [4, 3, 0.0]]])
    assert chamfer(a, b).tolist() == [(1 + 9) / 2 + (1 + 9) / 2]
    assert emd(a, b).tolist() == [(1 + 3) / 2]


def test_values_and_gradients_equal_the_slow_form() -> None:
    predicted, target = clouds()
    predicted.requires_grad_(), target.requires_grad_()
    fast, slow = chamfer(predicted, target), slow_chamfer(predicted, target)
    assert fast.shape == (3,)
    torch.testing.assert_close(fast, slow, rtol=1e-12, atol=0)
    for got, wanted in zip(
        torch.autograd.grad(fast.sum(), [predicted, target]), torch.autograd.grad(slow.sum(), [predicted, target])
    ):
        torch.testing.assert_close(got, wanted, rtol=1e-10, atol=1e-14)


def test_equal_to_the_metrics() -> None:
    predicted, target = clouds(n=50)
    for loss, metric in ((chamfer, f.chamfer_m2), (emd, f.emd_m)):
        expected = [metric(p, t) for p, t in zip(predicted, target)]
        np.testing.assert_allclose(loss(predicted, target), expected, rtol=1e-12)
        single = loss(predicted.float(), target.float())
        assert single.dtype == torch.float32
        np.testing.assert_allclose(single, expected, rtol=1e-5)


@pytest.mark.parametrize("loss", [chamfer, emd])
def test_gradcheck(loss) -> None:
    predicted, target = clouds(2, 7, 7)
    assert gradcheck(loss, (predicted.requires_grad_(), target.requires_grad_()), eps=1e-7, atol=1e-6)


@pytest.mark.parametrize("loss", [chamfer, emd])
def test_zero_and_finite_gradient_on_identity(loss) -> None:
    predicted, _ = clouds()
    predicted.requires_grad_()
    value = loss(predicted, predicted.detach().flip(1))
    assert value.tolist() == [0, 0, 0]
    assert torch.autograd.grad(value.sum(), predicted)[0].abs().max() == 0


@pytest.mark.parametrize("loss", [chamfer, emd])
def test_permutation_and_rigid_motion_change_nothing(loss) -> None:
    predicted, target = clouds(n=50)
    value = loss(predicted, target)
    order = torch.randperm(50, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(loss(predicted[:, order], target), value)
    turn = torch.linalg.qr(torch.rand(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2)))[0]
    torch.testing.assert_close(loss(predicted @ turn + 7, target @ turn + 7), value)


def test_samples_of_a_batch_do_not_see_each_other() -> None:
    predicted, target = clouds(n=50)
    for loss in (chamfer, emd):
        alone = torch.cat([loss(predicted[i : i + 1], target[i : i + 1]) for i in range(3)])
        torch.testing.assert_close(loss(predicted, target), alone, rtol=1e-12, atol=0)


@pytest.mark.parametrize("loss", [chamfer, emd])
def test_descent_reaches_the_target(loss) -> None:
    predicted, target = clouds(1, 20, 20)
    predicted.requires_grad_()
    optimiser = torch.optim.Adam([predicted], lr=0.02)
    before = loss(predicted, target).item()
    for _ in range(150):
        optimiser.zero_grad()
        loss(predicted, target).sum().backward()
        optimiser.step()
    assert loss(predicted, target).item() < 0.1 * before
    assert torch.isfinite(mse_loss(predicted, predicted))


def test_bad_input() -> None:
    predicted, target = clouds()
    for loss in (chamfer, emd):
        with pytest.raises(ValueError, match="empty"):
            loss(predicted[:, :0], target)
        with pytest.raises(ValueError, match=r"\[B, N, 3\]"):
            loss(predicted[0], target)
        with pytest.raises(ValueError, match=r"\[B, N, 3\]"):
            loss(predicted[:2], target)
        with pytest.raises(ValueError, match="NaN"):
            loss(predicted * torch.nan, target)
    with pytest.raises(ValueError, match="40 and 50"):
        emd(predicted, target)
