"""The three steps of rendering as operations of torch: rasterise, interpolate, antialias.

Positions are float64 throughout and images float32; the kernels stand in modules of their own. Whatever
renders a mesh with these three signatures can take their place.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from overfly.rendering.topology import Topology
from overfly.scenes.device import start


def rasterise(screen: Tensor, faces: Tensor, size: tuple[int, int]) -> Tensor:
    """The face that is seen at the centre of every pixel; not differentiable.

    A centre on an edge that two faces share belongs to exactly one of them. Faces are seen from both sides. Of faces
    at the same float32 depth the first one is seen.

    Args:
        screen: float64 [B, V, 3]: column and row in pixels, 1 / depth; faces with a vertex of 1 / depth <= 0 are
            dropped.
        faces: int32 [F, 3].
        size: width and height.

    Returns:
        int32 [B, H, W], -1 where nothing is.
    """
    start()
    from overfly.rendering.kernels import cover

    (width, height), views, device = size, len(screen), screen.device
    nearest = torch.full((views, height * width), 2**63 - 1, dtype=torch.int64, device=device)
    given = [_warp(screen.contiguous(), "vec3d"), _warp(faces, "vec3i"), width, height, _warp(nearest)]
    _launch(cover, (views, len(faces)), device, given)
    return nearest.to(torch.int32).view(views, height, width)  # the lower half of the bits: -1 where nothing was seen


def interpolate(
    points: Tensor, attributes: Tensor, faces: Tensor, face: Tensor, rays: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """Attributes and depth where the rays of the pixels meet the faces seen there, perspective-correct.

    Differentiable in points, attributes and rays.

    Args:
        points: float64 [B, V, 3] vertices in camera axes.
        attributes: float32 [V, C], any C.
        faces: int32 [F, 3].
        face: int32 [B, H, W], -1 where nothing is.
        rays: float64 x [B, W] and y [B, H] of the pixels' rays at depth 1.

    Returns:
        float32 [B, H, W, C] and the depth [B, H, W], 0 where nothing is.
    """
    channels = attributes.shape[1]
    padded = torch.nn.functional.pad(attributes, (0, -channels % 4))
    values, depth = _Interpolate.apply(points, padded, faces, face, *rays)
    return values[..., :channels] if channels % 4 else values, depth


def antialias(values: Tensor, screen: Tensor, topology: Topology, face: Tensor, depth: Tensor) -> Tensor:
    """Values with soft steps where the surface ends or hides another one: how gradients reach silhouettes.

    Where two pixels side by side see different faces, the nearer surface is followed towards the other pixel. If it
    ends or folds back in between, the pixel in which that edge lies takes its share of the other one's values.
    Differentiable in values and screen. Where surfaces only cut through each other no edge exists and nothing changes.

    Args:
        values: float32 [B, H, W, C], any C.
        screen: float64 [B, V, 3] as in :func:`rasterise`.
        topology: of the mesh.
        face: int32 [B, H, W].
        depth: float32 [B, H, W].

    Returns:
        float32 [B, H, W, C].
    """
    channels = values.shape[3]
    padded = torch.nn.functional.pad(values, (0, -channels % 4)) if channels % 4 else values
    softened = _Antialias.apply(padded, screen, topology, face, depth)
    return softened[..., :channels] if channels % 4 else softened


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, points: Tensor, attributes: Tensor, faces: Tensor, face: Tensor, ray_x: Tensor, ray_y: Tensor
    ) -> tuple[Tensor, Tensor]:
        start()
        from overfly.rendering.kernels import blend_corners

        points, attributes, ray_x, ray_y = (x.contiguous() for x in (points, attributes, ray_x, ray_y))
        values = torch.zeros(*face.shape, attributes.shape[1], device=face.device)
        depth = torch.zeros(face.shape, device=face.device)
        ctx.save_for_backward(points, attributes, faces, face, ray_x, ray_y)
        given = _interpolated(points, attributes, faces, face, ray_x, ray_y)
        _launch(blend_corners, face.shape, face.device, [*given, _quads(values), _warp(depth)])
        return values, depth

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        from overfly.rendering.kernels import blend_corners_backward

        points, attributes, _, face, ray_x, ray_y = ctx.saved_tensors
        to_points, to_attributes, to_x, to_y = (torch.zeros_like(x) for x in (points, attributes, ray_x, ray_y))
        of_values, of_depth = (g.contiguous() for g in gradients)
        given = [*_interpolated(*ctx.saved_tensors), _quads(of_values), _warp(of_depth)]
        found = [_warp(to_points, "vec3d"), _quads(to_attributes), _warp(to_x), _warp(to_y)]
        _launch(blend_corners_backward, face.shape, face.device, [*given, *found])
        return to_points, to_attributes, None, None, to_x, to_y


def _interpolated(
    points: Tensor, attributes: Tensor, faces: Tensor, face: Tensor, ray_x: Tensor, ray_y: Tensor
) -> list[Any]:
    placed = [_warp(points, "vec3d"), _quads(attributes), _warp(faces, "vec3i")]
    return [*placed, *(_warp(x) for x in (face, ray_x, ray_y))]


class _Antialias(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, screen: Tensor, topology: Topology, face: Tensor, depth: Tensor) -> Tensor:
        start()
        from overfly.rendering.silhouette_kernels import find_steps, soften

        values, screen = values.contiguous(), screen.contiguous()
        steps = torch.empty(*face.shape, 2, dtype=torch.int32, device=face.device)
        softened = values.clone()
        corners = [_warp(screen, "vec3d"), _warp(topology.faces, "vec3i")]
        search = [_warp(topology.neighbours, "vec3i"), _warp(face), _warp(depth.contiguous())]
        _launch(find_steps, face.shape, face.device, [*corners, *search, _warp(steps, "vec2i")])
        _launch(soften, face.shape, face.device, [*corners, _warp(steps, "vec2i"), _quads(values), _quads(softened)])
        ctx.save_for_backward(values, screen, topology.faces, steps)
        return softened

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        from overfly.rendering.silhouette_kernels import soften_backward

        values, screen, faces, steps = ctx.saved_tensors
        of_softened, to_screen = gradients[0].contiguous(), torch.zeros_like(screen)
        to_values = of_softened.clone()
        given = [_warp(screen, "vec3d"), _warp(faces, "vec3i"), _warp(steps, "vec2i"), _quads(values)]
        found = [_quads(of_softened), _quads(to_values), _warp(to_screen, "vec3d")]
        _launch(soften_backward, steps.shape[:3], steps.device, [*given, *found])
        return to_values, to_screen, None, None, None


def _warp(x: Tensor, kind: str | None = None) -> Any:
    """A tensor as an array of warp, without a copy; ``kind``: the vector that its last dimension is."""
    import warp as wp

    x = x.detach() if x.numel() else torch.zeros(x.shape, dtype=x.dtype, device=x.device)  # with plain strides
    return wp.from_torch(x, dtype=getattr(wp, kind) if kind else None, requires_grad=False)


def _quads(x: Tensor) -> Any:
    """[..., C] as an array [..., C / 4] of four channels."""
    return _warp(x.detach().unflatten(-1, (-1, 4)), "vec4")


def _launch(kernel: Any, dim: tuple[int, ...], device: torch.device, inputs: list[Any]) -> None:
    import warp as wp

    if 0 in dim:
        return
    stream = wp.stream_from_torch(torch.cuda.current_stream(device)) if device.type == "cuda" else None
    wp.launch(kernel, dim=tuple(dim), inputs=inputs, device=wp.device_from_torch(device), stream=stream)
