"""Losses between a rendered image and its photograph: pure, differentiable, one value per image.

Images are [B, C, H, W] in 0..1. An optional ``mask`` [B, H, W] weights their pixels by 0..1: pixels of weight 0 have
neither influence nor gradient, and no gradient flows into the mask (or a rendering could improve by hiding). An image
without a weighted pixel counts as equal to its photograph.

Equation numbers are those of the paper on construction progress; its method is SS-3D-GAN (Yu et al. 2019).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import conv2d

SIGMA = 1.5  # of SSIM's Gaussian window, pixels (Wang et al. 2004); it is cut off at 3.5 sigma: 11 x 11 pixels
MAD = 1.4826  # standard deviations of a normal distribution per median absolute deviation
TINY = 1e-12  # a divisor for sums of weights that are 0


def psnr(rendered: Tensor, photograph: Tensor, *, mask: Tensor | None = None, maximum: float = 1.0) -> Tensor:
    """Peak signal-to-noise ratio, Eq. 2.

    The relative mean squared error is floored at 1e-10: equal images have 100 dB and no gradient.

    Args:
        rendered, photograph: [B, C, H, W].
        mask: [B, H, W], or None for all pixels.
        maximum: the largest value that a pixel can have.

    Returns:
        [B], dB, at most 100.
    """
    _check(rendered, photograph, mask)
    mse = _mean((rendered - photograph).square(), mask) / maximum**2
    return -10 * mse.clamp(min=1e-10).log10()


def ssim(rendered: Tensor, photograph: Tensor, *, mask: Tensor | None = None) -> Tensor:
    """Structural similarity, Eq. 3, as the mean over channels and local windows (Wang et al. 2004).

    The windows are Gaussian (sigma 1.5 pixels, 11 x 11) and lie within the image; C1 = 0.01^2, C2 = 0.03^2. With a
    mask, a window's means, variances and covariance are those of its weighted pixels, and windows count by the weight
    of their central pixel.

    Args:
        rendered, photograph: [B, C, H, W], at least 11 x 11 pixels.
        mask: [B, H, W], or None for all pixels.

    Returns:
        [B], -1..1; 1 for equal images.

    Raises:
        ValueError: shapes do not match, or the images are smaller than a window.
    """
    _check(rendered, photograph, mask)
    weights = gaussian(SIGMA)
    reach = len(weights) // 2
    height, width = rendered.shape[2:]
    if min(height, width) < len(weights):
        raise ValueError(f"SSIM needs images of at least 11 x 11 pixels, not {height} x {width}: render larger ones.")
    x, y = rendered, photograph
    # The two variances only occur as their sum. The photograph stays apart: it usually needs no gradient.
    ours = [x, x * x + y * y, x * y]
    if mask is None:
        mx, energy, xy = _blur(torch.cat(ours, 1), weights).chunk(3, 1)
        my = _blur(y, weights)
        central = None
    else:
        w = mask.detach().to(x.dtype)[:, None]
        total = _blur(w, weights).clamp(min=TINY)
        mx, energy, xy = (_blur(torch.cat(ours, 1) * w, weights) / total).chunk(3, 1)
        my = _blur(y * w, weights) / total
        central = w[:, 0, reach:-reach, reach:-reach]
    c1, c2 = 0.01**2, 0.03**2
    mxy, squares = mx * my, mx * mx + my * my
    similarity = (2 * mxy + c1) * (2 * (xy - mxy) + c2) / ((squares + c1) * (energy - squares + c2))
    return _or_one(_mean(similarity, central), central)


def nc(rendered: Tensor, photograph: Tensor, *, mask: Tensor | None = None) -> Tensor:
    """Normalised correlation, Eq. 4: the inner product over the norms, nothing subtracted.

    An image darker than 0.001 (root mean square) counts as that bright: black has a correlation of 0 and a finite
    gradient.

    Args:
        rendered, photograph: [B, C, H, W].
        mask: [B, H, W], or None for all pixels.

    Returns:
        [B], 0..1 for images in 0..1.
    """
    _check(rendered, photograph, mask)
    energies = _mean(rendered.square(), mask).clamp(min=1e-6) * _mean(photograph.square(), mask).clamp(min=1e-6)
    return _or_one(_mean(rendered * photograph, mask) / energies.sqrt(), mask)


def generalised_sigmoid(x: Tensor, centre: float = 45.0, slope: float = 0.1) -> Tensor:
    """1 / (1 + exp(-slope (x - centre))), Eq. 5, which takes dB to 0..1; the defaults are the paper's."""
    return torch.sigmoid(slope * (x - centre))


