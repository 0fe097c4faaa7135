"""The classical plane sweep: for every pixel the height at which small patches of the frames correlate best.

Nothing is learnt here: it is what a network that sweeps has to beat. It takes exactly what the networks take.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from overfly.networks.ground import pixel_centres, rays
from overfly.networks.sweep import lines, seen

LUMA = (0.299, 0.587, 0.114)


class Heights(NamedTuple):
    """Heights [B, H, W] in window units, and whether they were measured [B, H, W] or filled in."""

    height: Tensor
    measured: Tensor


@torch.no_grad()
def correlation_sweep(batch: Mapping[str, Tensor], *, heights: int = 64, patch: int = 7, least: float = 0.5) -> Heights:
    """Zero-mean normalised cross-correlation over a sweep of horizontal planes, the best plane takes all.

    Args:
        batch: of windows; ``images``, ``intrinsics``, ``camera_from_window`` and ``height_range`` are taken.
        heights: number of planes, equally spaced over the height range; a parabola through the best one and its two
            neighbours refines it.
        patch: side of the patches, pixels, odd.
        least: pixels whose best correlation, the mean over the frames that see them, stays below this are rejected;
            they get the median height of the window's other pixels (0 where there is none).
    """
    images, poses = batch["images"], batch["camera_from_window"]
    b, k, _, height, width = images.shape
    if k == 1:
        nothing = images.new_zeros(b, height, width)
        return Heights(nothing, nothing.bool())
    gray = (images * images.new_tensor(LUMA)[:, None, None]).sum(2)
    cells = pixel_centres(width, height, width, height, images.device)
    cast = rays(cells, batch["intrinsics"][:, 0], poses[:, 0])
    paths = lines(cast, batch["intrinsics"], batch["intrinsics"], poses, (width, height))
    low, high = batch["height_range"][:, :1], batch["height_range"][:, 1:]
    planes = low + (high - low) * torch.linspace(0, 1, heights, device=images.device)  # [B, D]
    own, others = gray[:, :1], gray[:, 1:].flatten(0, 1)[:, None]
    own_mean = _mean(own, patch)
    own_spread = _mean(own * own, patch) - own_mean * own_mean
    size = images.new_tensor([width, height])
    scores = []
    for plane in planes.T:
        z = plane[:, None, None].expand(-1, 1, height * width)  # [B, 1, N]
        at = paths.own_q + z[..., None] * paths.own_r  # [B, V, N, 3]
        grid = at[..., :2] / at[..., 2:].clamp(min=1e-4) / size * 2 - 1
        there = F.grid_sample(
            others, grid.reshape(-1, height, width, 2), padding_mode="border", align_corners=False
        ).reshape(b, k - 1, height, width)
        visible = seen(paths, z)[:, :, 0].reshape(b, k - 1, height, width)
        mean = _mean(there, patch)
        spread = _mean(there * there, patch) - mean * mean
        together = _mean(own * there, patch) - own_mean * mean
        likeness = together / (own_spread * spread).clamp(min=1e-8).sqrt()
        total = (likeness * visible).sum(1) / visible.sum(1).clamp(min=1)
        scores.append(torch.where(visible.any(1), total, torch.full_like(total, -1.0)))
    volume = torch.stack(scores, 1)  # [B, D, H, W]
    best, index = volume.max(1, keepdim=True)
    measured = best[:, 0] >= least
    inner = index.clamp(1, heights - 2)
    before, middle, after = (volume.gather(1, inner + step) for step in (-1, 0, 1))
    curve = before + after - 2 * middle
    shift = torch.where(curve < -1e-6, (before - after) / (2 * curve.clamp(max=-1e-6)), torch.zeros_like(curve))
    place = torch.where(inner == index, index + shift.clamp(-0.5, 0.5), index.to(shift))[:, 0]
    found = low[..., None] + (high - low)[..., None] * place / (heights - 1)
    middles = torch.stack([h[m].median() if m.any() else h.new_zeros(()) for h, m in zip(found, measured, strict=True)])
    return Heights(torch.where(measured, found, middles[:, None, None].expand_as(found)), measured)


def _mean(images: Tensor, patch: int) -> Tensor:
    """Mean over the patch around every pixel [B, C, H, W]; beyond the border its value is repeated."""
    height, width = images.shape[-2:]
    wide = F.pad(images, [patch // 2] * 4, mode="replicate")
    rows = sum(wide[..., i : i + height, :] for i in range(1, patch)) + wide[..., :height, :]
    return (sum(rows[..., i : i + width] for i in range(1, patch)) + rows[..., :width]) / patch**2
