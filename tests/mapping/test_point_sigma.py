"""What points promise of themselves: roughness of the surface around them, and the standard deviation it leads to."""

from __future__ import annotations

import numpy as np
import pytest

from overfly.mapping.point_sigma import ROUGHEST, point_sigmas, roughness

FOCAL = 800.0


def test_a_plane_is_smooth_however_it_slants_and_noise_is_what_it_is() -> None:
    rows, columns = np.mgrid[:80, :120].astype(np.float32)
    plane = 100 + 0.2 * columns - 0.3 * rows
    inner = np.s_[3:-3, 3:-3]
    assert roughness(plane, FOCAL)[inner].max() < 1e-3
    noise = np.random.default_rng(0).normal(0, 0.05, plane.shape)
    rough = roughness((plane + noise).astype(np.float32), FOCAL) / FOCAL * plane
    # A plane through 25 pixels takes three degrees of freedom.
    assert np.sqrt(np.mean(rough[inner] ** 2)) == pytest.approx(0.05 * np.sqrt(22 / 25), rel=0.02)


def test_holes_and_borders_are_no_roughness_and_steps_are() -> None:
    rng = np.random.default_rng(1)
    rows, columns = np.mgrid[:60, :80].astype(np.float32)
    depth = 50 + 0.3 * columns + 0.1 * rows
    depth[rng.random(depth.shape) < 0.4] = np.nan
    known = np.isfinite(depth)
    rough = roughness(depth, FOCAL)
    assert np.quantile(rough[known], 0.95) < 1e-2, "a slope with holes is as smooth as one without"
    noisy = depth + rng.normal(0, 0.2, depth.shape).astype(np.float32)
    found = (roughness(noisy, FOCAL) / FOCAL * depth)[3:-3, 3:-3]
    assert np.sqrt(np.nanmean(found[known[3:-3, 3:-3]] ** 2)) == pytest.approx(0.2 * np.sqrt(12 / 15), rel=0.05)
    depth = np.full((40, 40), 50, np.float32)
    depth[:, 20:] = 40
    rough = roughness(depth, FOCAL)
    assert rough[30, 19] > 10
    assert rough[30, 10] < 1e-3


def test_where_hardly_anything_is_known_nothing_is_smooth() -> None:
    lone = np.full((20, 20), np.nan, np.float32)
    assert (roughness(lone, FOCAL) == ROUGHEST).all()
    lone[10, 10] = 50
    assert roughness(lone, FOCAL)[10, 10] == ROUGHEST


def sigma(rough: float, *, agree: int = 1, score: float = 0.9, confidence: float = 0.8, **flags: bool) -> float:
    one = np.ones(1)
    masks = {name: np.array([flags.get(name, False)]) for name in ("second", "alone", "once")}
    return float(
        point_sigmas(
            rough * one, agree * one, score * one, confidence * one, 2 * one, 100 * one, FOCAL, **masks
        )[0]
    )  # fmt: skip


def test_sigma_follows_what_is_known_of_a_point() -> None:
    gsd = 100 / FOCAL
    assert 0.05 * gsd < sigma(0.0) < 0.3 * gsd, "smooth ground is known to a fraction of a pixel"
    assert sigma(0.0) < sigma(0.5) < sigma(2.0)
    assert sigma(3.0) == sigma(99.0), "at a wall's edge it does not grow without end"
    assert sigma(0.5, agree=0) > sigma(0.5) > sigma(0.5, score=1.0)
    moved = {"second": True}
    assert sigma(0.5, **moved) > sigma(0.5)
    assert sigma(0.5, confidence=0.6, **moved) > sigma(0.5, confidence=0.9, **moved)
    word = {"second": True, "alone": True}
    assert sigma(0.5, **word) == pytest.approx(2), "the network's own"
    carried_on = {**word, "once": True}
    assert 1.5 > sigma(0.5, confidence=0.33, **carried_on) > sigma(0.5, confidence=0.8, **carried_on) > 0.02