def reconstruction(
    rendered: Tensor,
    photograph: Tensor,
    *,
    alpha: float,
    beta: float,
    gamma: float,
    centre: float,
    slope: float,
    mask: Tensor | None = None,
) -> Tensor:
    """One summand of Eq. 6: alpha (1 - sigmoid(PSNR)) + beta (1 - SSIM) + gamma (1 - NC).

    Args:
        rendered, photograph: [B, C, H, W].
        alpha, beta, gamma: weights; a measure of weight 0 is not computed.
        centre: of the sigmoid, dB. The paper's 45 dB leaves nearly no gradient at the 20 to 30 dB of real images.
        slope: of the sigmoid, per dB.
        mask: [B, H, W], or None for all pixels.

    Returns:
        [B].
    """
    _check(rendered, photograph, mask)
    loss = rendered.new_zeros(len(rendered))
    if alpha:
        loss = loss + alpha * (1 - generalised_sigmoid(psnr(rendered, photograph, mask=mask), centre, slope))
    if beta:
        loss = loss + beta * (1 - ssim(rendered, photograph, mask=mask))
    if gamma:
        loss = loss + gamma * (1 - nc(rendered, photograph, mask=mask))
    return loss


def critic(real: Tensor, fake: Tensor) -> Tensor:
    """What the critic minimises, fake - real, from scores [B] -> [B]: minus the Wasserstein estimate (Eq. 7).

    Add theta times :func:`gradient_penalty`.
    """
    return fake - real


def adversarial(fake: Tensor) -> Tensor:
    """The generator's share of Eq. 7, -score, from scores [B] -> [B]; Eq. 1 adds it with the weight lambda."""
    return -fake


def gradient_penalty(critic: Callable[[Tensor], Tensor], real: Tensor, fake: Tensor, mix: Tensor) -> Tensor:
    """How far the critic's slope is from 1 between real and fake, squared (Gulrajani et al. 2017).

    It is *added* to what the critic minimises: Eq. 8 subtracts it, which is right for the player that maximises only.
    Computed in float32 at least, autocast or not; gradients reach the critic's weights alone.

    Args:
        critic: images [B, C, H, W] -> scores [B], every image on its own (no batch normalisation).
        real, fake: [B, C, H, W].
        mix: the place on the line from fake (0) to real (1), uniform in 0..1 [B].

    Returns:
        [B], squared score per unit of distance between images.
    """
    _check(real, fake, None)
    dtype = torch.promote_types(real.dtype, torch.float32)
    real, fake = real.detach().to(dtype), fake.detach().to(dtype)
    with torch.autocast(real.device.type, enabled=False), torch.enable_grad():
        between = torch.lerp(fake, real, mix.to(dtype).reshape(-1, 1, 1, 1)).requires_grad_()
        (slope,) = torch.autograd.grad(critic(between).sum(), between, create_graph=True)
        return (torch.linalg.vector_norm(slope.flatten(1), dim=1) - 1).square()


def gains(
    rendered: Tensor, photograph: Tensor, mask: Tensor | None = None, limits: tuple[float, float] = (0.5, 2.0)
) -> Tensor:
    """The exposure of each photograph: the gain per channel that makes the rendering most like it (least squares).

    photograph ~ gain x rendered, in closed form with a prior for gain 1 that only shows where the rendering is black.
    Use ``gains(...).detach()`` where exposure shall be a nuisance, not a way to lower the loss.

    Args:
        rendered, photograph: [B, C, H, W].
        mask: [B, H, W], or None for all pixels.
        limits: the lowest and highest gain, one stop either way by default.

    Returns:
        [B, C].
    """
    _check(rendered, photograph, mask)
    products = _channel_means(rendered * photograph, mask)
    return ((products + 1e-6) / (_channel_means(rendered.square(), mask) + 1e-6)).clamp(*limits)


