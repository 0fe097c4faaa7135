"""Footprints: rays against planes and hills whose answer is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from overfly.flights.footprint import footprints, meet_ground, pair_overlap, terrain_range
from overfly.geometry import Camera, on_plane, pose, project, rotation_from_gimbal

CAMERA = Camera.from_fov(300, 200, 70)


def flat(xy):
    return np.zeros(len(xy))


def test_flat_nadir_footprint_is_the_textbook_rectangle():
    outline = footprints(CAMERA, pose(rotation_from_gimbal(0, -90), [10, 20, 100]), flat, (0, 0))[0]
    width = 100 * 300 / CAMERA.fx
    assert np.allclose(np.ptp(outline, axis=0), [width, width * 2 / 3])
    assert np.allclose(outline.mean(0), [10, 20])


def test_tilted_footprint_equals_the_plane_intersection_of_the_geometry_module():
    view = pose(rotation_from_gimbal(30, -60), [0, 0, 100])
    outline = footprints(CAMERA, view, lambda xy: np.full(len(xy), 7.0), (7.0, 7.0))[0]
    corners = on_plane([[0, 0], [300, 0], [300, 200], [0, 200]], CAMERA, view, 7.0)
    assert np.allclose(outline, corners[:, :2])


def test_rays_meet_a_slope_where_algebra_says():
    def slope(xy):
        return 0.3 * xy[:, 0]

    origin, direction = np.array([[0.0, 0.0, 50.0]]), np.array([[1.0, 0.5, -1.0]])
    hit = meet_ground(origin, direction, slope, (-100.0, 100.0))[0]
    t = 50 / 1.3
    assert np.allclose(hit, [t, 0.5 * t, 50 - t], atol=1e-3)


def test_a_hill_hides_the_ground_behind_it():
    def hill(xy):
        return 30 * np.exp(-(((xy[:, 0] - 50) / 10) ** 2))

    hit = meet_ground(np.array([[0.0, 0.0, 50.0]]), np.array([[2.0, 0.0, -1.0]]), hill, (0.0, 30.0))[0]
    x = np.linspace(0, 100, 100_001)
    first = x[np.argmax(50 - x / 2 <= hill(np.column_stack([x, x])))]  # the ray meets level ground only at x = 100
    assert hit[0] == pytest.approx(first, abs=0.01)
    assert first < 50


def test_border_points_project_to_the_image_border_on_terrain_with_a_lens():
    camera = replace(CAMERA, k1=-0.1, k2=0.02, p1=0.002)

    def hilly(xy):
        return 6 * np.sin(xy[:, 0] / 20) + 4 * np.cos(xy[:, 1] / 15)

    view = pose(rotation_from_gimbal(200, -70), [5, -3, 80])
    outline = footprints(camera, view, hilly, (-10.0, 10.0), per_side=6)[0]
    points = np.column_stack([outline, hilly(outline)])
    pixels, _ = project(points, camera, view)
    u, v = pixels.T
    distance = np.minimum(np.minimum(np.abs(u), np.abs(u - 300)), np.minimum(np.abs(v), np.abs(v - 200)))
    assert distance.max() < 0.05


def test_rays_to_the_sky_end_at_a_finite_reach():
    outline = footprints(CAMERA, pose(rotation_from_gimbal(0, -10), [0, 0, 50]), flat, (0, 0))[0]
    assert np.isfinite(outline).all()
    assert np.abs(outline).max() <= 8 * 50 + 1e-6


def test_pair_overlap_of_shifted_squares():
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    shifted = np.stack([square, square + np.array([0.25, 0]), square + 0.5, square + 2, 2 * square])
    shares = pair_overlap(np.broadcast_to(square, shifted.shape), shifted)
    assert np.allclose(shares, [1, 0.75, 0.25, 0, 1])


def test_terrain_range_finds_mean_and_extremes():
    mean, low, high = terrain_range(lambda xy: 0.1 * xy[:, 0], (0.0, 0.0, 100.0, 50.0), 50.0)
    assert mean == pytest.approx(5)
    assert low <= -5
    assert high >= 15
