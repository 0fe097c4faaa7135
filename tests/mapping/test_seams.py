"""Seams between charts: differences of light are spread over both sides, differences of things stay."""

from __future__ import annotations

import numpy as np
import pytest

from overfly.mapping.seams import FADE, FLOOR, PARTS, cut_field, field, movements, toned, tones_at


def two_charts(n: int = 60) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two square charts of n x n vertices side by side that share a column: vertices, faces, columns from the seam."""
    at = np.arange(n * n).reshape(n, n)
    a, b, c, d = at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]
    faces = np.concatenate([np.stack([a, d, c], -1), np.stack([a, c, b], -1)]).reshape(-1, 3)
    column = np.tile(np.arange(n), n)
    row = np.repeat(np.arange(n), n)
    left, right = row * 1000 + column, row * 1000 + column + n - 1  # the left one ends where the right one begins
    away = np.concatenate([n - 1 - column, column])
    return np.concatenate([left, right]), np.concatenate([faces, faces + n * n]), away


def test_what_differs_at_the_seam_agrees_and_what_is_far_stays() -> None:
    n = 200
    vertex, faces, away = two_charts(n)
    colors = np.repeat([[4.6, 4.5, 4.4], [4.72, 4.5, 4.36]], n * n, axis=0)
    moved = movements(colors, vertex, faces)
    left, right = moved[: n * n], moved[n * n :]
    at = away[: n * n] == 0, away[n * n :] == 0
    np.testing.assert_allclose(left[at[0]] - right[at[1]], np.tile([0.12, 0, -0.04], (n, 1)), atol=0.005)
    np.testing.assert_allclose(left[at[0]].mean(0), [0.06, 0, -0.02], atol=0.003)
    far = away[: n * n] > 3 * FADE
    assert np.abs(left[far]).max() < 0.06 * 0.06
    assert np.abs(np.diff(left[:, 0].reshape(n, n), axis=1)).max() < 0.003  # no step of its own


def test_a_roof_against_the_ground_moves_neither() -> None:
    vertex, faces, _ = two_charts()
    colors = np.repeat(np.log([[186.0, 76, 66], [86.0, 146, 76]]), len(vertex) // 2, axis=0)
    assert np.abs(movements(colors, vertex, faces)).max() < 1e-6


def test_vertices_without_a_photograph_are_not_moved() -> None:
    vertex, faces, _ = two_charts()
    colors = np.repeat([[4.6, 4.5, 4.4], [np.nan] * 3], len(vertex) // 2, axis=0)
    np.testing.assert_array_equal(movements(colors, vertex, faces), 0)


def test_charts_that_meet_where_one_has_no_photograph_agree() -> None:
    n = 60
    vertex, faces, away = two_charts(n)
    colors = np.repeat([[4.6, 4.5, 4.4], [4.72, 4.5, 4.36]], n * n, axis=0)
    seam = vertex[: n * n][away[: n * n] == 0]
    between = n * n  # a chart of the cloud's colours, numbered between the two, has a vertex at each of their joints
    vertex, colors = np.insert(vertex, between, seam), np.insert(colors, between, np.full((n, 3), np.nan), axis=0)
    faces = faces + n * (faces >= between)
    moved = movements(colors, vertex, faces)
    left, right = moved[: n * n][away[: n * n] == 0], moved[n * n + n :][away[n * n :] == 0]
    np.testing.assert_allclose(left - right, np.tile([0.12, 0, -0.04], (n, 1)), atol=0.02)


def test_the_field_is_linear_between_vertices_and_continued_a_little() -> None:
    pixels = np.array([[40.0, 20], [200, 20], [200, 140], [40, 140]])
    moved = np.column_stack([pixels[:, 0] / 10, pixels[:, 1] / 10, np.full(4, -3.0)])
    values = field((320, 240), pixels, moved, np.array([[0, 1, 2], [0, 2, 3]]))
    assert values.shape == (240 // PARTS, 320 // PARTS, 3)
    for scale in (1.0, 0.5):
        box = cut_field(values, np.array([48, 32]) * scale, np.array([140, 100]) * scale, scale)
        y, x = np.indices(box.shape[:2])
        expected = np.stack([(x + 0.5) / scale + 48, (y + 0.5) / scale + 32], axis=-1) / 10
        np.testing.assert_allclose(box[..., :2], expected, atol=0.02)
        np.testing.assert_allclose(box[..., 2], -3, atol=1e-5)
    beside = cut_field(values, np.array([200, 60]), np.array([PARTS, 20]), 1.0)  # the chart's padding
    assert np.abs(beside[..., 2] + 3).max() < 1e-4
    assert not values[0, 0].any()


def test_colours_are_averaged_over_their_surroundings() -> None:
    image = np.zeros((40, 60, 3), np.uint8)
    image[:, 30:] = [200, 100, 50]
    found = tones_at(image, np.array([[30.5, 20], [10, 20], [50, 20], [70, 20]]), 4.8)
    assert found[0, 0] == pytest.approx(np.log(200 * 3 / 5 + FLOOR), abs=0.01)
    np.testing.assert_allclose(found[1:3], np.log([[FLOOR] * 3, [200 + FLOOR, 100 + FLOOR, 50 + FLOOR]]))
    assert np.isnan(found[3]).all()


def test_moved_tones_keep_shadows() -> None:
    colors = np.array([[4, 100, 250]], np.uint8)
    assert toned(colors, np.zeros((1, 3), np.float32)).tolist() == colors.tolist()
    darker = toned(colors, np.full((1, 3), -0.15, np.float32))
    assert darker.tolist() == [[1, 84, 213]]
    assert toned(colors, np.full((1, 3), 0.15, np.float32))[0, 2] == 255
