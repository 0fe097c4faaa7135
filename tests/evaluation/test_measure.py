"""The numbers of a window by hand values."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from overfly.evaluation.answers import Answer, on_grid
from overfly.evaluation.measure import BINS, cloud_values, count_views, surface_values, truths
from overfly.networks.ground import pixel_centres, rays
from overfly.stages.surfaces import true_heights
from terrain import make_batch

WIDTH, HEIGHT = 64, 32


def exact(batch: dict[str, torch.Tensor], offset: float = 0.0, **more: object) -> Answer:
    true, _ = true_heights(batch, WIDTH, HEIGHT)
    return Answer(on_grid(true + offset, batch, 1024), true + offset, **more)  # type: ignore[arg-type]


def test_exact_heights_have_no_error() -> None:
    batch = make_batch(1)
    values, calibration = surface_values(exact(batch), 0, truths(batch)[0])
    assert calibration is None
    for name, (value, _) in values.items():
        if name.startswith("height"):
            assert value == 0, name
        if name.startswith("fscore"):
            assert value == 1, name
    assert sum(values[f"area_{name}"][0] for name in ("1_view", "2_views", "3_views")) == pytest.approx(1)


def test_a_surface_that_is_too_high_everywhere() -> None:
    batch = make_batch(1)  # 50 m per unit, 100 / 64 m per pixel, from 100 m
    values, _ = surface_values(exact(batch, 0.05), 0, truths(batch)[0])
    assert values["height_mean_m"][0] == pytest.approx(2.5, rel=1e-4)
    assert values["height_mean_percent"][0] == pytest.approx(2.5, rel=1e-4)
    assert values["height_median_m"][0] == pytest.approx(2.5, rel=1e-4)
    assert values["height_median_gsd"][0] == pytest.approx(2.5 / (100 / 64), rel=1e-4)
    assert values["height_mean_m_2_views"][0] == pytest.approx(2.5, rel=1e-4)
    assert values["fscore_dense_2pct"][0] < 0.5


def test_what_one_frame_sees_alone_is_judged_by_itself_and_against_its_neighbours() -> None:
    batch = make_batch(1, relief=0.0)
    truth = truths(batch)[0]
    once = torch.from_numpy(truth.views == 1).reshape(1, HEIGHT, WIDTH)
    assert 100 < once.sum() < once.numel() - 100
    true, _ = true_heights(batch, WIDTH, HEIGHT)
    wrong = torch.where(once, true + 1, true)
    values, _ = surface_values(Answer(on_grid(wrong, batch, 1024), wrong, measured=~once), 0, truth)
    assert values["height_median_m"][0] == 0
    assert values["height_mean_m_1_view"][0] == pytest.approx(50, rel=1e-4)
    assert values["height_mean_m_1_view"][1] == once.sum()
    assert values["fscore_once_2pct"][0] < 0.05
    assert values["fscore_once_interpolated_2pct"][0] > 0.8  # the ground is a plane
    assert values["measured"][0] == pytest.approx(float((~once).float().mean()))


def test_frames_count_once_and_only_where_they_see() -> None:
    batch = make_batch(1, frames=3, relief=0.0)
    cells = pixel_centres(WIDTH, HEIGHT, WIDTH, HEIGHT, torch.device("cpu"))
    heights, _ = true_heights(batch, WIDTH, HEIGHT)
    points = rays(cells, batch["intrinsics"][:, 0], batch["camera_from_window"][:, 0]).at(heights.flatten(1))
    count = count_views(batch, points)
    assert set(count.unique().tolist()) <= {1, 2, 3}
    for key in ("images", "depth", "intrinsics", "camera_from_window"):
        batch[key] = torch.cat([batch[key], batch[key][:, [0, 1]]], 1)  # again: nothing new
    assert torch.equal(count_views(batch, points), count)
    assert (count_views(batch, points - torch.tensor([0, 0, 0.2])) == 1).all()  # under the ground: hidden
    alone = {key: value[:, :1] if value.ndim > 2 and key != "reference" else value for key, value in batch.items()}
    assert (count_views(alone, points) == 1).all()


def test_sigma_and_confidence_are_held_against_the_errors() -> None:
    batch = make_batch(1)
    ones = torch.ones(1, HEIGHT, WIDTH)
    half = torch.arange(HEIGHT)[:, None] < HEIGHT // 2
    true, _ = true_heights(batch, WIDTH, HEIGHT)
    height = torch.where(half, true, true + 0.15)
    answer = Answer(on_grid(height, batch, 1024), height, sigma=0.1 * ones, confidence=0.75 * ones, right_within=0.1)
    values, calibration = surface_values(answer, 0, truths(batch)[0])
    assert values["within_sigma"][0] == pytest.approx(0.5)
    assert values["within_2sigma"][0] == pytest.approx(1)
    assert calibration is not None
    sums = np.array(calibration)
    assert sums.shape == (BINS, 3)
    assert sums[7].tolist() == pytest.approx([WIDTH * HEIGHT, 0.75 * WIDTH * HEIGHT, WIDTH * HEIGHT / 2])
    assert not np.delete(sums, 7, 0).any()


def test_clouds_are_measured_as_everywhere_and_the_emd_where_it_is_asked_for() -> None:
    batch = make_batch(1, points=256)
    answer = Answer(batch["reference"] + torch.tensor([0, 0, 0.01]), torch.zeros(1, HEIGHT, WIDTH))
    values = cloud_values(answer, 0, truths(batch)[0], emd=True)
    assert values["emd_sum_1024"][0] == pytest.approx(10.24, rel=1e-3)
    assert values["fscore_2pct"] == (1.0, 1.0)
    assert "emd_sum_1024" not in cloud_values(answer, 0, truths(batch)[0], emd=False)
