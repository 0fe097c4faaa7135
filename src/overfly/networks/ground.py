"""The ground plane between frames: rays of the reference frame, and all frames seen as from the reference frame.

Everything is in window units (the ground at its prior height is z = 0) and batched: B windows, K frames, frame 0 the
reference. Pixels are (u, v) with the first pixel's centre at (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from overfly.networks.blocks import grid_side

REACH = 4.0
"""Rays to and over the horizon are bent down to meet the ground at this multiple of the camera's height."""

MARGIN = 8
"""An aligned frame is wider than the image by 1 / MARGIN of it on every side: tall things move across the border."""


class Rays(NamedTuple):
    """Points over pixels: at height z a ray is at ``foot + z * rise``; both [B, N, 3], the rise's z is 1."""

    foot: Tensor
    rise: Tensor

    def at(self, height: Tensor) -> Tensor:
        """Points [B, N, 3] at heights [B, N]."""
        return self.foot + height[..., None] * self.rise


class Aligned(NamedTuple):
    """Frames as seen from the reference frame, were the world flat.

    Attributes:
        images: [B, K, 3, H + 2 H / MARGIN, W + 2 W / MARGIN]; beyond the frame's own border its border is repeated.
        intrinsics: [B, K, 3, 3], homographies that take the place of the camera matrix: a point X in the window is at
            pixel ``intrinsics @ (camera_from_window X)``, after division by the third coordinate.
        pixels: [B, K, 2, ...] where each pixel of ``images`` comes from in the frame's own image.
        size: width and height of the reference image.
    """

    images: Tensor
    intrinsics: Tensor
    pixels: Tensor
    size: tuple[int, int]


def pixel_centres(width: int, height: int, columns: int, rows: int, device: torch.device) -> Tensor:
    """Centres of ``columns`` x ``rows`` equal cells of an image: pixels [rows * columns, 2], row by row."""
    u = (torch.arange(columns, device=device) + 0.5) * (width / columns)
    v = (torch.arange(rows, device=device) + 0.5) * (height / rows)
    v, u = torch.meshgrid(v, u, indexing="ij")
    return torch.stack([u, v], -1).reshape(-1, 2)


def rays(pixels: Tensor, intrinsics: Tensor, camera_from_window: Tensor) -> Rays:
    """The rays of pixels [N, 2] or [B, N, 2] of one camera per window (intrinsics [B, 3, 3], pose [B, 4, 4])."""
    ahead = torch.cat([pixels, torch.ones_like(pixels[..., :1])], -1) @ torch.linalg.inv(intrinsics).transpose(1, 2)
    rotation = camera_from_window[:, :3, :3]
    centre = -(camera_from_window[:, None, :3, 3] @ rotation)  # [B, 1, 3]
    direction = ahead @ rotation
    flat = direction[..., :2].norm(dim=-1)
    fall = torch.maximum(-direction[..., 2], flat / REACH).clamp(min=1e-6)
    rise = torch.cat([-direction[..., :2] / fall[..., None], torch.ones_like(fall)[..., None]], -1)
    foot = centre - centre[..., 2:] * rise
    return Rays(foot, rise)


def initial_cloud(points: int, batch: Mapping[str, Tensor]) -> Tensor:
    """The uniform initial cloud: a square grid over the reference frame's image, laid on the ground at z = 0.

    Args:
        points: a square number.
        batch: of windows; ``images``, ``intrinsics`` and ``camera_from_window`` are taken.

    Returns:
        [B, points, 3], window units, row by row from the image's top.

    Raises:
        InputError: ``points`` is not a square number.
    """
    height, width = batch["images"].shape[-2:]
    side = grid_side(points)
    pixels = pixel_centres(width, height, side, side, batch["images"].device)
    return rays(pixels, batch["intrinsics"][:, 0], batch["camera_from_window"][:, 0]).foot


def align(images: Tensor, intrinsics: Tensor, camera_from_window: Tensor) -> Aligned:
    """See every frame as from the reference frame, through the ground plane.

    So turned, scaled and tilted views of one place look alike, whatever the flight path; what is left is the parallax
    of heights. Poses need only be good enough to put things roughly in place.

    Args:
        images: [B, K, C, H, W], width and height multiples of 32.
        intrinsics: [B, K, 3, 3].
        camera_from_window: [B, K, 4, 4].
    """
    b, k, _, height, width = images.shape
    on_ground = (intrinsics @ camera_from_window[:, :, :3])[..., [0, 1, 3]]  # ground (x, y, 1) -> pixel [B, K, 3, 3]
    own_from_reference = on_ground @ torch.linalg.inv(on_ground[:, :1])
    wide, tall = width + 2 * (width // MARGIN), height + 2 * (height // MARGIN)
    canvas = pixel_centres(wide, tall, wide, tall, images.device)  # pixels of the canvas
    shift = torch.eye(3, device=images.device)
    shift[0, 2], shift[1, 2] = width // MARGIN, height // MARGIN  # canvas from reference pixel
    own_from_canvas = own_from_reference @ torch.linalg.inv(shift)
    at = torch.cat([canvas, torch.ones_like(canvas[:, :1])], 1) @ own_from_canvas.flatten(0, 1).transpose(1, 2)
    ahead = at[..., 2:] > 1e-4
    pixels = torch.where(ahead, at[..., :2] / at[..., 2:].clamp(min=1e-4), torch.full_like(at[..., :2], -1e4))
    size = torch.tensor([width, height], dtype=images.dtype, device=images.device)
    grid = (pixels / size * 2 - 1).reshape(b * k, tall, wide, 2)
    seen = F.grid_sample(images.flatten(0, 1), grid, padding_mode="border", align_corners=False)
    homographies = torch.linalg.inv(own_from_canvas) @ intrinsics
    pixels = pixels.reshape(b, k, tall, wide, 2)
    return Aligned(seen.unflatten(0, (b, k)), homographies, pixels, (width, height))


def align_depth(depth: Tensor, pixels: Tensor) -> Tensor:
    """Depth [B, K, H, W] in the pixels of :class:`Aligned`; 0 where the frame sees nothing."""
    height, width = depth.shape[-2:]
    size = torch.tensor([width, height], dtype=depth.dtype, device=depth.device)
    grid = (pixels / size * 2 - 1).flatten(0, 1)
    found = F.grid_sample(depth.flatten(0, 1)[:, None], grid, mode="nearest", align_corners=False)
    return found[:, 0].unflatten(0, depth.shape[:2])
