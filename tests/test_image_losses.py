"""Image losses: known values, the values of independent implementations, true gradients, masks, the penalty's sign."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor
from torch.autograd import gradcheck
from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

from overfly.image_losses import (
    adversarial,
    critic,
    gains,
    generalised_sigmoid,
    gradient_penalty,
    nc,
    psnr,
    reconstruction,
    robust_mask,
    ssim,
)

MEASURES = [psnr, ssim, nc]
PAPER = {"alpha": 0.5, "beta": 0.3, "gamma": 0.2, "centre": 45.0, "slope": 0.1}


def images(batch: int = 2, height: int = 19, width: int = 24, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Photographs and noisy renderings of them, in 0..1, float64."""
    generator = torch.Generator().manual_seed(seed)
    photograph = torch.rand(batch, 3, height, width, generator=generator, dtype=torch.float64)
    noise = torch.rand(photograph.shape, generator=generator, dtype=torch.float64)
    return 0.7 * photograph + 0.3 * noise, photograph


def half_mask(images: Tensor) -> Tensor:
    """1 on the left, a soft column, 0 on the right."""
    mask = torch.ones(len(images), *images.shape[2:], dtype=images.dtype)
    column = images.shape[3] // 2 + 1
    mask[..., column], mask[..., column + 1 :] = 0.5, 0
    return mask


def reference_ssim(x: np.ndarray, y: np.ndarray) -> float:
    """Wang et al. 2004 of one channel with scipy's Gaussian filter, averaged where whole windows fit."""
    blur = partial(gaussian_filter, sigma=1.5, truncate=3.5)
    mx, my = blur(x), blur(y)
    vx, vy, vxy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    c1, c2 = 0.0001, 0.0009
    similarity = (2 * mx * my + c1) * (2 * vxy + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))
    return float(similarity[5:-5, 5:-5].mean())


def test_psnr_of_a_constant_error() -> None:
    photograph = torch.full((2, 3, 12, 12), 0.5, dtype=torch.float64)
    offset = torch.tensor([0.1, 0.01], dtype=torch.float64).reshape(2, 1, 1, 1)
    torch.testing.assert_close(psnr(photograph + offset, photograph), torch.tensor([20.0, 40.0], dtype=torch.float64))
    in_bytes = psnr(255 * (photograph + offset), 255 * photograph, maximum=255)
    torch.testing.assert_close(in_bytes, torch.tensor([20.0, 40.0], dtype=torch.float64))


def test_equal_images() -> None:
    for dtype in (torch.float32, torch.float64):
        rendered = images()[1].to(dtype).requires_grad_()
        photograph = rendered.detach().clone()
        for loss, wanted in ((psnr, 100.0), (ssim, 1.0), (nc, 1.0)):
            value = loss(rendered, photograph)
            assert value.dtype == dtype
            torch.testing.assert_close(value, torch.full((2,), wanted, dtype=dtype))
            (gradient,) = torch.autograd.grad(value.sum(), rendered)
            assert gradient.abs().max() < 1e-5


def test_psnr_and_ssim_equal_other_implementations() -> None:
    rendered, photograph = images()
    for i, (x, y) in enumerate(zip(rendered, photograph)):
        by_scipy = np.mean([reference_ssim(a, b) for a, b in zip(x.numpy(), y.numpy())])
        _, full = structural_similarity_index_measure(
            x[None], y[None], data_range=1.0, sigma=1.5, return_full_image=True
        )
        by_torchmetrics = full[..., 5:-5, 5:-5].mean()  # its own mean includes windows that were padded
        assert ssim(rendered, photograph)[i].item() == pytest.approx(by_scipy, rel=1e-10)
        assert ssim(rendered, photograph)[i].item() == pytest.approx(by_torchmetrics.item(), rel=1e-6)
        assert ssim(rendered.float(), photograph.float())[i].item() == pytest.approx(by_scipy, rel=1e-5)
        noise = peak_signal_noise_ratio(x[None], y[None], data_range=1.0)
        assert psnr(rendered, photograph)[i].item() == pytest.approx(noise.item(), rel=1e-6)


def test_ssim_equals_scikit_image() -> None:
    metrics = pytest.importorskip("skimage.metrics", reason="scikit-image is not installed")
    rendered, photograph = images(1)
    wanted = metrics.structural_similarity(
        rendered[0].numpy(),
        photograph[0].numpy(),
        channel_axis=0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
    )
    assert ssim(rendered, photograph).item() == pytest.approx(wanted, rel=1e-10)


def test_ssim_of_flat_images_compares_their_means() -> None:
    flat = torch.full((1, 3, 16, 16), 0.5, dtype=torch.float64)
    wanted = (2 * 0.5 * 0.25 + 1e-4) / (0.5**2 + 0.25**2 + 1e-4)
    assert ssim(flat, flat / 2).item() == pytest.approx(wanted, rel=1e-9)


