"""What the methods say of analytic landscapes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from overfly.errors import InputError
from overfly.evaluation import Baselines, Network
from overfly.evaluation.answers import FLAT, FLOOR, on_grid
from overfly.evaluation.semi_global import semi_global
from overfly.networks.ground import initial_cloud
from overfly.stages.surfaces import true_heights
from terrain import make_batch, make_network, make_sweep_network

WIDTH, HEIGHT = 128, 64


def windows(count: int = 2, **changes: int) -> dict[str, Tensor]:
    batch = make_batch(count, width=WIDTH, height=HEIGHT, points=256, **changes)
    batch["reference_again"] = batch["reference"].flip(1)
    return batch


def test_without_training_windows_their_two_answers_are_left_out() -> None:
    answers = Baselines(None, Network(make_network(size=[WIDTH, HEIGHT]), WIDTH), 256)(windows())
    assert list(answers) == [FLAT, "correlation sweep", "semi-global stereo", FLOOR, "floor: second sample"]


def test_every_baseline_answers_with_a_cloud_and_a_surface() -> None:
    batch = windows()
    answers = Baselines([windows(seed=1), batch], Network(make_network(size=[WIDTH, HEIGHT]), WIDTH), 256)(batch)
    assert list(answers) == [
        FLAT, "mean training cloud", "nearest training window", "correlation sweep", "semi-global stereo", FLOOR,
        "floor: second sample",
    ]  # fmt: skip
    for answer in answers.values():
        assert answer.points.shape == (2, 256, 3)
        assert answer.height.shape == (2, HEIGHT, WIDTH)
        assert torch.isfinite(answer.points).all()
        assert torch.isfinite(answer.height).all()
    assert torch.equal(answers[FLAT].points, initial_cloud(256, batch))
    assert torch.equal(answers["nearest training window"].points, batch["reference"])  # it is one of them
    true, _ = true_heights(batch, WIDTH, HEIGHT)
    assert torch.equal(answers[FLOOR].height, true)
    error = {name: float((answer.height - true).abs().median()) for name, answer in answers.items()}
    assert max(error["correlation sweep"], error["semi-global stereo"]) < 0.2 * error[FLAT]
    assert error["floor: second sample"] < 0.2 * error[FLAT]


def test_points_on_the_grid_lie_on_the_surface() -> None:
    batch = windows(1)
    true, _ = true_heights(batch, WIDTH, HEIGHT)
    points = on_grid(true, batch, 256)[0]
    pose, matrix = batch["camera_from_window"][0, 0], batch["intrinsics"][0, 0]
    at = (points @ pose[:3, :3].T + pose[:3, 3]) @ matrix.T
    pixels = (at[:, :2] / at[:, 2:]).floor().long()
    assert torch.allclose(points[:, 2], true[0, pixels[:, 1], pixels[:, 0]])


@pytest.mark.parametrize("swapped", [False, True])
def test_semi_global_stereo_measures_where_frames_overlap_and_closes_holes(swapped: bool) -> None:
    batch = windows(1, frames=4)
    if swapped:
        for key in ("images", "depth", "intrinsics", "camera_from_window"):
            batch[key] = batch[key][:, [2, 0, 1, 3]]  # others on both sides of the reference
    found = semi_global(batch)
    true, _ = true_heights(batch, WIDTH, HEIGHT)
    error = (found.height - true).abs()
    assert 0.3 < found.measured.float().mean() < 1
    assert error[found.measured].median() < 0.01
    assert torch.isfinite(found.height).all()
    assert error[~found.measured].median() < 0.15


def test_semi_global_stereo_without_a_partner_says_flat_ground() -> None:
    batch = windows(1, frames=2)
    for key in ("images", "intrinsics", "camera_from_window"):
        batch[key] = batch[key][:, [0, 0]]
    found = semi_global(batch)
    assert not found.measured.any()
    assert not found.height.any()


def test_no_method_looks_at_the_truth() -> None:
    batch = windows()
    network = Network(make_sweep_network(), 64)
    baselines = Baselines([windows(seed=1)], network, 256)
    before = {**baselines(batch), "network": network(batch)}
    blind = {**batch, "depth": torch.ones_like(batch["depth"]), "reference": torch.zeros_like(batch["reference"])}
    after = {**baselines(blind), "network": network(blind)}
    for name, answer in before.items():
        if not name.startswith("floor"):
            assert torch.equal(answer.height, after[name].height), name
            assert torch.equal(answer.points, after[name].points), name


def test_a_network_sees_images_of_its_own_size_and_answers_in_the_windows() -> None:
    batch = windows()
    network = Network(make_sweep_network(), 64)
    sized = network.sized(batch)
    assert sized["images"].shape[-2:] == (HEIGHT // 2, 64)
    assert torch.allclose(sized["intrinsics"][0, 0, 0, 0] * 2, batch["intrinsics"][0, 0, 0, 0])
    answer = network(batch)
    assert answer.height.shape == (2, HEIGHT, WIDTH)
    assert answer.right_within == pytest.approx(2 * 2 / 64)
    assert network.describe(batch)["descriptor"].shape == (2, 1, 16)
    with pytest.raises(InputError, match="96 pixels wide cannot take windows 128"):
        Network(make_sweep_network(), 96)(batch)


def test_semi_global_stereo_knows_no_unit() -> None:
    batch = windows(1)
    half = {
        **batch,
        "height_range": batch["height_range"] / 2,
        "camera_from_window": batch["camera_from_window"].clone(),
    }
    half["camera_from_window"][..., :3, 3] /= 2
    a, b = semi_global(batch), semi_global(half)
    both = (a.measured & b.measured).numpy()
    assert both.mean() > 0.3
    assert np.allclose(a.height.numpy()[both], 2 * b.height.numpy()[both], atol=1e-3)
