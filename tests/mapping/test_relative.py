"""Matches that agree with one relative pose near the priors, among many that do not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from overfly.geometry import Camera, pose, project, rotation_from_gimbal
from overfly.mapping.overlays import Prior
from overfly.mapping.relative import _pair, _residuals, agreeing, comparable

CAMERA = Camera(800, 600, 600.0, 600.0, 400.0, 300.0)


def looking(
    yaw: float, pitch: float, place: tuple[float, float, float], rng: np.random.Generator, camera: Camera = CAMERA
) -> tuple[np.ndarray, Prior]:
    """A pose, and what GPS wrong by 2 m and a gimbal wrong by a degree tell of it."""
    told = rotation_from_gimbal(yaw + rng.normal(0, 1.5), pitch + rng.normal(0, 0.7))
    return pose(rotation_from_gimbal(yaw, pitch), place), Prior(camera, pose(told, place + rng.normal(0, 2, 3)))


def seen_by_both(
    poses: tuple[np.ndarray, np.ndarray], count: int, rng: np.random.Generator, camera: Camera = CAMERA
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of points of rough ground with houses in both images."""
    ground = np.column_stack([rng.uniform(-150, 250, (4000, 2)), rng.choice([0.0, 0.0, 12.0], 4000)])
    ground[:, 2] += rng.uniform(0, 2, 4000)
    pixels = [project(ground, camera, p)[0] + rng.normal(0, 0.2 * camera.width / 800, (4000, 2)) for p in poses]
    size = (camera.width, camera.height)
    inside = np.flatnonzero(np.logical_and(*(((p > 0) & (p < size)).all(1) for p in pixels)))[:count]
    return pixels[0][inside], pixels[1][inside]


PAIRS = {
    "nadir": ((0.0, -90.0, (0.0, 0.0, 100.0)), (180.0, -90.0, (60.0, 10.0, 102.0))),
    "circle": ((0.0, -55.0, (0.0, -100.0, 120.0)), (60.0, -55.0, (-87.0, -50.0, 120.0))),
    "tilt and nadir": ((30.0, -60.0, (0.0, 0.0, 100.0)), (90.0, -90.0, (30.0, 70.0, 80.0))),
}


@pytest.mark.parametrize("kind", PAIRS)
@pytest.mark.parametrize("zoom", [1, 5])
def test_right_matches_are_found_among_five_times_as_many_wrong_ones(kind: str, zoom: int) -> None:
    rng = np.random.default_rng(3)
    camera = CAMERA.resized(800 * zoom, 600 * zoom)
    (true, told), (other, also) = (looking(*where, rng, camera) for where in PAIRS[kind])
    right = seen_by_both((true, other), 25, rng, camera)
    wrong = rng.uniform(0, 1, (2, 125, 2)) * (camera.width, camera.height)
    agree = agreeing(told, also, tuple(np.concatenate(ends) for ends in zip(right, wrong)), 0)  # type: ignore[arg-type]
    assert len(right[0]) == 25
    assert agree[:25].sum() >= 23
    assert agree[25:].sum() <= 3


@pytest.mark.parametrize("kind", PAIRS)
def test_wrong_matches_alone_do_not_agree(kind: str) -> None:
    """Those of one other pose, of a camera turned by 20 degrees, do not as a whole: some lie near its lines."""
    shares = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        (true, told), (_, also) = (looking(*where, rng) for where in PAIRS[kind])
        wrong = rng.uniform(0, 1, (2, 150, 2)) * (800, 600)
        assert not agreeing(told, also, (wrong[0], wrong[1]), seed).any()
        turned = also.world_from_camera.copy()
        turned[:3, :3] @= Rotation.from_euler("y", 20, degrees=True).as_matrix()
        ends = seen_by_both((true, turned), 40, rng)
        shares.append(agreeing(told, also, ends, seed).mean())
    assert np.mean(shares) < 0.45  # half of them support a pair


@pytest.mark.parametrize(("first", "second"), [(60.0, 140.0), (140.0, 60.0), (100.0, 100.0)])
@pytest.mark.parametrize("take_off", [-40.0, 0.0, 25.0])
def test_cameras_at_other_heights_and_over_valleys_agree(first: float, second: float, take_off: float) -> None:
    """Heights are told over the take-off, which may lie 25 m above the ground or 40 m below it."""
    rng = np.random.default_rng(1)
    (true, told), (other, also) = (
        looking(0.0, -90.0, where, rng) for where in ((0.0, 0.0, first), (25.0, 10.0, second))
    )
    ends = seen_by_both((true, other), 60, rng)
    lifted = [Prior(p.camera, pose(p.world_from_camera[:3, :3], p.world_from_camera[:3, 3] - [0, 0, take_off]))
              for p in (told, also)]  # fmt: skip
    assert agreeing(*lifted, ends, 0).mean() > 0.9


def test_derivatives_are_those_of_the_distances() -> None:
    rng = np.random.default_rng(5)
    (true, told), (other, also) = (looking(*where, rng) for where in PAIRS["circle"])
    pair = _pair(told, also, seen_by_both((true, other), 30, rng))
    slope = _residuals(pair, np.zeros((1, 5)))[1][0]
    for k, step in enumerate([1e-5, 1e-5, 1e-5, 1e-3, 1e-3]):
        ends = [_residuals(pair, sign * step * np.eye(5)[k : k + 1])[0][0] for sign in (1, -1)]
        # The scale of the distance is held fixed: near the epipolar line its change does not matter.
        expected = (ends[0] - ends[1]) / (2 * step)
        near = np.abs(_residuals(pair, np.zeros((1, 5)))[0][0]) < 15
        assert near.sum() >= 5
        np.testing.assert_allclose(slope[near, k], expected[near], rtol=0.1, atol=0.05 * np.abs(slope[:, k]).max())


def test_copies_and_lonely_matches_agree_on_nothing() -> None:
    rng = np.random.default_rng(0)
    true, told = looking(0.0, -90.0, (0.0, 0.0, 100.0), rng)
    ends = seen_by_both((true, true), 40, rng)
    assert not comparable(told, told)
    assert not agreeing(told, told, ends, 0).any(), "without a base nothing is told"
    none = np.zeros((0, 2))
    other = looking(0.0, -90.0, (40.0, 0.0, 100.0), rng)[1]
    assert agreeing(told, other, (none, none), 0).shape == (0,)
    assert not agreeing(told, other, (ends[0][:4], ends[1][:4]), 0).any()
