"""One photograph seen from the place of another, by way of the mesh between them."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from overfly.rendering.render import NEAR, Rendered, Views

HIDDEN = 0.01
"""A point is hidden from a camera that sees something nearer there, by more than this share of the point's depth."""


def reproject(
    photographs: Tensor, views: Views, depth: Tensor, rendered: Rendered, target: Views
) -> tuple[Tensor, Tensor]:
    """What the photographs of some views show at the places that the pixels of other views look at.

    If the mesh is right, a photograph that is carried over by it equals the other one; the gradient of the difference
    moves the surface (Vu et al. 2012, "High accuracy and visibility-consistent dense multiview stereo", section 4) and
    does not depend on how finely the mesh is coloured.

    Args:
        photographs: [B, C, H', W'] of ``views``.
        views: cameras that took the photographs.
        depth: rendered depth of ``views`` [B, H', W'], which tells what they do not see.
        rendered: of ``target``, with the gradient of its depth.
        target: cameras into which the photographs are carried.

    Returns:
        Images [B, C, H, W] as seen from ``target``, differentiable in the depth and the cameras; and where they are
        known [B, H, W] bool: on the mesh, inside the photograph and not hidden from it.
    """
    width, height = target.size
    k, dtype = target.intrinsics, photographs.dtype
    u = (torch.arange(width, device=k.device, dtype=dtype) + 0.5 - k[:, 0, 2, None]) / k[:, 0, 0, None]  # [B, W]
    v = (torch.arange(height, device=k.device, dtype=dtype) + 0.5 - k[:, 1, 2, None]) / k[:, 1, 1, None]  # [B, H]
    z = rendered.depth.to(dtype)
    seen = rendered.face >= 0
    points = torch.stack([u[:, None] * z, v[..., None] * z, z], -1).flatten(1, 2)  # [B, H W, 3], axes of target
    across = views.camera_from_world.to(dtype) @ torch.linalg.inv(target.camera_from_world.to(dtype))
    points = points @ across[:, :3, :3].transpose(1, 2) + across[:, None, :3, 3]
    ahead = points[..., 2] > NEAR
    safe = torch.where(ahead, points[..., 2], torch.ones_like(points[..., 2]))
    focal, centre = (views.intrinsics[:, None, [0, 1], axis].to(dtype) for axis in ([0, 1], [2, 2]))
    size = torch.tensor(views.size, device=k.device, dtype=dtype)
    place = 2 * (points[..., :2] / safe[..., None] * focal + centre) / size - 1  # [B, H W, 2]
    place = torch.where(ahead[..., None], place, torch.full_like(place, 2.0)).unflatten(1, (height, width))
    carried = grid_sample(photographs, place, padding_mode="border", align_corners=False)
    with torch.no_grad():
        nearest = grid_sample(depth[:, None].to(dtype), place, mode="nearest", align_corners=False)[:, 0]
        reach = safe.unflatten(1, (height, width))
        known = seen & (place.abs() < 1).all(-1) & (nearest > 0) & (reach - nearest < HIDDEN * reach)
    return carried, known
