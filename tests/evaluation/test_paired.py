"""A network's surface, after pairs and correlation have had their say."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from overfly.evaluation.answers import Answer, on_grid
from overfly.evaluation.paired import paired
from overfly.evaluation.semi_global import semi_global
from overfly.stages.surfaces import true_heights
from terrain import make_batch

WIDTH, HEIGHT = 128, 64


def windows() -> tuple[dict[str, Tensor], Tensor]:
    batch = make_batch(1, width=WIDTH, height=HEIGHT, points=256, frames=4)
    true, _ = true_heights(batch, WIDTH, HEIGHT)
    return batch, true


def said(batch: dict[str, Tensor], height: Tensor, sigma: float) -> Answer:
    return Answer(on_grid(height, batch, 256), height, torch.full_like(height, sigma), torch.full_like(height, 0.5))


def test_a_surface_that_is_half_a_pixel_off_comes_nearer() -> None:
    batch, true = windows()
    off = said(batch, true + 0.01, sigma=0.02)
    better = paired(off, batch)
    before, after = ((answer.height - true).abs() for answer in (off, better))
    moved = better.height != off.height  # the others are seen once
    assert 0.3 < moved.float().mean() < 0.9
    assert after[moved].median() < 0.5 * before[moved].median()
    assert after.mean() < before.mean()
    assert torch.equal(better.points, on_grid(better.height, batch, 256))
    assert better.confidence is not None
    assert off.confidence is not None
    assert torch.equal(better.confidence, off.confidence)


def test_what_the_reference_alone_sees_is_laid_on_what_is_measured_around_it() -> None:
    batch, true = windows()
    once = torch.zeros(1, HEIGHT, WIDTH, dtype=torch.bool)
    once[..., :24] = True
    lifted = true + torch.where(once, 0.3, 0.002)  # the network knows what stands there, not how high the ground is
    views = torch.where(once, 1.0, 3.0)
    answer = replace(said(batch, lifted, sigma=0.02), views=views, alone=lifted)
    better = paired(answer, batch)
    assert (better.height - true).abs()[once].median() < 0.3 * (lifted - true).abs()[once].median()
    assert torch.equal(better.height[~once], paired(replace(answer, alone=None), batch).height[~once])
    assert better.sigma is not None
    assert answer.sigma is not None
    assert (better.sigma != answer.sigma)[once].all()
    assert torch.equal(better.sigma[~once], answer.sigma[~once])


def test_pairs_are_not_believed_far_from_what_the_network_is_sure_of() -> None:
    """One alone sooner than two that agree."""
    batch, true = windows()
    wrong = true + 0.5
    matched = semi_global(batch).measured
    right = [
        ((paired(said(batch, wrong, sigma), batch).height - true).abs() < 0.02)[matched].float().mean()
        for sigma in (0.01, 0.11, 10.0)  # at half confidence one pair stands within 3.6 sigmas, two within 5.4
    ]
    assert right[0] == 0
    assert 0.2 < right[1] < right[2] - 0.1
    assert right[2] > 0.8


def test_nothing_but_images_and_cameras_is_looked_at() -> None:
    batch, true = windows()
    blind = {**batch, "depth": torch.ones_like(batch["depth"]), "reference": torch.zeros_like(batch["reference"])}
    answer = said(batch, true + 0.02, 0.1)
    assert torch.equal(paired(answer, batch).height, paired(answer, blind).height)


def test_a_frame_that_a_short_window_repeats_counts_once() -> None:
    batch, true = windows()
    frames = ("images", "depth", "intrinsics", "camera_from_window")
    short = {name: value[:, :2] if name in frames else value for name, value in batch.items()}
    padded = {name: value[:, [0, 1, 0, 1]] if name in frames else value for name, value in batch.items()}
    answers = [paired(said(batch, true + 0.01, 0.02), window).height for window in (short, padded)]
    assert torch.equal(*answers)
    assert not torch.equal(answers[0], true + 0.01)
