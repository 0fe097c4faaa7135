"""What one image suggests is moved onto what was measured around it."""

from __future__ import annotations

import numpy as np

from overfly.mapping.anchor import anchored

WIDTH, HEIGHT = 120, 90


def landscape() -> tuple[np.ndarray, np.ndarray]:
    """A slope with houses [h, w], and the houses alone, as an image without parallax would suggest them."""
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    houses = 6.0 * ((u % 30 < 12) & (v % 30 < 10))
    return (0.08 * u - 0.05 * v + houses).astype(np.float32), houses.astype(np.float32)


def test_a_slope_measured_around_a_gap_is_carried_into_it() -> None:
    true, houses = landscape()
    measured = true.copy()
    measured[30:60, 40:80] = np.nan
    found = anchored(houses, measured)
    gap = np.isnan(measured)
    assert np.abs(houses - true)[gap].mean() > 2.0
    assert np.abs(found - true)[gap].mean() < 0.6
    assert np.ptp((found - houses)[gap]) < 6.0  # houses stay as high as suggested


def test_outliers_do_not_pull() -> None:
    true, houses = landscape()
    measured = true.copy()
    measured[:, ::3] += 40.0  # a third of the matches are wrong
    assert np.abs(anchored(houses, measured) - true).mean() < 0.6


def test_without_measurements_the_suggestion_stands() -> None:
    _, houses = landscape()
    np.testing.assert_array_equal(anchored(houses, np.full_like(houses, np.nan)), houses)
