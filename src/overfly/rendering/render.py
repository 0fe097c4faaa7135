"""From a mesh and cameras to images, with gradients back to vertices, colours and cameras."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from overfly.errors import InputError
from overfly.rendering.operations import antialias, interpolate, rasterise
from overfly.rendering.topology import Topology

NEAR = 0.01
"""Default of the least depth (units of the vertices) at which a face is drawn."""


class Views(NamedTuple):
    """B pinhole cameras (OpenCV axes; the centre of the first pixel is at (0.5, 0.5)) with images of one size.

    Attributes:
        intrinsics: [B, 3, 3], pixels; fx, fy, cx and cy are read, skew is taken as zero.
        camera_from_world: [B, 4, 4], where "world" is the frame of the vertices.
        size: width and height of the images.
    """

    intrinsics: Tensor
    camera_from_world: Tensor
    size: tuple[int, int]


class Rendered(NamedTuple):
    """What B cameras see.

    Attributes:
        image: [B, C, H, W] colours over the background (black without one), soft at silhouettes.
        coverage: [B, H, W] the mesh's share of the pixel, 0 to 1, soft at silhouettes (of parts wider than a pixel).
        depth: [B, H, W] camera z at the pixel's centre in units of the vertices; 0 where nothing is.
        face: [B, H, W] int32, the face at the pixel's centre; -1 where nothing is.
        attributes: [B, A, H, W] at the pixel's centre, 0 where nothing is; None if none were given.
    """

    image: Tensor
    coverage: Tensor
    depth: Tensor
    face: Tensor
    attributes: Tensor | None = None


def render(
    vertices: Tensor,
    colors: Tensor,
    topology: Topology,
    views: Views,
    *,
    background: Tensor | None = None,
    attributes: Tensor | None = None,
    near: float = NEAR,
) -> Rendered:
    """Draw a mesh in several views.

    Gradients of image and coverage reach the vertices both inside of faces (perspective-correct interpolation) and at
    silhouettes, also where one part hides another (antialiased edges after Laine et al. 2020, "Modular Primitives for
    High-Performance Differentiable Rendering"); those of depth and attributes reach them inside of faces. All of them
    reach colours, attributes, background and cameras, too. At silhouettes they follow the derivative of a box-filtered
    image to some 5 % where colours change slowly, less truly where they jump from pixel to pixel. Where two surfaces
    cut through each other without a common edge, the gradient does not know that the cut moves. Faces are drawn from
    both sides and without shading. There are no second derivatives.

    A face of which a vertex is nearer than ``near``, or behind the camera, is dropped as a whole, not clipped.

    Args:
        vertices: [V, 3] in a local frame.
        colors: [V, C] with C of 1 to 3.
        topology: of the faces, on the same device.
        views: the cameras.
        background: a colour [C], or images [C, H, W] or [B, C, H, W].
        attributes: [V, A], any further values per vertex, such as the vertices themselves: drawn without antialiasing.
        near: least depth of a vertex, in units of the vertices.

    Raises:
        InputError: shapes do not fit together.
    """
    _check(vertices, colors, topology, views, background, attributes)
    points, screen, rays = project(vertices, views, near)
    face = rasterise(screen.detach(), topology.faces, views.size)
    channels = colors.shape[1]
    solid = torch.ones(len(colors), 4 - channels, dtype=colors.dtype, device=colors.device)
    drawn = torch.cat([colors, solid] if attributes is None else [colors, solid, attributes], 1)  # [V, 4 + A]
    values, depth = interpolate(points, drawn.float(), topology.faces, face, rays)
    further = None if attributes is None else values[..., 4:].permute(0, 3, 1, 2)
    soft = antialias(values if attributes is None else values[..., :4], screen, topology, face, depth.detach())
    planes = soft.permute(0, 3, 1, 2).contiguous()  # [B, 4, H, W]: whatever follows is several times faster on planes
    image, coverage, *_ = planes.split([channels, 1, *[1] * (3 - channels)], 1)
    if background is not None:
        image = image + (1 - coverage) * (background[:, None, None] if background.dim() == 1 else background)
    return Rendered(image, coverage[:, 0].clamp(0, 1), depth, face, further)


def project(vertices: Tensor, views: Views, near: float = NEAR) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor]]:
    """Where vertices [V, 3] are to B cameras, in float64.

    Returns:
        Points in camera axes [B, V, 3]; column, row (pixels) and 1 / depth [B, V, 3], all 0 nearer than ``near``; and
        x [B, W] and y [B, H] of the rays through the pixels' centres at depth 1.
    """
    pose, k = views.camera_from_world.double(), views.intrinsics.double()
    points = vertices.double() @ pose[:, :3, :3].transpose(1, 2) + pose[:, None, :3, 3]
    focal, centre = k[:, (0, 1), (0, 1)], k[:, :2, 2]  # [B, 2]
    z = points[..., 2:]
    seen = z >= near
    inverse = torch.where(seen, z, 1.0).reciprocal() * seen
    pixels = points[..., :2] * inverse * focal[:, None] + centre[:, None] * seen
    rays = [
        (torch.arange(n, device=k.device, dtype=k.dtype) + 0.5 - centre[:, i : i + 1]) / focal[:, i : i + 1]
        for i, n in enumerate(views.size)
    ]
    return points, torch.cat([pixels, inverse.detach()], -1), (rays[0], rays[1])


def _check(
    vertices: Tensor, colors: Tensor, topology: Topology, views: Views, background: Tensor | None,
    attributes: Tensor | None,
) -> None:  # fmt: skip
    if vertices.shape != (topology.vertex_count, 3):
        raise InputError(
            f"Vertices have the shape {tuple(vertices.shape)}: give ({topology.vertex_count}, 3), as in the topology."
        )
    if colors.dim() != 2 or len(colors) != topology.vertex_count or not 1 <= colors.shape[1] <= 3:
        raise InputError(
            f"Colours have the shape {tuple(colors.shape)}: give ({topology.vertex_count}, C) with C of 1 to 3, "
            "and further values as attributes."
        )
    if attributes is not None and (attributes.dim() != 2 or len(attributes) != topology.vertex_count):
        raise InputError(f"Attributes have the shape {tuple(attributes.shape)}: give ({topology.vertex_count}, A).")
    b = len(views.camera_from_world)
    if views.camera_from_world.shape[1:] != (4, 4) or views.intrinsics.shape != (b, 3, 3):
        raise InputError(
            f"Views have intrinsics {tuple(views.intrinsics.shape)} and camera_from_world "
            f"{tuple(views.camera_from_world.shape)}: give (B, 3, 3) and (B, 4, 4)."
        )
    width, height = views.size
    if width < 1 or height < 1:
        raise InputError(f"The image size is {width} x {height}: give a width and a height of at least 1 pixel.")
    shape = (b, colors.shape[1], height, width)
    if background is not None and background.shape not in (shape, shape[1:], shape[1:2]):
        raise InputError(f"The background has the shape {tuple(background.shape)}: give {shape[1:2]} or {shape}.")
