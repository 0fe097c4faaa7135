"""What one image suggests is laid on the surface that was measured around it."""

from __future__ import annotations

import numpy as np
import pytest

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
    found = anchored(houses - 100, measured - 100)[0] + 100
    gap = np.isnan(measured)
    assert np.abs(houses - true)[gap].mean() > 2.0
    assert np.abs(found - true)[gap].mean() < 0.6
    rises = (found - (true - houses))[gap]
    assert rises[houses[gap] > 0].min() > 3.0  # houses still stand there
    assert np.abs(rises[houses[gap] == 0]).max() < 1.5


@pytest.mark.parametrize("seeming", [2.5, 6.0, 14.0])
def test_what_stands_in_a_gap_is_as_high_as_what_looks_like_it_where_it_is_measured(seeming: float) -> None:
    """However the network mistakes the height of houses, it mistakes them alike."""
    true, houses = landscape()
    measured = true - 100
    measured[30:60, 40:80] = np.nan
    gap = np.isnan(measured)
    found, sure = anchored(houses * seeming / 6 - 100, measured)
    roofs = found[gap & (houses > 0)] - (true - 100)[gap & (houses > 0)]
    assert np.median(np.abs(roofs)) < 1.0
    rough = measured + 5 * np.random.default_rng(0).standard_normal(houses.shape).astype(np.float32) * (houses > 0)
    unsure = anchored(houses * seeming / 6 - 100, rough)[1]
    assert (unsure < sure)[gap & (houses > 0)].mean() > 0.95


def test_one_small_object_does_not_tell_how_tall_all_others_are() -> None:
    flat = np.full((180, 240), -100, np.float32)  # cells of 8 x 8
    measured = flat.copy()
    measured[:, 120:] = np.nan
    suggested = np.zeros_like(flat)
    suggested[40:56, 8:16] = 8  # it seems 8 m tall, and is a flat one
    suggested[80:100, 140:160] = 8
    found = anchored(suggested, measured)[0]
    assert found[90, 150] > -96
    suggested[40:56, 8:48] = 8
    assert anchored(suggested, measured)[0][90, 150] < -99


def test_heights_of_which_an_oblique_image_measures_little_tell_nothing() -> None:
    flat = np.full((180, 240), -100, np.float32)
    measured, asked = flat.copy(), np.zeros(flat.shape, bool)
    asked[:, :120] = True
    measured[~asked] = np.nan
    suggested = np.zeros_like(flat)
    suggested[40:56, 8:48] = suggested[80:100, 140:160] = 8  # seem 8 m tall; the first is measured, and flat
    told = anchored(suggested, measured)[0]
    assert told[90, 150] < -99
    np.testing.assert_array_equal(told, anchored(suggested, measured, asked)[0])
    measured[40:50, 8:48] = np.nan  # most of it is not
    assert anchored(suggested, measured)[0][90, 150] < -99
    assert anchored(suggested, measured, asked)[0][90, 150] > -96


def test_the_height_of_the_ground_is_not_the_suggestion_s_to_tell() -> None:
    """A network that sees a place once tells how high the ground is no better than by chance."""
    true, houses = landscape()
    measured = true.copy()
    measured[30:60, 40:80] = np.nan
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    drifting = houses + 8 * np.exp(-((u - 60) ** 2 + (v - 45) ** 2) / 2 / 30**2)
    gap = np.isnan(measured)
    assert np.abs(anchored(drifting, measured)[0] - true)[gap].mean() < 0.8
    far = anchored(drifting - 100, measured - 100)[0] + 100  # from far above only what is tall is believed
    assert np.abs(far - true)[gap].mean() < 0.8


def test_the_plate_carries_a_slope_on_beyond_the_last_measured_place() -> None:
    _, houses = landscape()
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    slope = 0.1 * u + 0.05 * v - 100
    measured = np.where(u < 90, slope, np.nan).astype(np.float32)
    found, _ = anchored(np.zeros_like(houses), measured)
    level = np.abs(slope[:, 89:90] - slope)[:, 90:].mean()  # what the last height, carried on, would be wrong by
    assert np.abs(found - slope)[:, 90:].mean() < 0.5 * level


def test_outliers_do_not_pull() -> None:
    true, houses = landscape()
    measured = true.copy()
    measured[:, ::3] += 40.0  # a third of the matches are wrong
    assert np.abs(anchored(houses, measured)[0] - true).mean() < 0.6


@pytest.mark.parametrize("shape", [(4, 120), (6, 120), (120, 1), (1, 1)])
def test_a_strip_of_one_or_two_cells_has_a_plate_too(shape: tuple[int, int]) -> None:
    measured = np.full(shape, -50, np.float32)
    measured[-shape[0] // 3 :, -shape[1] // 3 :] = np.nan if max(shape) > 1 else -50
    np.testing.assert_allclose(anchored(np.full(shape, -40, np.float32), measured)[0], -50, atol=1e-2)


def test_without_measurements_the_suggestion_stands() -> None:
    _, houses = landscape()
    found, sure = anchored(houses, np.full_like(houses, np.nan))
    np.testing.assert_array_equal(found, houses)
    assert sure.max() < 0.1


def test_what_is_far_from_anything_measured_or_beside_rough_land_is_less_sure() -> None:
    flat = np.full((HEIGHT, WIDTH), -100, np.float32)
    measured = flat.copy()
    measured[:, 50:] = np.nan
    nothing = np.zeros_like(flat)
    level = anchored(nothing, measured)[1]
    rough = anchored(nothing, measured + 4 * np.random.default_rng(0).standard_normal(flat.shape).astype(np.float32))[1]
    tower = nothing.copy()
    tower[40:50, 70:80] = 20
    stands = anchored(tower, measured)[1]
    assert level[:, 55].min() > 0.8 > level[:, 110].max() > 0.3
    assert (rough[:, 55:75] < level[:, 55:75] - 0.2).all()
    assert stands[45, 75] < level[45, 75] - 0.3
