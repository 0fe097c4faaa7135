"""The ground-plane sweep: how well the frames of a window agree, at hypothetical heights along the reference's rays.

A ray's image in another frame is a straight line that is linear in the height, in homogeneous coordinates: ``q + z r``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from overfly.errors import InputError
from overfly.networks.ground import MARGIN, Rays
from overfly.scenes.device import start

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

    Differentiable in both feature maps; the heights are taken as constants.

    Args:
        reference: unit features of the rays [B, C, N].
        others: unit feature maps of the aligned frames 1 to K - 1 [B, V, C, h, w].
        lines: of the rays.
        heights: [B, D, N], window units.
        stride: pixels of the aligned image to one cell of the maps.
        groups: of channels, each with a similarity of its own; C / groups is a multiple of 4.

    Returns:
        Features [B, 2 groups + 1, D, N]: the groups' mean and the frames' best over the frames that see the point
        (0 without any), and the share of the window's other frames that do; and ``visible`` [B, V, D, N].

    Raises:
        InputError: the channels do not split into groups of 4, 8, 12, ...
    """
    channels = reference.shape[1]
    if channels % (4 * groups):
        raise InputError(f"{channels} match channels do not split into {groups} groups of 4, 8, 12, ... channels.")
    if not others.shape[1]:
        volume = reference.new_zeros(len(reference), 2 * groups + 1, *heights.shape[1:])
        return volume, torch.zeros(len(reference), 0, *heights.shape[1:], dtype=torch.bool, device=reference.device)
    volume, visible = _Agreement.apply(
        reference.transpose(1, 2).contiguous(),
        others.permute(0, 1, 3, 4, 2).flatten(2, 3).contiguous(),
        lines,
        heights.detach().contiguous(),
        tuple(others.shape[-2:]),
        stride,
        groups,
    )
    return volume, visible.bool()


class _Agreement(torch.autograd.Function):
    """The kernels of :mod:`overfly.networks.sweep_kernels` as an operation of torch."""

    @staticmethod
    def forward(
        ctx: Any, reference: Tensor, maps: Tensor, lines: Lines, heights: Tensor, size: tuple[int, int],
        stride: int, groups: int,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        from overfly.networks.sweep_kernels import compare

        (b, d, n), v, device = heights.shape, maps.shape[1], maps.device
        volume = torch.zeros(b, 2 * groups + 1, d, n, device=device)
        best = torch.zeros(b, groups, d, n, dtype=torch.int8, device=device)
        visible = torch.zeros(b, v, d, n, dtype=torch.uint8, device=device)
        sweep = _sweep(reference, maps, lines, heights, size, stride, groups)
        _launch(compare, (b, n), device, [sweep, *(_warp(x) for x in (volume, best, visible))])
        ctx.save_for_backward(reference, maps, heights, best, visible)
        ctx.lines, ctx.size, ctx.stride, ctx.groups = lines, size, stride, groups
        ctx.mark_non_differentiable(visible)
        return volume, visible

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        from overfly.networks.sweep_kernels import compare_backward

        reference, maps, heights, best, visible = ctx.saved_tensors
        to_reference, to_maps = torch.zeros_like(reference), torch.zeros_like(maps)
        sweep = _sweep(reference, maps, ctx.lines, heights, ctx.size, ctx.stride, ctx.groups)
        given = [_warp(x) for x in (best, visible, gradients[0].contiguous())]
        found = [_warp(_quads(x), "vec4") for x in (to_reference, to_maps.flatten(0, 1))]
        _launch(compare_backward, (len(heights), heights.shape[2]), maps.device, [sweep, *given, *found])
        return to_reference, to_maps, None, None, None, None, None


def _quads(x: Tensor) -> Tensor:
    """Channels in fours: [..., C] -> [..., C / 4, 4]."""
    return x.unflatten(-1, (-1, 4))


def _warp(x: Tensor, kind: str | None = None) -> Any:
    """A tensor as an array of warp, without a copy; ``kind``: "vec3", "vec4" for its last dimension."""
    import warp as wp

    return wp.from_torch(x, dtype=getattr(wp, kind) if kind else None, requires_grad=False)


def _sweep(
    reference: Tensor, maps: Tensor, lines: Lines, heights: Tensor, size: tuple[int, int], stride: int, groups: int
) -> Any:
    start()
    from overfly.networks.sweep_kernels import Sweep

    sweep = Sweep()
    for name in ("q", "r", "own_q", "own_r"):
        setattr(sweep, name, _warp(getattr(lines, name).detach().flatten(0, 1).contiguous(), "vec3"))
    sweep.apart = _warp(lines.apart.to(torch.uint8).flatten())
    sweep.heights = _warp(heights)
    sweep.reference = _warp(_quads(reference.detach()), "vec4")
    sweep.maps = _warp(_quads(maps.detach().flatten(0, 1)), "vec4")
    sweep.views, sweep.groups = maps.shape[1], groups
    sweep.height, sweep.width = size
    sweep.stride = float(stride)
    sweep.own_width, sweep.own_height = (float(x) for x in lines.size)
    return sweep


def _launch(kernel: Any, dim: tuple[int, int], device: torch.device, inputs: list[Any]) -> None:
    import warp as wp

    stream = wp.stream_from_torch(torch.cuda.current_stream(device)) if device.type == "cuda" else None
    wp.launch(kernel, dim=dim, inputs=inputs, device=wp.device_from_torch(device), stream=stream)


def canvas_to_reference(maps: Tensor, stride: int, size: tuple[int, int]) -> Tensor:
    """The part of maps [..., h, w] of an aligned frame that is the reference image itself."""
    width, height = size
    left, top = width // MARGIN // stride, height // MARGIN // stride
    return maps[..., top : top + height // stride, left : left + width // stride]