@torch.no_grad()
def robust_mask(
    rendered: Tensor,
    photograph: Tensor,
    coverage: Tensor,
    *,
    k: float = 3.0,
    floor: float = 0.02,
    sigma: float = SIGMA,
) -> Tensor:
    """The coverage without outliers: what moved or is not part of the mesh does not pull at it. No gradient.

    Residuals (mean over channels of the absolute difference) are blurred, so that areas are judged and not single
    pixels (as in RobustNeRF, Sabour et al. 2023); an outlier exceeds the image's median by k robust standard
    deviations (1.4826 MAD).

    Args:
        rendered, photograph: [B, C, H, W].
        coverage: weights of pixels that the mesh covers [B, H, W].
        k: standard deviations above the median.
        floor: a blurred residual below it is never an outlier, whatever the statistics say.
        sigma: of the blur, pixels.

    Returns:
        [B, H, W]: ``coverage``, and 0 for outliers.
    """
    _check(rendered, photograph, coverage)
    weights = gaussian(sigma)
    reach = len(weights) // 2
    w = coverage.to(rendered.dtype)[:, None]
    residual = (rendered - photograph).abs().mean(1, keepdim=True)
    padded = torch.nn.functional.pad(torch.cat([residual * w, w], 1), [reach] * 4)  # nothing beyond the border counts
    summed, total = _blur(padded, weights).unbind(1)
    blurred = summed / total.clamp(min=TINY)
    limits = []
    for image, covered in zip(blurred, coverage > 0, strict=True):
        seen = image[covered] if covered.any() else image.new_zeros(1)
        median = seen.median()
        limits.append((median + k * MAD * (seen - median).abs().median()).clamp(min=floor))
    kept = blurred <= torch.stack(limits)[:, None, None] if limits else blurred > 0
    return coverage * kept


def gaussian(sigma: float) -> list[float]:
    """A normalised Gaussian window of 2 round(3.5 sigma) + 1 pixels."""
    reach = int(3.5 * sigma + 0.5)
    at = torch.arange(-reach, reach + 1, dtype=torch.float64)
    weights = torch.exp(-(at**2) / (2 * sigma**2))
    normalised: list[float] = (weights / weights.sum()).tolist()
    return normalised


def _blur(images: Tensor, weights: list[float]) -> Tensor:
    """Separable convolution without padding: [B, C, H, W] -> [B, C, H - n + 1, W - n + 1]."""
    channels = images.shape[1]
    kernel = torch.tensor(weights, dtype=images.dtype, device=images.device).expand(channels, 1, 1, -1)
    rows = conv2d(images, kernel, groups=channels)
    return conv2d(rows, kernel.transpose(2, 3), groups=channels)


def _mean(values: Tensor, mask: Tensor | None) -> Tensor:
    """Weighted mean of each image [B, C, H, W] -> [B]; 0 without a weighted pixel."""
    return _channel_means(values, mask).mean(1)


def _channel_means(values: Tensor, mask: Tensor | None) -> Tensor:
    """Weighted mean of each channel [B, C, H, W] -> [B, C]; 0 without a weighted pixel."""
    if mask is None:
        return values.mean((2, 3))
    weights = mask.detach().to(values.dtype)
    total = weights.sum((1, 2)).clamp(min=TINY)
    return (values * weights[:, None]).sum((2, 3)) / total[:, None]


def _or_one(similarity: Tensor, mask: Tensor | None) -> Tensor:
    """The similarity [B], and 1 where a mask has no weighted pixel."""
    return similarity if mask is None else torch.where((mask > 0).flatten(1).any(1), similarity, 1.0)


def _check(first: Tensor, second: Tensor, mask: Tensor | None) -> None:
    if first.ndim != 4 or first.shape != second.shape:
        raise ValueError(
            f"Two batches of images [B, C, H, W] are compared, not {tuple(first.shape)} and {tuple(second.shape)}."
        )
    if mask is not None and mask.shape != (first.shape[0], *first.shape[2:]):
        raise ValueError(f"The mask of images {tuple(first.shape)} is [B, H, W], not {tuple(mask.shape)}.")
