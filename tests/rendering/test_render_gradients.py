"""Gradients of the renderer: against finite differences, against the true derivative of an image, and put to use."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from meshes import make_solid, make_views
from torch import Tensor
from torch.nn import functional as F

from overfly.geometry import look_at
from overfly.rendering import Views, reference, render


def central(loss: Callable[[Tensor], Tensor], at: Tensor, direction: Tensor, eps: float) -> Tensor:
    with torch.no_grad():
        return (loss(at + eps * direction) - loss(at - eps * direction)) / (2 * eps)


@pytest.mark.parametrize("kind", ["sphere", "box"])
def test_reference_gradients_equal_finite_differences(kind: str) -> None:
    solid, views = make_solid(kind), make_views(2)
    rng = torch.Generator().manual_seed(3)
    weights = torch.rand(2, 5, 40, 48, generator=rng, dtype=torch.float64)
    back = torch.tensor([0.1, 0.5, 0.3], dtype=torch.float64)
    given = {"vertices": solid.vertices, "colors": solid.colors, "k": views.intrinsics, "pose": views.camera_from_world}

    def loss_of(name: str) -> Callable[[Tensor], Tensor]:
        def loss(value: Tensor) -> Tensor:
            now = {**given, name: value}
            cameras = Views(now["k"], now["pose"], views.size)
            r = reference.render(now["vertices"], now["colors"], solid.topology, cameras, background=back)
            shown = torch.cat([r.image, r.coverage[:, None], r.depth[:, None]], 1)
            return ((shown if name == "colors" else (shown - 0.4).square()) * weights).sum()

        return loss

    for name, eps, tolerance in (
        ("colors", 1e-3, 1e-8),
        ("vertices", 1e-6, 1e-5),
        ("pose", 1e-7, 1e-5),
        ("k", 1e-6, 1e-5),
    ):
        loss, at = loss_of(name), given[name].clone().requires_grad_()
        (gradient,) = torch.autograd.grad(loss(at), at)
        scale = gradient.abs().max()
        assert scale > 1
        for _ in range(6):
            direction = torch.zeros_like(gradient)
            index = int(torch.randint(gradient.numel(), (1,), generator=rng))
            if name == "pose":  # some matrix elements have no meaning; all of 3 x 4 are taken at once
                direction[:, :3] = torch.randn(2, 3, 4, generator=rng, dtype=torch.float64)
            elif name == "k":
                direction[:, (0, 1, 0, 1), (0, 1, 2, 2)] = torch.randn(2, 4, generator=rng, dtype=torch.float64)
            else:
                direction[index // gradient.shape[1], index % gradient.shape[1]] = 1
            error = (central(loss, at.detach(), direction, eps) - (gradient * direction).sum()).abs() / scale
            assert error < tolerance, f"{name}: {error:.1e}"


def moved(vertices: Tensor, change: Tensor) -> Tensor:
    """The solid, not the ground, moved by the first three and scaled by 1 + the fourth."""
    solid = vertices[:-4] * (1 + change[3]) + change[:3]
    return torch.cat([solid, vertices[-4:]])


@pytest.mark.parametrize("kind", ["sphere", "box"])
def test_gradients_follow_the_true_derivative(kind: str) -> None:
    """An image whose pixels are means of 8 x 8 hard samples shows how an image really changes."""
    solid, soft, fine = make_solid(kind), make_views(3, (64, 64)), make_views(3, (64, 64), scale=8)
    rng = torch.Generator().manual_seed(0)
    weights = F.interpolate(torch.randn(3, 3, 5, 5, generator=rng), size=(64, 64), mode="bicubic").double()

    def ours(change: Tensor) -> Tensor:
        return (weights * render(moved(solid.vertices, change), solid.colors, solid.topology, soft).image).sum(
            (1, 2, 3)
        )

    def truth(change: Tensor) -> Tensor:
        sharp = render(
            moved(solid.vertices, change), solid.colors[:, :1], solid.topology, fine, attributes=solid.colors
        )
        assert sharp.attributes is not None
        return (weights * F.avg_pool2d(sharp.attributes.double(), 8)).sum((1, 2, 3))

    zero = torch.zeros(4, dtype=torch.float64)
    found = torch.autograd.functional.jacobian(ours, zero)  # [3 views, 4]
    directions = torch.eye(4, dtype=torch.float64)
    true, smoothed = (torch.stack([central(f, zero, d, 0.02) for d in directions], 1) for f in (truth, ours))
    for i, what in enumerate(["x", "y", "z", "scale"]):
        size = true[:, i].norm()
        error, over_a_step = (found - true)[:, i].norm() / size, (smoothed - true)[:, i].norm() / size
        assert error < 0.15, f"{kind}, {what}: {error:.3f}"
        assert over_a_step < 0.07, f"{kind}, {what}, over a third of a pixel: {over_a_step:.3f}"
    assert (found - true).norm() < 0.08 * true.norm()


def test_a_displaced_box_finds_back() -> None:
    solid, views = make_solid("box"), make_views(3)
    target = render(solid.vertices, solid.colors, solid.topology, views).image.detach()
    change = torch.tensor([0.15, -0.1, 0.12, 0.1], dtype=torch.float64)
    start = change.abs().max()
    change.requires_grad_()
    optimiser = torch.optim.Adam([change], lr=0.03)
    for _ in range(30):
        optimiser.zero_grad()
        image = render(moved(solid.vertices, change), solid.colors, solid.topology, views).image
        (image - target).square().mean().backward()
        optimiser.step()
    assert change.detach().abs().max() < 0.05 * start


def test_a_dented_sphere_and_its_colours_find_back() -> None:
    solid, views = make_solid("sphere"), make_views(8)
    rng = torch.Generator().manual_seed(0)
    target = render(solid.vertices, solid.colors, solid.topology, views)
    image, coverage, depth = (x.detach() for x in (target.image, target.coverage, target.depth))
    unit = solid.vertices[:-4]
    dent = 1 - 0.2 * torch.exp(-(unit - torch.tensor([0.6, 0.3, 0.7])).square().sum(1) / 0.3)
    wrong = solid.colors + 0.1 * torch.randn(solid.colors.shape, generator=rng)
    radius, colors = dent.clone().requires_grad_(), wrong.clone().requires_grad_()
    optimiser = torch.optim.Adam([radius, colors], lr=0.01, betas=(0.8, 0.9))
    for _ in range(40):
        optimiser.zero_grad()
        vertices = torch.cat([unit * radius[:, None], solid.vertices[-4:]])
        r = render(vertices, colors, solid.topology, views)
        loss = (r.image - image).square().mean() + (r.coverage - coverage).square().mean()
        (loss + (r.depth - depth).square().mean()).backward()
        optimiser.step()
    seen = unit[:, 2] > 0
    assert (radius - 1)[seen].abs().mean() < 0.3 * (dent - 1)[seen].abs().mean()
    assert (colors - solid.colors)[:-4][seen].norm() < 0.3 * (wrong - solid.colors)[:-4][seen].norm()


def test_a_shifted_camera_finds_back() -> None:
    solid, views = make_solid("box"), make_views(1)
    target = render(solid.vertices, solid.colors, solid.topology, views).image.detach()
    wrong = torch.linalg.inv(torch.tensor(look_at([2.6, 0.8, 3.3], [0.12, 0.03, -0.05])))
    shift = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    first = last = torch.inf
    optimiser = torch.optim.Adam([shift], lr=0.01)
    for step in range(40):
        optimiser.zero_grad()
        pose = torch.cat([torch.cat([wrong[:3, :3], wrong[:3, 3:] + shift[:, None]], 1), wrong[3:]])[None]
        image = render(solid.vertices, solid.colors, solid.topology, views._replace(camera_from_world=pose)).image
        loss = (image - target).square().mean()
        loss.backward()
        optimiser.step()
        first, last = (float(loss.detach()) if step == 0 else first), float(loss.detach())
    assert last < 0.1 * first
