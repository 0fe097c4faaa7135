"""The ground-plane sweep: how well the frames of a window agree, at hypothetical heights along the reference's rays.

A ray's image in another frame is a straight line that is linear in the height, in homogeneous coordinates: ``q + z r``.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from overfly.networks.ground import MARGIN, Rays

NO_BASE = 0.02
"""Frames nearer to the reference than this share of its height see no parallax: they are the same image again."""


class Lines(NamedTuple):
    """The images of N rays in the V other frames: pixel of the aligned frame ``(q + z r)[:2] / (q + z r)[2]``.

    Attributes:
        q, r: [B, V, N, 3].
        own_q, own_r: the same in the frame's own image, which decides whether it sees the point.
        apart: [B, V] whether the frame stands elsewhere than the reference.
        size: width and height of the images.
    """

    q: Tensor
    r: Tensor
    own_q: Tensor
    own_r: Tensor
    apart: Tensor
    size: tuple[int, int]


def lines(rays: Rays, aligned: Tensor, intrinsics: Tensor, camera_from_window: Tensor, size: tuple[int, int]) -> Lines:
    """The lines of rays in frames 1 to K - 1.

    Args:
        rays: of the reference frame, N of them.
        aligned: homographies [B, K, 3, 3] of the aligned frames.
        intrinsics: [B, K, 3, 3] of the frames' own images.
        camera_from_window: [B, K, 4, 4].
        size: width and height of the own images.
    """
    poses = camera_from_window[:, 1:]
    foot = torch.einsum("bvij,bnj->bvni", poses[..., :3, :3], rays.foot) + poses[:, :, None, :3, 3]
    rise = torch.einsum("bvij,bnj->bvni", poses[..., :3, :3], rays.rise)
    seen_as, own = (matrix[:, 1:].transpose(-1, -2) for matrix in (aligned, intrinsics))
    rotation = camera_from_window[..., :3, :3]
    centres = -(rotation.transpose(-1, -2) @ camera_from_window[..., :3, 3:])[..., 0]  # [B, K, 3]
    base = (centres[:, 1:] - centres[:, :1]).norm(dim=-1)
    apart = base > NO_BASE * centres[:, :1, 2].abs()
    return Lines(foot @ seen_as, rise @ seen_as, foot @ own, rise @ own, apart, size)


def seen(lines: Lines, heights: Tensor) -> Tensor:
    """Which frames have the rays' points at heights [B, D, N] inside their image: [B, V, D, N] (occlusion ignored)."""
    at = lines.own_q[:, :, None] + heights[:, None, ..., None] * lines.own_r[:, :, None]
    ahead = at[..., 2] > 1e-4
    pixels = at[..., :2] / at[..., 2:].clamp(min=1e-4)
    size = torch.tensor(lines.size, dtype=pixels.dtype, device=pixels.device)
    inside = ((pixels > 0) & (pixels < size)).all(-1)
    return ahead & inside & lines.apart[:, :, None, None]


def pixels_per_height(lines: Lines, heights: Tensor) -> Tensor:
    """How far the images of rays move per unit of height, pixels: the root mean square over what is seen [B].

    Args:
        lines: of the rays.
        heights: [B, N] about which the rate is taken.

    Returns:
        The rate, at least 0.15 and at most 1.5 times the pixels of a window unit at the ground (which is the base-to-
        height ratio); 0.4 times where no other frame sees anything.
    """
    at = lines.q + heights[:, None, :, None] * lines.r
    depth = at[..., 2:].clamp(min=1e-4)
    rate = (lines.r[..., :2] - at[..., :2] / depth * lines.r[..., 2:]) / depth  # [B, V, N, 2]
    visible = seen(lines, heights[:, None])[:, :, 0].float()
    square = (rate.square().sum(-1) * visible).flatten(1).sum(1) / visible.flatten(1).sum(1).clamp(min=1)
    unit = lines.size[0] / 2
    return torch.where(square > 0, square.sqrt().clamp(0.15 * unit, 1.5 * unit), torch.full_like(square, 0.4 * unit))


def agreement(
    reference: Tensor, others: Tensor, lines: Lines, heights: Tensor, *, stride: int, groups: int
) -> tuple[Tensor, Tensor]:
    """Similarity between the reference's features and those that the other frames show at hypothetical heights.

    Args:
        reference: unit features of the rays [B, C, N].
        others: unit feature maps of the aligned frames 1 to K - 1 [B, V, C, h, w].
        lines: of the rays.
        heights: [B, D, N], window units.
        stride: pixels of the aligned image to one cell of the maps.
        groups: of channels, each with a similarity of its own.

    Returns:
        Features [B, 2 groups + 1, D, N]: the groups' mean and the frames' best over the frames that see the point
        (0 without any), and the share of the window's other frames that do; and ``visible`` [B, V, D, N].
    """
    b, v, c, h, w = others.shape
    d, n = heights.shape[1:]
    if not v:
        zeros = torch.zeros(b, 2 * groups + 1, d, n, dtype=reference.dtype, device=reference.device)
        return zeros, torch.zeros(b, 0, d, n, dtype=torch.bool, device=reference.device)
    at = lines.q[:, :, None] + heights[:, None, ..., None] * lines.r[:, :, None]  # [B, V, D, N, 3]
    ahead = at[..., 2] > 1e-4
    size = torch.tensor([w, h], dtype=at.dtype, device=at.device) * stride
    grid = at[..., :2] / at[..., 2:].clamp(min=1e-4) / size * 2 - 1
    visible = seen(lines, heights) & ahead & (grid.abs() < 1).all(-1)
    grid = torch.where(visible[..., None], grid, torch.zeros_like(grid))
    sampled = F.grid_sample(others.flatten(0, 1), grid.flatten(0, 1), align_corners=False)  # [B V, C, D, N]
    product = sampled.unflatten(0, (b, v)) * reference[:, None, :, None]
    likeness = product.unflatten(2, (groups, c // groups)).sum(3) * groups  # [B, V, G, D, N]
    likeness = torch.where(visible[:, :, None], likeness, torch.zeros_like(likeness))
    count = visible.float().sum(1, keepdim=True)  # [B, 1, D, N]
    mean = likeness.sum(1) / count.clamp(min=1)
    best = torch.where(visible[:, :, None], likeness, torch.full_like(likeness, -2.0)).amax(1)
    best = torch.where(count > 0, best, torch.zeros_like(best))
    return torch.cat([mean, best, count / v], 1), visible


def canvas_to_reference(maps: Tensor, stride: int, size: tuple[int, int]) -> Tensor:
    """The part of maps [..., h, w] of an aligned frame that is the reference image itself."""
    width, height = size
    left, top = width // MARGIN // stride, height // MARGIN // stride
    return maps[..., top : top + height // stride, left : left + width // stride]
