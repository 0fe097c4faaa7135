"""Views from above, and the agreement of images on a shift of the ground."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from overfly.networks.encoder import Encoder
from overfly.networks.verification import KEYPOINTS, GroundViews, agreement, ground_views

WIDTH, HEIGHT, FOCAL = 128, 96, 110.0


@pytest.fixture(scope="module")
def encoder() -> Encoder:
    torch.manual_seed(0)
    sizes = {"features": 16, "descriptor": 8, "match_channels": 16, "correction_width": 8, "widths": (8, 8, 8, 8)}
    return Encoder(size=(WIDTH, HEIGHT), own_heads=True, **sizes).eval()  # type: ignore[arg-type]


def intrinsics() -> Tensor:
    return torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])


def pose(east: float, north: float, *, height: float = 1.5, yaw: float = 0.0, tilt: float = 0.0) -> Tensor:
    """Camera from world: looking down, its right to the east, turned by ``yaw``, looking ahead by ``tilt``."""
    c, s = math.cos(yaw), math.sin(yaw)
    down = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    turn = torch.tensor([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    a, b = math.cos(tilt), math.sin(tilt)
    ahead = torch.tensor([[1.0, 0, 0], [0, a, b], [0, -b, a]])
    matrix = torch.eye(4)
    matrix[:3, :3] = ahead @ down @ turn
    matrix[:3, 3] = -matrix[:3, :3] @ torch.tensor([east, north, height])
    return matrix


def photograph(texture: Tensor, camera_from_world: Tensor) -> Tensor:
    """The plane z = 0, whose texture [3, S, S] spans -4 to 4, as a camera sees it [3, H, W]."""
    v, u = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    rays = torch.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, torch.ones_like(u)], -1)
    rotation, centre = camera_from_world[:3, :3], -camera_from_world[:3, :3].T @ camera_from_world[:3, 3]
    world = rays @ rotation
    places = centre[:2] - world[..., :2] * (centre[2] / world[..., 2:])
    return F.grid_sample(texture[None], places[None] / 4, align_corners=False)[0]


def texture(seed: int) -> Tensor:
    random = torch.Generator().manual_seed(seed)
    return F.interpolate(torch.rand(1, 3, 160, 160, generator=random), size=640, mode="bilinear")[0]


def views(encoder: Encoder, ground: Tensor, poses: list[Tensor]) -> GroundViews:
    images = torch.stack([photograph(ground, one) for one in poses])
    return ground_views(encoder, images, intrinsics().expand(len(poses), 3, 3), torch.stack(poses))


def test_a_turned_or_tilted_camera_gives_the_same_view(encoder: Encoder) -> None:
    north, turned, ahead = (pose(0, 0), pose(0, 0, yaw=2.0), pose(0, -1.5 * math.tan(0.3), tilt=0.3))
    found = views(encoder, texture(0), [north, turned, ahead])
    for other in (1, 2):
        both = found.inside[0] & found.inside[other]
        assert both.float().mean() > 0.2
        likeness = (found.maps[0] * found.maps[other]).sum(0)[both]
        across = (found.maps[0].roll(9, 1) * found.maps[other]).sum(0)[both]
        assert likeness.median() > 0.97
        assert likeness.median() - across.median() > 0.05


def test_what_lies_outside_the_image_is_told(encoder: Encoder) -> None:
    inside = views(encoder, texture(0), [pose(0, 0)]).inside[0]
    # 128 of 200 ground pixels across, 96 down, and a rim of two cells.
    assert inside.any(0).sum().item() == pytest.approx(WIDTH / 1.25 * 160 / WIDTH / 2 - 4, abs=3)
    assert inside.any(1).sum().item() == pytest.approx(HEIGHT / 1.25 * 160 / WIDTH / 2 - 4, abs=3)


def test_the_same_ground_agrees_and_other_ground_does_not(encoder: Encoder) -> None:
    query = views(encoder, texture(0), [pose(0, 0)])
    same = views(encoder, texture(0), [pose(0.5, 0.2, yaw=1.0), pose(0.9, -0.1, yaw=3.0)])
    other = views(encoder, texture(1), [pose(0.5, 0.2, yaw=1.0), pose(0, 0)])
    near, far = agreement(query, same), agreement(query, other)
    assert near.min() > 2 * far.max()
    assert near.max() <= KEYPOINTS
    most, less = agreement(query, views(encoder, texture(0), [pose(0.1, 0), pose(1.1, 0)]))
    assert most > less > far.max()  # more common ground, more agreement


def test_an_image_without_ground_agrees_with_nothing(encoder: Encoder) -> None:
    query = views(encoder, texture(0), [pose(0, 0)])
    nothing = GroundViews(query.maps, torch.zeros_like(query.inside))
    assert agreement(nothing, query).tolist() == [0]
    assert agreement(query, nothing).item() == pytest.approx(0, abs=1e-5)
