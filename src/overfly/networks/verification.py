"""Geometric verification of retrieved images: whether their key points agree on how the ground has moved.

Global descriptors bring the likely images to the top, and correspondences tell which of them show the same place
(Philbin et al. 2007, section 4). Every image is first seen from straight above by its own prior pose, so that what
is left between two views of one place is little more than a shift: each correspondence is a hypothesis of it.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from overfly.networks.encoder import MATCH_STRIDE, Encoder
from overfly.networks.matching import keypoints

SIDE = 160
"""Pixels of a ground view; its diagonal is about that of the network's images."""

ROOM = 1.25
"""Ground pixels of the view in those of the image, where both have the same number across."""

STEEPEST = 0.3
"""Cosine of the steepest line of sight whose place on the ground is the view's centre."""

KEYPOINTS = 128
WITHIN = 3.0
"""Cells: shifts nearer than this are the same; relief moves what stands above the ground."""

RIM = 2
"""Cells beside the image's border whose features have seen beyond it."""


class GroundViews(NamedTuple):
    """Match maps of M images seen from above [M, C, h, w], unit vectors, and where they show the image [M, h, w]."""

    maps: Tensor
    inside: Tensor


@torch.no_grad()
def ground_views(encoder: Encoder, images: Tensor, intrinsics: Tensor, prior_from_window: Tensor) -> GroundViews:
    """The match maps of images as seen from straight above, each by its own prior pose alone.

    Args:
        encoder: of a trained network.
        images: [M, 3, H, W] in 0..1.
        intrinsics: [M, 3, 3].
        prior_from_window: [M, 4, 4] camera from a frame whose z = 0 is the ground; its heading is that of the views.
    """
    rotation, shift = prior_from_window[:, :3, :3], prior_from_window[:, :3, 3]
    centre = -(rotation.transpose(1, 2) @ shift[..., None])[..., 0]
    forward = rotation[:, 2]
    middle = centre[:, :2] + forward[:, :2] / (-forward[:, 2:]).clamp(min=STEEPEST) * centre[:, 2:]
    pixel = ROOM * centre[:, 2] / intrinsics[:, 0, 0] * (images.shape[-1] / SIDE)
    along = torch.arange(SIDE, device=images.device) + 0.5 - SIDE / 2
    north, east = torch.meshgrid(-along, along, indexing="ij")
    places = torch.stack([east, north], -1).flatten(0, 1) * pixel[:, None, None] + middle[:, None]  # [M, SIDE², 2]
    local = F.pad(places, (0, 1)) @ rotation.transpose(1, 2) + shift[:, None]
    at = local @ intrinsics.transpose(1, 2)
    pixels = at[..., :2] / at[..., 2:].clamp(min=1e-6)
    size = images.new_tensor([images.shape[-1], images.shape[-2]])
    seen = ((pixels > 0) & (pixels < size)).all(-1) & (at[..., 2] > 0)
    grid = (pixels / size * 2 - 1).unflatten(1, (SIDE, SIDE))
    views = F.grid_sample(images, grid, padding_mode="border", align_corners=False)
    outside = 1 - seen.to(images.dtype).unflatten(1, (SIDE, SIDE))[:, None, ::MATCH_STRIDE, ::MATCH_STRIDE]
    inside = F.max_pool2d(outside, 2 * RIM + 1, 1, RIM)[:, 0] == 0
    return GroundViews(encoder.dense(views).match_map, inside)


@torch.no_grad()
def agreement(query: GroundViews, others: GroundViews) -> Tensor:
    """How well each of R images agrees with one on a shift of the ground.

    Args:
        query: one image.
        others: R images.

    Returns:
        [R], 0 to ``KEYPOINTS``: the similarity of the key points whose nearest neighbours in the other image lie
        where the best shift says, summed.
    """
    own, inside = query.maps[0].float(), query.inside[0].flatten()
    width = own.shape[-1]
    cells, distinct = keypoints(own[None], 6 * KEYPOINTS)  # many lie outside
    kept = cells[0, inside[cells[0]] & torch.isfinite(distinct[0])][:KEYPOINTS]
    if not len(kept):
        return torch.zeros(len(others.maps), device=own.device)
    shown = (others.maps.float() * others.inside[:, None]).flatten(2)
    score, found = torch.einsum("cm,rcp->rmp", own.flatten(1)[:, kept], shown).max(2)  # [R, M]
    shift = torch.stack([found % width - kept % width, found // width - kept // width], -1)
    near = (shift[:, :, None] - shift[:, None]).abs().amax(-1) < WITHIN  # [R, M, M]
    support: Tensor = (near * score.clamp(min=0)[:, None]).sum(2)
    return support.amax(1)
