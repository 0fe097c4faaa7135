"""GPS and gimbal errors: their size, their seed, and that zero is zero."""

from __future__ import annotations

import numpy as np
import pytest

from overfly.errors import InputError
from overfly.flights.noise import NOISE, PoseNoise, noise_model
from overfly.geometry import gimbal_from_rotation, pose, rotation_from_gimbal


def test_zero_noise_changes_nothing():
    poses = np.stack([pose(rotation_from_gimbal(40, -70, 3), [1, 2, 3]), pose(rotation_from_gimbal(0, -90), [4, 5, 6])])
    assert np.allclose(NOISE["none"].poses(poses, np.random.default_rng(0)), poses)


def test_spread_and_bias_have_the_stated_size():
    model = PoseNoise(horizontal_m=1.0, bias_horizontal_m=0.0, yaw_deg=2.0, tilt_deg=0.5, bias_yaw_deg=0.0)
    errors = model.positions(np.zeros((20_000, 3)), np.random.default_rng(1))
    assert np.allclose(errors.std(0), [1, 1, 3], rtol=0.03)
    angles = model.angles(np.zeros((20_000, 3)), np.random.default_rng(1))
    assert np.allclose(angles.std(0), [2, 0.5, 0.5], rtol=0.03)
    shift = PoseNoise(horizontal_m=0.0, bias_horizontal_m=2.0, yaw_deg=0.0, tilt_deg=0.0, bias_yaw_deg=1.0)
    moved = shift.positions(np.zeros((5, 3)), np.random.default_rng(2))
    assert np.ptp(moved, axis=0).max() == 0
    assert np.abs(moved[0]).min() > 0
    biases = np.array([shift.positions(np.zeros((1, 3)), np.random.default_rng(i))[0] for i in range(2000)])
    assert np.allclose(biases.std(0), [2, 2, 6], rtol=0.08)


def test_same_seed_same_noise_and_rotations_stay_rotations():
    poses = np.stack([pose(rotation_from_gimbal(20 * i, -80), [i, 0, 100]) for i in range(6)])
    a, b = (NOISE["gps"].poses(poses, np.random.default_rng(7)) for _ in range(2))
    assert np.array_equal(a, b)
    assert np.allclose(a[:, :3, :3] @ a[:, :3, :3].transpose(0, 2, 1), np.eye(3))
    assert abs(gimbal_from_rotation(a[3, :3, :3])[1] + 80) < 3
    assert np.abs(NOISE["rtk"].poses(poses, np.random.default_rng(7))[:, :3, 3] - poses[:, :3, 3]).max() < 0.3


def test_bad_noise():
    with pytest.raises(InputError, match="'gpss' is unknown; did you mean 'gps'"):
        noise_model("gpss")
    with pytest.raises(InputError, match="yaw_deg=-1"):
        PoseNoise(horizontal_m=0, bias_horizontal_m=0, yaw_deg=-1, tilt_deg=0, bias_yaw_deg=0)