def test_nc_is_a_cosine() -> None:
    rendered, photograph = images()
    wanted = torch.nn.functional.cosine_similarity(rendered.flatten(1), photograph.flatten(1))
    torch.testing.assert_close(nc(rendered, photograph), wanted, rtol=1e-12, atol=0)
    torch.testing.assert_close(nc(0.3 * rendered, photograph), wanted, rtol=1e-12, atol=0)


def test_black_renderings_have_finite_gradients() -> None:
    rendered = torch.zeros(1, 3, 16, 16, requires_grad=True)
    photograph = images(1, 16, 16)[1].float()
    loss = reconstruction(rendered, photograph, **PAPER)
    (gradient,) = torch.autograd.grad(loss.sum(), rendered)
    assert nc(rendered, photograph).item() == 0
    assert torch.isfinite(gradient).all()
    assert gradient.mean() < 0  # brighter is better


def test_the_paper_s_sigmoid() -> None:
    at = torch.tensor([45.0, 20.0, 70.0])
    wanted = [0.5, 1 / (1 + math.exp(2.5)), 1 / (1 + math.exp(-2.5))]
    torch.testing.assert_close(generalised_sigmoid(at), torch.tensor(wanted))
    assert generalised_sigmoid(torch.tensor(25.0), centre=25.0, slope=0.3).item() == 0.5


def test_reconstruction_is_eq_6_per_image() -> None:
    rendered, photograph = images()
    p, s, n = (measure(rendered, photograph) for measure in MEASURES)
    wanted = 0.5 * (1 - 1 / (1 + torch.exp(-0.1 * (p - 45)))) + 0.3 * (1 - s) + 0.2 * (1 - n)
    torch.testing.assert_close(reconstruction(rendered, photograph, **PAPER), wanted)
    alone = reconstruction(rendered, photograph, **PAPER | {"alpha": 0.0, "gamma": 0.0, "beta": 1.0})
    torch.testing.assert_close(alone, 1 - s)


@pytest.mark.parametrize("masked", [False, True])
def test_gradcheck(masked: bool) -> None:
    rendered, photograph = images(1, 12, 14)
    photograph, rendered = photograph[:, :2], rendered[:, :2]
    mask = half_mask(photograph) if masked else None
    for loss in (partial(measure, mask=mask) for measure in MEASURES):
        assert gradcheck(loss, (rendered.requires_grad_(), photograph.requires_grad_()), eps=1e-6, atol=1e-6)
    assert gradcheck(gains, (rendered, photograph, mask))


@pytest.mark.parametrize("loss", [*MEASURES, partial(reconstruction, **PAPER), gains])
def test_masked_pixels_have_no_influence_and_no_gradient(loss) -> None:
    rendered, photograph = images()
    mask = half_mask(photograph).requires_grad_()
    value = loss(rendered.requires_grad_(), photograph, mask=mask)
    other = rendered.detach().clone()
    other[..., 14:] = 1 - other[..., 14:]
    torch.testing.assert_close(loss(other, photograph, mask=mask.detach()), value.detach(), rtol=1e-12, atol=0)
    (gradient,) = torch.autograd.grad(value.sum(), rendered)
    assert gradient[..., 14:].abs().max() == 0
    assert gradient[..., 5:13].abs().max() > 0


@pytest.mark.parametrize("loss", [*MEASURES, partial(reconstruction, **PAPER), gains])
def test_a_full_mask_changes_nothing(loss) -> None:
    rendered, photograph = images()
    full = torch.ones(2, *photograph.shape[2:], dtype=torch.float64)
    torch.testing.assert_close(loss(rendered, photograph, mask=full), loss(rendered, photograph))


def test_an_empty_mask_counts_as_equal() -> None:
    rendered, photograph = images()
    rendered, empty = rendered.requires_grad_(), torch.zeros(2, *photograph.shape[2:], dtype=torch.float64)
    for loss, wanted in ((psnr, 100), (ssim, 1), (nc, 1), (gains, 1)):
        value = loss(rendered, photograph, mask=empty)
        torch.testing.assert_close(value, torch.full_like(value, wanted))
        assert torch.autograd.grad(value.sum(), rendered)[0].abs().max() == 0


def test_the_critic_s_loss_falls_when_real_scores_rise() -> None:
    real, fake = torch.tensor([3.0, 1.0]), torch.tensor([1.0, 2.0])
    assert critic(real, fake).tolist() == [-2, 1]
    assert adversarial(fake).tolist() == [-1, -2]


