"""Correspondences: the true ones are exact on analytic scenes, the found ones hit planted places."""

from __future__ import annotations

import pytest
import torch
from torch.nn import functional as F

from overfly.networks.matching import (
    cell_pixels,
    keypoints,
    match,
    nearest,
    nearest_around,
    sample_depth,
    true_correspondences,
)
from terrain import make_batch


def views(batch: dict[str, torch.Tensor], frame: int) -> tuple[torch.Tensor, ...]:
    return batch["depth"][:, frame], batch["intrinsics"][:, frame], batch["camera_from_window"][:, frame]


def test_true_correspondences_on_a_plane_follow_its_homography() -> None:
    batch = {key: value.double() for key, value in make_batch(2, relief=0.0).items()}
    pixels = torch.rand(2, 200, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    pixels = pixels * torch.tensor([62.0, 30.0], dtype=torch.float64) + 1
    found, visible = true_correspondences(pixels, *views(batch, 0), *views(batch, 2))
    # Independently: a homography fitted to the plane through three unprojected pixels.
    for b in range(2):
        k, a, c = (batch[key][b] for key in ("intrinsics", "camera_from_window", "camera_from_window"))
        corners = torch.tensor([[4, 4], [60, 6], [30, 28]])
        rays = torch.cat([corners + 0.5, torch.ones(3, 1)], 1).double() @ torch.linalg.inv(k[0]).T
        three = rays * batch["depth"][b, 0, corners[:, 1], corners[:, 0]][:, None]
        normal = torch.linalg.solve(three, torch.ones(3, dtype=torch.float64))  # n . x = 1 on the plane
        motion = c[2] @ torch.linalg.inv(a[0])
        homography = k[2] @ (motion[:3, :3] + motion[:3, 3:] @ normal[None]) @ torch.linalg.inv(k[0])
        moved = torch.cat([pixels[b], torch.ones(200, 1, dtype=torch.float64)], 1) @ homography.T
        expected = moved[:, :2] / moved[:, 2:]
        inside = ((expected > 1) & (expected < torch.tensor([63.0, 31.0]))).all(1)
        assert visible[b][inside].all()
        assert visible[b].any()
        assert not visible[b].all()  # some leave the image
        assert torch.allclose(found[b][visible[b]], expected[visible[b]], atol=1e-4)


def test_hidden_points_are_not_visible() -> None:
    batch = make_batch(1, relief=0.0)
    pixels = torch.tensor([[[32.5, 8.5], [20.5, 9.5]]])
    there, visible = true_correspondences(pixels, *views(batch, 0), *views(batch, 1))
    assert visible.all()
    u, v = there[0, 0].long().tolist()
    batch["depth"][0, 1, v - 2 : v + 3, u - 2 : u + 3] *= 0.9  # something stands in front of the first
    assert true_correspondences(pixels, *views(batch, 0), *views(batch, 1))[1].tolist() == [[False, True]]
    batch["depth"][0, 0] = 0  # nothing is known
    assert not true_correspondences(pixels, *views(batch, 0), *views(batch, 1))[1].any()


def test_sampled_depth_refuses_edges_and_the_outside() -> None:
    depth = torch.full((1, 4, 6), 10.0)
    depth[:, :, 3:] = 8.0
    pixels = torch.tensor([[[1.2, 1.7], [3.0, 2.0], [0.2, 1.0], [4.5, 3.5], [5.7, 1.0]]])
    values, valid = sample_depth(depth, pixels)
    assert valid.tolist() == [[True, False, False, True, False]]
    assert values[0, 0] == pytest.approx(10.0)
    assert values[0, 3] == pytest.approx(8.0)


def test_nearest_finds_a_planted_place_below_the_cell() -> None:
    h, w, at = 12, 16, torch.tensor([7.3, 4.8])  # cells, centres at + 0.5
    cells = cell_pixels(h, w, 1)
    bump = torch.exp(-((cells - at) ** 2).sum(1) / 8).reshape(1, h, w)
    angle = bump * 1.2  # the nearer to the place, the nearer to the query's direction
    found, score = nearest(torch.tensor([[[0.0, 1.0]]]), torch.stack([angle.cos(), angle.sin()], 1))
    assert torch.allclose(found[0, 0], at * 2, atol=0.3)
    assert score[0, 0] > 0.9


def test_a_search_around_a_place_finds_what_the_whole_search_finds_there_and_nothing_farther() -> None:
    generator = torch.Generator().manual_seed(0)
    whole = F.normalize(torch.randn(16, 70, 90, generator=generator), dim=0)
    cells = torch.tensor([3, 95, 2040, 3100, 6299])
    queries, truth = whole.flatten(1).T[cells], cell_pixels(70, 90)[cells]
    everywhere = nearest(queries[None], whole[None])[0][0]
    near, score = nearest_around(queries, whole, truth + torch.tensor([7.0, -5.0]), reach=12)
    assert torch.allclose(near, everywhere, atol=0.6)  # parabolas may end at a window's border
    assert torch.allclose(score, torch.ones(5), atol=1e-5)
    far, score = nearest_around(queries[2:3], whole, truth[2:3] + torch.tensor([[-80.0, 40.0]]), reach=4)
    assert (far - truth[2]).abs().max() > 20
    assert score[0] < 0.99


def test_match_recovers_a_shift() -> None:
    generator = torch.Generator().manual_seed(0)
    whole = F.normalize(torch.randn(16, 20, 40, generator=generator), dim=0)
    a, b = whole[:, :, 2:34], whole[:, :, 5:37]  # b starts three cells further right
    matches = match(a, b, count=100)
    moved = matches.pixels_a - matches.pixels_b
    assert len(moved) > 40
    assert (moved - torch.tensor([6.0, 0.0])).abs().max() < 1.1
    assert (matches.score.diff() <= 0).all()
    assert len(match(a, b, count=100, mutual=False).score) >= len(matches.score)


def test_keypoints_keep_away_from_what_cannot_be_located() -> None:
    field = F.normalize(torch.ones(1, 4, 24, 24), dim=1)  # featureless
    field[0, :, 6, 15] = torch.tensor([1.0, 0, 0, 0])
    field[0, :, 17, 8] = torch.tensor([0, 0, 1.0, 0])
    cells, score = keypoints(field, 2)
    assert sorted(cells[0].tolist()) == [6 * 24 + 15, 17 * 24 + 8]
    assert (score > 0.1).all()
