"""The ground-plane sweep on analytic landscapes, whose heights are known everywhere."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from overfly import losses
from overfly.networks.ground import align, align_depth, pixel_centres, rays
from overfly.networks.sweep import agreement, canvas_to_reference, lines, pixels_per_height, seen
from overfly.stages.surfaces import TERMS, surface_metrics, surface_terms, true_heights
from terrain import make_batch, make_sweep_network

WIDTH, HEIGHT = 64, 32


def over_all_pixels(batch: dict[str, Tensor]):
    cells = pixel_centres(WIDTH, HEIGHT, WIDTH, HEIGHT, torch.device("cpu"))
    return rays(cells, batch["intrinsics"][:, 0], batch["camera_from_window"][:, 0])


def test_rays_pass_through_the_surface_that_depth_shows() -> None:
    batch = make_batch(2)
    heights, known = true_heights(batch, WIDTH, HEIGHT)
    assert known.all()
    points = over_all_pixels(batch).at(heights.flatten(1))
    pose = batch["camera_from_window"][:, 0]
    local = points @ pose[:, :3, :3].transpose(1, 2) + pose[:, None, :3, 3]
    assert torch.allclose(local[..., 2], batch["depth"][:, 0].flatten(1), atol=1e-4)
    pixels = (local @ batch["intrinsics"][:, 0].transpose(1, 2))[..., :2] / local[..., 2:]
    cells = pixel_centres(WIDTH, HEIGHT, WIDTH, HEIGHT, torch.device("cpu"))
    assert torch.allclose(pixels, cells.expand_as(pixels), atol=1e-3)


def test_rays_to_the_horizon_end_at_the_reach() -> None:
    batch = make_batch(1)
    level = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, 2], [0, 1, 0, 0], [0, 0, 0, 1]])[None]  # looks north from z = 2
    cast = rays(torch.tensor([[32.0, 1.0]]), batch["intrinsics"][:, 0], level)
    assert float(cast.foot[0, 0, :2].norm()) == pytest.approx(8.0, rel=1e-4)  # 4 heights


def test_flat_ground_looks_alike_in_all_aligned_frames() -> None:
    batch = make_batch(2, relief=0.0)
    heights, _ = true_heights(batch, WIDTH, HEIGHT)
    batch["camera_from_window"] = batch["camera_from_window"].clone()
    aligned = align(batch["images"], batch["intrinsics"], batch["camera_from_window"])
    assert aligned.images.shape == (2, 3, 3, HEIGHT + 8, WIDTH + 16)
    inner = canvas_to_reference(aligned.images, 1, aligned.size)
    assert torch.allclose(inner[:, 0], batch["images"][:, 0], atol=1e-4)  # the reference stays as it is
    assert heights.abs().max() < 0.3


def test_lines_are_the_projections_of_points_and_colours_agree_on_the_surface() -> None:
    batch = make_batch(2)
    heights, _ = true_heights(batch, WIDTH, HEIGHT)
    aligned = align(batch["images"], batch["intrinsics"], batch["camera_from_window"])
    cast = over_all_pixels(batch)
    found = lines(cast, aligned.intrinsics, batch["intrinsics"], batch["camera_from_window"], aligned.size)
    at = found.own_q + heights.flatten(1)[:, None, :, None] * found.own_r
    points = cast.at(heights.flatten(1))
    for k in (1, 2):
        pose = batch["camera_from_window"][:, k]
        local = points @ pose[:, :3, :3].transpose(1, 2) + pose[:, None, :3, 3]
        pixels = local @ batch["intrinsics"][:, k].transpose(1, 2)
        assert torch.allclose(at[:, k - 1], pixels, atol=1e-3)

    def colour_error(z: Tensor) -> float:
        where = found.q + z[:, None, :, None] * found.r
        size = torch.tensor([aligned.images.shape[-1], aligned.images.shape[-2]])
        grid = where[..., :2] / where[..., 2:] / size * 2 - 1
        shown = F.grid_sample(aligned.images[:, 1:].flatten(0, 1), grid.flatten(0, 1)[:, None], align_corners=False)
        shown = shown[:, :, 0].unflatten(0, (2, 2))
        error = (shown - batch["images"][:, :1].flatten(3)).abs().mean(2)
        return float(error[seen(found, z[:, None])[:, :, 0]].mean())

    true = heights.flatten(1)
    assert colour_error(true) < 0.5 * colour_error(true + 0.15)
    assert colour_error(true) < 0.5 * colour_error(true - 0.15)


def test_agreement_is_highest_at_the_true_height() -> None:
    batch = make_batch(2)
    heights, _ = true_heights(batch, WIDTH, HEIGHT)
    aligned = align(batch["images"], batch["intrinsics"], batch["camera_from_window"])
    cast = lines(
        over_all_pixels(batch), aligned.intrinsics, batch["intrinsics"], batch["camera_from_window"], aligned.size
    )
    colours = aligned.images - aligned.images.mean((3, 4), keepdim=True)
    features = F.normalize(torch.cat([colours, torch.ones_like(colours[:, :, :1])], 2), dim=2)
    own = canvas_to_reference(features[:, 0], 1, aligned.size).flatten(2)
    offsets = torch.tensor([-0.3, -0.15, 0.0, 0.15, 0.3])
    tried = heights.flatten(1)[:, None] + offsets[:, None]
    volume, visible = agreement(own, features[:, 1:], cast, tried, stride=1, groups=1)
    assert volume.shape == (2, 3, 5, WIDTH * HEIGHT)
    assert visible.shape == (2, 2, 5, WIDTH * HEIGHT)
    both = visible.all(1).all(1)
    assert both.float().mean() > 0.2
    mean = volume[:, 0].transpose(1, 2)[both].mean(0)
    assert int(mean.argmax()) == 2
    assert torch.allclose(volume[:, 2], visible.float().mean(1))  # the share of frames that see the point


def test_a_frame_that_is_the_reference_again_sees_nothing() -> None:
    batch = make_batch(1)
    for key in ("images", "intrinsics", "camera_from_window"):
        batch[key] = batch[key][:, [0, 0, 0]]
    aligned = align(batch["images"], batch["intrinsics"], batch["camera_from_window"])
    cast = lines(
        over_all_pixels(batch), aligned.intrinsics, batch["intrinsics"], batch["camera_from_window"], aligned.size
    )
    zeros = torch.zeros(1, WIDTH * HEIGHT)
    assert not seen(cast, zeros[:, None]).any()
    assert pixels_per_height(cast, zeros) == pytest.approx(0.4 * WIDTH / 2)


def test_parallax_per_height_is_focal_times_base_over_height_squared() -> None:
    batch = make_batch(1, frames=2)
    aligned = align(batch["images"], batch["intrinsics"], batch["camera_from_window"])
    cast = lines(
        over_all_pixels(batch), aligned.intrinsics, batch["intrinsics"], batch["camera_from_window"], aligned.size
    )
    rate = pixels_per_height(cast, torch.zeros(1, WIDTH * HEIGHT))
    # altitude 2, base 0.3, focal 64 px; the aligned frame has the reference's scale
    assert float(rate) == pytest.approx(64 * 0.3 / 2**2, rel=0.02)


def test_aligned_depth_is_that_of_the_frame() -> None:
    batch = make_batch(1, relief=0.0)
    aligned = align(batch["images"], batch["intrinsics"], batch["camera_from_window"])
    depth = align_depth(batch["depth"], aligned.pixels)
    inner = canvas_to_reference(depth, 1, aligned.size)
    assert torch.equal(inner[:, 0], batch["depth"][:, 0])
    assert (depth[:, 1] == 0).any()
    assert (depth[:, 1] > 0).any()


@pytest.mark.parametrize("frames", [1, 2, 5])
def test_any_number_of_frames_gives_a_surface(frames: int) -> None:
    network = make_sweep_network().eval()
    output = network(make_batch(2, frames=frames))
    assert output["points"].shape == (2, 256, 3)
    assert output["height"].shape == output["sigma"].shape == output["views"].shape == (2, HEIGHT, WIDTH)
    assert int(output["views"].max()) <= frames
    assert int(output["views"].min()) >= 1
    assert (output["sigma"] > 0).all()
    assert ((output["confidence"] > 0) & (output["confidence"] < 1)).all()


def test_larger_images_take_one_more_fine_sweep_with_the_same_weights() -> None:
    network = make_sweep_network().eval()
    small, large = (network(make_batch(1, width=w, height=w // 2)) for w in (64, 128))
    assert len(small["surfaces"]) == 2
    assert len(large["surfaces"]) == 3
    assert large["height"].shape == (1, 64, 128)


def test_one_batch_is_learnt() -> None:
    network, batch = make_sweep_network().train(), make_batch(2)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-2)
    values = []
    for _ in range(60):
        output = network(batch)
        terms = surface_terms(output["surfaces"], batch, TERMS)
        loss = 5 * terms["height"] + 0.2 * terms["hypotheses"]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        values.append(loss.item())
    assert min(values[-5:]) < 0.5 * values[0]
    found, count = surface_metrics(output, batch)
    assert count == 2
    assert set(found) >= {"height_mean_m", "within_sigma", "within_2sigma"}


def test_the_two_hypotheses_around_the_truth_share_the_right_answer() -> None:
    heights = torch.tensor([0.0, 1.0, 2.0, 3.0])[None, :, None]
    logits = torch.tensor([0.0, 3.0, 1.0, 0.0])[None, :, None]
    logs = logits.log_softmax(1)[0, :, 0]
    value = losses.hypotheses(logits, heights, torch.tensor([[1.25]]))
    assert float(value) == pytest.approx(float(-(0.75 * logs[1] + 0.25 * logs[2])))
    beyond = losses.hypotheses(logits, heights, torch.tensor([[9.0]]))
    assert float(beyond) == pytest.approx(float(-logs[3]))


def test_sigma_is_best_at_the_mean_error() -> None:
    errors = torch.tensor([0.1, -0.2, 0.3, 0.6])
    tried = torch.linspace(0.05, 1, 96)
    likelihood = torch.stack([losses.sigma(s.log(), errors).mean() for s in tried])
    assert float(tried[likelihood.argmin()]) == pytest.approx(0.3, abs=0.02)
