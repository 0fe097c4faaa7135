"""A photograph carried over into the view of another: right where the mesh is right, hidden parts left out."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from overfly.geometry import pose, rotation_from_gimbal
from overfly.rendering import Rendered, Topology, Views, render, topology
from overfly.rendering.reproject import reproject

SIZE = (64, 48)


def views(*places: tuple[float, float], pitch: float = -90.0) -> Views:
    """Cameras 20 m above the ground that look down."""
    poses = [np.linalg.inv(pose(rotation_from_gimbal(10.0, pitch, 0), [x, y, 20.0])) for x, y in places]
    k = torch.tensor([[60.0, 0, 33], [0, 61.0, 23], [0, 0, 1]])
    return Views(k.repeat(len(poses), 1, 1), torch.tensor(np.array(poses)).float(), SIZE)


def painted(xy: Tensor) -> Tensor:
    """A smooth texture [..., 3] by place."""
    x, y = xy.unbind(-1)
    return 0.5 + 0.2 * torch.stack([torch.sin(1.1 * x + y), torch.cos(0.9 * y - x), torch.sin(x) * torch.cos(y)], -1)


def ground(box: float = 0.0) -> tuple[Tensor, Tensor, Topology]:
    """A fine plane at z = 0 in which a box of 5 m stands; vertices, colours by x and y, connections."""
    side = np.linspace(-24, 24, 193)
    x, y = np.meshgrid(side, side)
    corner = (np.arange(192)[:, None] * 193 + np.arange(192)).ravel()
    quads = np.stack([corner, corner + 1, corner + 194, corner + 193], 1)
    vertices = np.c_[x.ravel(), y.ravel(), np.zeros(x.size)]
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    if box:
        solid = trimesh.creation.box(extents=(5, 5, box)).subdivide_to_size(0.5)
        faces = np.concatenate([faces, solid.faces + len(vertices)])
        vertices = np.concatenate([vertices, solid.vertices + np.array([0, 0, box / 2 + 0.01])])
    points = torch.from_numpy(vertices).float()
    return points, painted(points[:, :2]), topology(faces, len(points))


def carry(
    source: Views, target: Views, mesh: tuple[Tensor, Tensor, Topology], photograph: Tensor, lift: Tensor | None
) -> tuple[Tensor, Tensor]:
    """``photograph`` of ``source`` in ``target``, by way of the mesh raised by ``lift``."""
    points, colors, sides = mesh
    shown = points if lift is None else points + lift * torch.tensor([0.0, 0.0, 1.0])
    with torch.no_grad():
        depth = render(shown, colors, sides, source).depth
    return reproject(photograph, source, depth, render(shown, colors, sides, target), target)


@pytest.mark.parametrize("box", [0.0, 6.0])
def test_the_right_mesh_carries_a_photograph_into_its_neighbour(box: float) -> None:
    mesh = ground(box)
    source, target = views((-3.0, 0.0), (2.0, 4.0)), views((3.0, 1.0), (-2.0, -2.0))
    photograph, true = (render(*mesh, which).image for which in (source, target))
    carried, known = carry(source, target, mesh, photograph, None)
    assert carried.shape == (2, 3, 48, 64)
    assert known.dtype == torch.bool
    error = (carried - true).abs().mean(1)
    assert 0.4 < known.float().mean() < 0.95
    assert error[known].median() < 0.003
    assert error[known].quantile(0.95) < 0.03
    assert (photograph - true).abs().mean() > 0.1  # there was something to carry
    assert error[known].mean() < error[~known].mean()


def test_what_the_other_camera_does_not_see_is_not_known() -> None:
    """Held against rays: a ground point is known exactly if the way to the other camera passes the box."""
    mesh = ground(6.0)
    source, target = views((-5.0, 0.0)), views((4.0, 0.0))
    rendered = render(*mesh, target, attributes=mesh[0])
    _, known = carry(source, target, mesh, render(*mesh, source).image, None)
    assert rendered.attributes is not None
    points = rendered.attributes[0].permute(1, 2, 0)  # [H, W, 3]
    low = points[..., 2] < 0.1
    centre = torch.linalg.inv(source.camera_from_world[0])[:3, 3]
    share = torch.linspace(0, 1, 400)[:, None, None, None]
    way = points + share * (centre - points)
    inside = (way[..., :2].abs() < 2.5).all(-1) & (way[..., 2] > 0.05) & (way[..., 2] < 6)
    hidden = low & inside.any(0)
    near = (way[..., :2].abs() < 3.2).all(-1) & (way[..., 2] < 6.8)
    free = low & ~near.any(0)
    camera = points @ source.camera_from_world[0, :3, :3].T + source.camera_from_world[0, :3, 3]
    pixel = camera[..., :2] / camera[..., 2:] * torch.tensor([60.0, 61.0]) + torch.tensor([33.0, 23.0])
    within = ((pixel > 0) & (pixel < torch.tensor([64.0, 48.0]))).all(-1)
    assert (hidden & within).sum() > 50
    assert known[0][hidden].float().mean() < 0.1
    assert known[0][free & within].float().mean() > 0.98
    assert not known[0][~within].any()


def test_nothing_is_known_off_the_mesh_or_behind_the_camera() -> None:
    points, colors, sides = ground()
    target, source = views((0.0, 0.0)), views((0.0, 0.0))
    away = points + torch.tensor([100.0, 0, 0])
    rendered = render(away, colors, sides, target)
    carried, known = reproject(torch.ones(1, 3, 48, 64), source, rendered.depth, rendered, target)
    assert not known.any()
    assert torch.isfinite(carried).all()
    up = Views(source.intrinsics, torch.diag(torch.tensor([1.0, -1, -1, 1])) @ source.camera_from_world, SIZE)
    rendered = render(points, colors, sides, target)
    _, known = reproject(torch.ones(1, 3, 48, 64), up, torch.full((1, 48, 64), 20.0), rendered, target)
    assert not known.any()


def test_a_raised_mesh_has_a_larger_error_whose_gradient_leads_back() -> None:
    mesh = ground()
    source, target = views((-3.0, 0.0), (3.0, 1.0)), views((3.0, 1.0), (-2.0, -2.0))
    photograph, true = (render(*mesh, which).image for which in (source, target))
    losses, slopes = [], []
    for height in (-0.6, -0.2, 0.0, 0.2, 0.6):
        lift = torch.tensor(height, requires_grad=True)
        carried, known = carry(source, target, mesh, photograph, lift)
        loss = ((carried - true).square().mean(1) * known).sum() / known.sum()
        (slope,) = torch.autograd.grad(loss, lift)
        losses.append(float(loss.detach()))
        slopes.append(float(slope))
    assert losses[0] > losses[1] > 5 * losses[2]
    assert losses[4] > losses[3] > 5 * losses[2]
    assert slopes[0] < slopes[1] < 0 < slopes[3] < slopes[4]
    assert slopes[3] == pytest.approx((losses[4] - losses[2]) / 0.6, rel=0.6)
    assert abs(slopes[2]) < 0.05 * slopes[3]


def test_gradients_by_finite_differences() -> None:
    rng = torch.Generator().manual_seed(0)
    size = (6, 5)
    k = torch.tensor([[6.0, 0, 3], [0, 6, 2.5], [0, 0, 1]], dtype=torch.float64)[None]
    there = torch.eye(4, dtype=torch.float64)[None].clone()
    there[0, :2, 3] = torch.tensor(
        [0.31, 0.17]
    )  # no pixel on the border between four, where bilinear images have kinks
    source, target = Views(k, there, size), Views(k, torch.eye(4, dtype=torch.float64)[None], size)
    image = torch.rand(1, 2, 5, 6, generator=rng, dtype=torch.float64, requires_grad=True)
    depth = (3 + 0.2 * torch.rand(1, 5, 6, generator=rng, dtype=torch.float64)).requires_grad_()
    face = torch.zeros(1, 5, 6, dtype=torch.int32)

    def carried(image: Tensor, depth: Tensor, pose: Tensor) -> Tensor:
        rendered = Rendered(image, torch.ones_like(depth), depth, face)
        out, known = reproject(image, source._replace(camera_from_world=pose), depth.detach(), rendered, target)
        assert out.dtype == torch.float64
        return out * known

    assert torch.autograd.gradcheck(carried, (image, depth, there.clone().requires_grad_()))
