"""The correlation sweep on analytic landscapes, whose heights are known everywhere."""

from __future__ import annotations

import torch

from overfly.networks.correlation import correlation_sweep
from overfly.stages.surfaces import true_heights
from terrain import make_batch


def test_it_finds_the_surface_where_frames_overlap() -> None:
    batch = make_batch(2, width=128, height=64, relief=0.3)
    found = correlation_sweep(batch)
    true, _ = true_heights(batch, 128, 64)
    assert found.height.shape == found.measured.shape == (2, 64, 128)
    assert 0.4 < found.measured.float().mean() < 1
    error = (found.height - true).abs()
    step = 1.6 / 63
    assert error[found.measured].median() < step / 2
    for height, measured in zip(found.height, found.measured, strict=True):
        assert (height[~measured] == height[measured].median()).all()


def test_more_planes_and_the_parabola_make_it_finer() -> None:
    batch = make_batch(1, width=128, height=64, relief=0.3)
    true, _ = true_heights(batch, 128, 64)
    errors = []
    for heights in (9, 33):
        found = correlation_sweep(batch, heights=heights)
        errors.append((found.height - true).abs()[found.measured].median())
    assert errors[1] < 0.7 * errors[0]


def test_brightness_and_contrast_do_not_matter() -> None:
    batch = make_batch(1, width=64, height=32)
    found = correlation_sweep(batch)
    batch["images"] = batch["images"].clone()
    batch["images"][:, 1] = 0.5 * batch["images"][:, 1] + 0.2
    again = correlation_sweep(batch)
    both = found.measured & again.measured
    assert both.sum() > 0.95 * found.measured.sum()
    assert ((found.height - again.height)[both].abs() < 1e-3).float().mean() > 0.98


def test_one_frame_measures_nothing() -> None:
    for batch in (make_batch(1, frames=1), make_batch(1, frames=2)):
        for key in ("images", "intrinsics", "camera_from_window"):
            batch[key] = batch[key][:, [0] * batch[key].shape[1]]
        found = correlation_sweep(batch)
        assert not found.measured.any()
        assert not found.height.any()


def test_a_window_does_not_influence_its_neighbours_in_the_batch() -> None:
    batch = make_batch(2)
    alone = correlation_sweep({key: value[1:] for key, value in batch.items()})
    assert torch.allclose(correlation_sweep(batch).height[1:], alone.height, atol=1e-5)
