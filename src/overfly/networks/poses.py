"""Relative poses and small motions of the frames of a window, differentiable and batched (torch)."""

from __future__ import annotations

import torch
from torch import Tensor


def relative(camera_from_window: Tensor) -> Tensor:
    """Poses of all frames against the reference frame: ``frame_from_reference`` [B, K, 4, 4]; frame 0 is the identity.

    Args:
        camera_from_window: rigid [B, K, 4, 4], window units.
    """
    return camera_from_window @ inverse(camera_from_window[:, :1])


def inverse(rigid: Tensor) -> Tensor:
    """The inverse of rigid transforms [..., 4, 4]."""
    rotation = rigid[..., :3, :3].transpose(-1, -2)
    shift = -(rotation @ rigid[..., :3, 3:])
    return torch.cat([torch.cat([rotation, shift], -1), rigid[..., 3:, :]], -2)


def motion(rigid: Tensor) -> Tensor:
    """Rotation vector (axis times angle, radians, below pi) and translation of rigid [..., 4, 4] -> [..., 6]."""
    r = rigid[..., :3, :3]
    doubled = torch.stack([r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]], -1)
    sine = doubled.norm(dim=-1) / 2
    cosine = (r.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    angle = torch.atan2(sine, cosine)
    small = sine < 1e-6
    safe = torch.where(small, torch.ones_like(sine), sine)
    factor = torch.where(small, torch.full_like(sine, 0.5), angle / (2 * safe))
    return torch.cat([doubled * factor[..., None], rigid[..., :3, 3]], -1)


def transform_from(motions: Tensor) -> Tensor:
    """Rigid transforms [..., 4, 4] of rotation vectors and translations [..., 6]: the inverse of :func:`motion`."""
    x, y, z = motions[..., 0], motions[..., 1], motions[..., 2]
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*x.shape, 3, 3)
    top = torch.cat([torch.matrix_exp(skew), motions[..., 3:, None]], -1)
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=top.dtype, device=top.device).expand(*x.shape, 1, 4)
    return torch.cat([top, bottom], -2)


def true_correction(prior_from_window: Tensor, camera_from_window: Tensor) -> Tensor:
    """What the prior relative pose of each frame lacks: true = correction o prior, as a motion [B, K, 6].

    Only poses *relative to the reference frame* are corrected: images alone cannot see an error that all frames share.
    """
    return motion(relative(camera_from_window) @ inverse(relative(prior_from_window)))
