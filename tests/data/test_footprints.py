"""Footprints, overlaps and the choice of frames, against hand values."""

from __future__ import annotations

import numpy as np
import pytest

from overfly.data.footprints import REACH, choose_frames, footprint, ground_overlaps, sees
from overfly.geometry import Camera, pose, project, rotation_from_gimbal

SQUARE = Camera.from_fov(100, 100, 90)  # at 50 m the footprint is 100 m x 100 m


def nadir(x: float, y: float, z: float = 50.0, yaw: float = 0.0) -> np.ndarray:
    return pose(rotation_from_gimbal(yaw, -90), [x, y, z])


def test_footprint_by_hand() -> None:
    np.testing.assert_allclose(
        footprint(SQUARE, nadir(10, 20), 0.0), [[-40, 70], [60, 70], [60, -30], [-40, -30]], atol=1e-9
    )


def test_footprint_ends_at_reach_towards_the_horizon_and_is_nan_in_the_sky() -> None:
    level = pose(rotation_from_gimbal(0, -10), [0, 0, 50])
    far = footprint(SQUARE, level, 0.0)
    assert np.isfinite(far).all()
    np.testing.assert_allclose(np.linalg.norm(far[:2], axis=1), REACH * 50)
    assert np.isnan(footprint(SQUARE, pose(rotation_from_gimbal(0, 80), [0, 0, 50]), 0.0)).all()
    assert np.isnan(footprint(SQUARE, nadir(0, 0, -5), 0.0)).all()


def test_overlaps_by_hand_and_against_counted_points() -> None:
    poses = [nadir(0, 0), nadir(0, 40), nadir(500, 0), nadir(0, 0, 100), nadir(20, 10, 60, 30)]
    outlines = np.stack([footprint(SQUARE, p, 0.0) for p in poses])
    overlaps = ground_overlaps(outlines)
    assert overlaps[0, 1] == pytest.approx(0.6)
    assert overlaps[0, 2] == 0
    assert overlaps[0, 3] == pytest.approx(1)
    assert overlaps[3, 0] == pytest.approx(0.25)
    points = np.column_stack([np.random.default_rng(0).uniform(-50, 50, (20000, 2)), np.zeros(20000)])
    assert overlaps[0, 4] == pytest.approx(sees(points, SQUARE, poses[4]).mean(), abs=0.01)
    blind = np.concatenate([outlines, np.full((1, 4, 2), np.nan)])
    assert ground_overlaps(blind)[5, :5].sum() == 0


def test_a_bent_lens_does_not_fold_far_points_into_the_image() -> None:
    lens = Camera(100, 100, 50, 50, 50, 50, k1=-0.1)
    far = np.array([[400.0, 0, 0]])  # x/z = 8: the polynomial turns back
    assert not sees(far, lens, nadir(0, 0))[0]
    assert not sees([[0, 0, 60.0]], SQUARE, nadir(0, 0))[0]  # behind the camera
    pixels, _ = project([[5.0, 5, 0]], lens, nadir(0, 0))
    assert np.isfinite(pixels).all()
    assert sees([[5.0, 5, 0]], lens, nadir(0, 0))[0]


def test_frames_are_chosen_by_new_ground_and_base_across_strips() -> None:
    # reference, almost the same place, along the strip before and behind, far away
    poses = np.stack([nadir(0, 0), nadir(0, 1), nadir(0, 35), nadir(0, -35), nadir(900, 0), nadir(45, 0)])
    chosen = choose_frames(0, 3, [SQUARE] * 6, poses, 0.0)
    assert chosen[0] == 0
    assert set(chosen) == {0, 2, 3}
    everything = choose_frames(0, 6, [SQUARE] * 6, poses, 0.0)
    assert 4 not in everything
    assert len(everything) == 5
    assert choose_frames(4, 3, [SQUARE] * 6, poses, 0.0) == [4]