def test_the_penalty_of_a_linear_critic_is_exact() -> None:
    real, fake = images(3, 8, 8)
    weights = torch.rand(1, 3, 8, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    weights /= weights.norm()
    for slope in (1.0, 3.0, 0.5):
        w = (slope * weights).requires_grad_()
        penalty = gradient_penalty(lambda x, w=w: (x * w).sum((1, 2, 3)), real, fake, torch.rand(3))
        torch.testing.assert_close(penalty, torch.full((3,), (slope - 1) ** 2, dtype=torch.float64))
        # Descent on the penalty takes the slope towards 1 from either side: d/ds (s - 1)^2 = 2 (s - 1).
        (gradient,) = torch.autograd.grad(penalty.mean(), w)
        torch.testing.assert_close((gradient * weights).sum().item(), 2 * (slope - 1), rtol=1e-9, atol=1e-9)


def test_the_penalty_is_taken_between_fake_and_real() -> None:
    real, fake = images(4, 8, 8)
    mix = torch.tensor([0.0, 1.0, 0.25, 0.5], dtype=torch.float64)
    seen = []

    def quadratic(x: Tensor) -> Tensor:
        seen.append(x.detach())
        return x.square().sum((1, 2, 3)) / 2  # its slope is the image itself

    penalty = gradient_penalty(quadratic, real, fake.requires_grad_(), mix)
    torch.testing.assert_close(seen[0][0], fake[0].detach())
    torch.testing.assert_close(seen[0][1], real[1])
    torch.testing.assert_close(seen[0][2], 0.75 * fake[2].detach() + 0.25 * real[2])
    torch.testing.assert_close(penalty, (seen[0].flatten(1).norm(dim=1) - 1).square())


def test_the_penalty_of_a_constant_critic_has_a_finite_gradient() -> None:
    real, fake = images(2, 8, 8)
    weight = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    penalty = gradient_penalty(lambda x: weight * x.sum((1, 2, 3)), real, fake, torch.rand(2))
    assert penalty.tolist() == [1, 1]
    assert torch.isfinite(torch.autograd.grad(penalty.sum(), weight)[0]).all()


def test_the_penalty_is_in_single_precision_under_autocast() -> None:
    real, fake = (image.bfloat16() for image in images(2, 8, 8))
    layer = torch.nn.Conv2d(3, 1, 8)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        penalty = gradient_penalty(lambda x: layer(x).flatten(), real, fake, torch.rand(2))
    assert penalty.dtype == torch.float32
    torch.testing.assert_close(penalty, (layer.weight.norm() - 1).square().expand(2))


def test_gains_find_the_exposure() -> None:
    rendered, _ = images()
    exposure = torch.tensor([[0.8, 1.0, 1.3], [0.6, 1.9, 1.1]], dtype=torch.float64)
    photograph = rendered * exposure[..., None, None]
    torch.testing.assert_close(gains(rendered, photograph), exposure, rtol=1e-5, atol=0)
    photograph[..., 13:] = 0.9
    torch.testing.assert_close(gains(rendered, photograph, half_mask(rendered).floor()), exposure, rtol=1e-5, atol=0)


def test_gains_are_limited_and_1_for_black_renderings() -> None:
    rendered, _ = images()
    assert gains(rendered, 9 * rendered).tolist() == [[2.0] * 3] * 2
    assert gains(rendered, 0 * rendered).tolist() == [[0.5] * 3] * 2
    assert gains(rendered, 9 * rendered, limits=(0.1, 4.0)).tolist() == [[4.0] * 3] * 2
    black = 0 * rendered
    assert gains(black, black).tolist() == [[1.0] * 3] * 2


def test_the_robust_mask_leaves_out_what_moved() -> None:
    generator = torch.Generator().manual_seed(1)
    photograph = torch.rand(2, 3, 60, 80, generator=generator)
    rendered = photograph + 0.05 * torch.randn(photograph.shape, generator=generator)
    rendered[1, :, 20:30, 40:52] += 0.5  # a car, in one image only
    coverage = torch.ones(2, 60, 80)
    coverage[:, :5] = 0
    mask = robust_mask(rendered.requires_grad_(), photograph, coverage)
    assert not mask.requires_grad
    assert mask[:, :5].max() == 0
    assert mask[1, 20:30, 40:52].max() == 0
    elsewhere = mask[1].clone()
    elsewhere[15:35, 35:57] = 1
    assert elsewhere[5:].mean() > 0.98
    assert mask[0, 5:].mean() > 0.98
    assert mask[:, 5].mean() > 0.9  # the border of the coverage is no outlier


def test_a_perfect_rendering_has_no_outliers() -> None:
    photograph = images()[1]
    rendered = photograph.clone()
    rendered[..., 3, 3] += 0.1  # blurred it stays below the floor
    coverage = half_mask(photograph)
    assert torch.equal(robust_mask(rendered, photograph, coverage), coverage)
    assert robust_mask(rendered, 1 - photograph, 0 * coverage).max() == 0


def test_errors_say_what_was_given() -> None:
    rendered, photograph = images()
    with pytest.raises(ValueError, match=r"not \(2, 3, 19, 24\) and \(2, 3, 18, 24\)"):
        psnr(rendered, photograph[:, :, 1:])
    with pytest.raises(ValueError, match=r"mask of images .* is \[B, H, W\], not \(2, 1, 19, 24\)"):
        nc(rendered, photograph, mask=torch.ones(2, 1, 19, 24))
    with pytest.raises(ValueError, match=r"at least 11 x 11 pixels, not 10 x 24"):
        ssim(rendered[:, :, :10], photograph[:, :, :10])
