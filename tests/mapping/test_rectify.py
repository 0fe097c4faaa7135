"""Rectification and matching of single pairs, in every direction that strips are flown."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from overfly.geometry import Camera, look_at, pose, rotation_from_gimbal
from overfly.mapping.depth_ranges import depth_ranges
from overfly.mapping.matcher import UNKNOWN, depth_in_frame, disparities, right_disparities
from overfly.mapping.rectify import Rectified, Relief, ordered, rectify

DIRECTIONS = {
    "along the rows": ((0, 0, 0), (25, 0, 0)),
    "along the columns": ((0, 0, 0), (0, 25, 0)),
    "oblique, other height": ((0, 0, 0), (-18, 14, 30)),
    "strips to and fro": ((0, 0, 0), (25, 4, 180)),
    "turned by 90 degrees": ((0, 0, 0), (20, 0, 90)),
}


def two(direction: str) -> list[np.ndarray]:
    """Poses: x, y, yaw of each of two cameras; the second hangs a little."""
    return [
        pose(rotation_from_gimbal(yaw, -90 + 3 * i, 2 * i), [x, y, 80 + 2 * i])
        for i, (x, y, yaw) in enumerate(DIRECTIONS[direction])
    ]


TILTED = {
    "side by side, tilted": ((0, -60, 0, -50), (40, -60, 0, -50)),
    "round a place, 60 degrees apart": ((0, -70, 0, -50), (-61, -35, 60, -50)),
    "one after the other, tilted, other height": ((0, -60, 0, -55), (3, -30, 0, -60)),
}
RELIEF = Relief(-6.0, 0.5, 7.0)


def looks(name: str) -> list[np.ndarray]:
    if name in DIRECTIONS:
        return two(name)
    return [
        pose(rotation_from_gimbal(yaw, pitch), [x, y, 80 + 3 * i]) for i, (x, y, yaw, pitch) in enumerate(TILTED[name])
    ]


def laid_out(poses: list[np.ndarray], camera: Camera, relief: Relief | None) -> tuple[list[np.ndarray], Rectified]:
    if not ordered((poses[0], poses[1])):
        poses = poses[::-1]
    pair = rectify((camera, camera), (poses[0], poses[1]), ((60, 170), (60, 170)), relief)
    assert pair is not None
    return poses, pair


def on_canvas(points: np.ndarray, pair: Rectified, centre: np.ndarray, right: bool) -> tuple[np.ndarray, np.ndarray]:
    """Places (u, v) of world points and their depth."""
    local = (points - centre) @ pair.rotation
    places = local @ (pair.right if right else pair.left).T
    return places[:, :2] / places[:, 2:], local[:, 2]


@pytest.mark.parametrize("relief", [None, RELIEF], ids=["", "sheared"])
@pytest.mark.parametrize("name", [*DIRECTIONS, *TILTED])
def test_matching_points_share_a_row_and_their_disparity_is_their_depth(
    name: str, relief: Relief | None, camera: Camera
) -> None:
    poses, pair = laid_out(looks(name), camera, relief)
    points = np.random.default_rng(0).uniform([-15, -15, -4], [25, 20, 4], (50, 3))
    left, depth = on_canvas(points, pair, poses[0][:3, 3], right=False)
    right, _ = on_canvas(points, pair, poses[1][:3, 3], right=True)
    np.testing.assert_allclose(left[:, 1], right[:, 1], atol=1e-6)
    disparity = left[:, 0] - right[:, 0]
    assert pair.limits[0] <= disparity.min()
    assert disparity.max() <= pair.limits[1]
    np.testing.assert_allclose(pair.depth(disparity, *left.T), depth, rtol=1e-5)
    np.testing.assert_allclose(pair.depth(disparity, *right.T, right=True), depth, rtol=1e-5)


@pytest.mark.parametrize("name", TILTED)
def test_level_ground_lies_at_the_same_place_of_both_canvases(name: str, camera: Camera) -> None:
    poses, pair = laid_out(looks(name), camera, RELIEF)
    ground = np.random.default_rng(0).uniform([-15, -15, RELIEF.ground], [25, 20, RELIEF.ground], (50, 3))
    left, right = (on_canvas(ground, pair, p[:3, 3], right=bool(k))[0] for k, p in enumerate(poses))
    assert np.ptp(left[:, 0] - right[:, 0]) < 1e-6
    _, plain = laid_out(looks(name), camera, None)
    assert np.ptp(pair.limits) < 0.7 * np.ptp(plain.limits)  # the relief is searched, not the depth of the view


@pytest.mark.parametrize("name", [*DIRECTIONS, *TILTED])
def test_a_matched_pair_gives_the_depth_of_both_frames(name: str, camera: Camera, hill) -> None:  # type: ignore[no-untyped-def]
    poses, layout = laid_out(looks(name), camera, Relief(-12, 0, 12))
    images = [cv2.cvtColor(hill.render(camera, p), cv2.COLOR_RGB2GRAY) for p in poses]
    left = disparities((images[0], images[1]), (camera, camera), (poses[0], poses[1]), layout)
    ideal = camera.undistorted()
    for k, found in enumerate((left, right_disparities(left))):
        depth = depth_in_frame(found, ideal, poses[k], layout, right=bool(k))
        true = (hill.surface(ideal, poses[k]) - poses[k][:3, 3]) @ poses[k][:3, 2]
        known = np.isfinite(depth)
        assert known.mean() > 0.25
        gsd = 80 / camera.fx
        assert np.median(np.abs(depth - true)[known]) < 1.0 * gsd
        assert (np.abs(depth - true)[known] < 1.0).mean() > 0.95


def test_shearing_finds_more_and_nearer_of_what_two_tilted_frames_see(camera: Camera, hill) -> None:  # type: ignore[no-untyped-def]
    around = [look_at([114 * np.sin(t), 114 * np.cos(t), 80], [0, 0, 0]) for t in np.radians([180, 255])]
    right = []
    for relief in (None, Relief(-12, 0, 12)):
        poses, layout = laid_out(around, camera, relief)
        images = [cv2.cvtColor(hill.render(camera, p), cv2.COLOR_RGB2GRAY) for p in poses]
        found = disparities((images[0], images[1]), (camera, camera), (poses[0], poses[1]), layout)
        depth = depth_in_frame(found, camera.undistorted(), poses[0], layout, right=False)
        true = (hill.surface(camera.undistorted(), poses[0]) - poses[0][:3, 3]) @ poses[0][:3, 2]
        right.append(float((np.abs(depth - true) < 0.3).mean()))
    assert right[1] > 2 * right[0]


@pytest.mark.parametrize("ground", [9.0, 9.99, 10.0, 12.0])
def test_ground_as_high_as_the_cameras_shears_nothing(ground: float, camera: Camera) -> None:
    """Before a facade the usual height of the surface may be that of the cameras."""
    ahead = pose(rotation_from_gimbal(0, 0), [0, 0, 10]), pose(rotation_from_gimbal(0, 0), [8, 0, 10])
    plain, pair = (
        rectify((camera, camera), ahead, ((35, 45), (35, 45)), relief) for relief in (None, Relief(-2, ground, 24))
    )
    assert plain is not None
    assert pair is not None
    np.testing.assert_array_equal(pair.right, plain.right)
    assert pair.limits == plain.limits


def test_heights_may_be_unknown(camera: Camera) -> None:
    poses = looks("round a place, 60 degrees apart")
    _, pair = laid_out(poses, camera, Relief(-np.inf, 0.5, np.inf))
    _, known = laid_out(poses, camera, RELIEF)
    assert np.isfinite(pair.limits).all()
    assert np.ptp(pair.limits) > np.ptp(known.limits)


@pytest.mark.parametrize("pitch", [-20, -25])
@pytest.mark.parametrize("end", [0, 1])
def test_no_disparity_means_a_depth_out_of_reach(pitch: float, end: int, camera: Camera) -> None:
    """Far rays and the sky have no room for the disparities that near rays may have."""
    two_of = [pose(rotation_from_gimbal(0, pitch), [x, 0, 80]) for x in (0, 25)]
    pair = rectify((camera, camera), (two_of[0], two_of[1]), ((60, 300), (60, 300)), Relief(-6, 0.5, 12))
    assert pair is not None
    v, u = np.mgrid[: pair.size[1], : pair.size[0]] + 0.5
    depth = pair.depth(np.full(u.shape, pair.limits[end]), u, v)
    known = np.isfinite(depth)
    assert 0.1 < known.mean() < 1
    assert depth[known].min() >= pair.reach[0] * 0.999
    assert depth[known].max() <= pair.reach[1] * 1.001


def test_frames_that_look_along_their_baseline_or_apart_are_refused(camera: Camera) -> None:
    ahead = pose(rotation_from_gimbal(0, 0), [0, 0, 10]), pose(rotation_from_gimbal(0, 0), [0, 30, 10])
    assert rectify((camera, camera), ahead, ((10, 60), (10, 60))) is None
    apart = pose(rotation_from_gimbal(0, -90), [0, 0, 80]), pose(rotation_from_gimbal(0, -90), [500, 0, 80])
    assert rectify((camera, camera), apart, ((70, 90), (70, 90))) is None
    same = pose(rotation_from_gimbal(0, -90), [0, 0, 80])
    assert rectify((camera, camera), (same, same), ((70, 90), (70, 90))) is None


def test_a_wrong_point_close_to_a_camera_makes_no_canvas_without_end(camera: Camera) -> None:
    poses = two("along the rows")
    pair = rectify((camera, camera), (poses[0], poses[1]), ((0.5, 90), (70, 90)))
    assert pair is not None
    assert pair.size[0] < 4 * camera.width
    assert pair.limits[1] - pair.limits[0] == pytest.approx(camera.width)


def test_the_nearest_surface_wins_in_the_right_canvas() -> None:
    left = np.full((1, 8), UNKNOWN, np.int16)
    left[0, 5], left[0, 4] = 3 * 16, 2 * 16  # both land in column 2
    left[0, 1] = 4 * 16  # leaves the canvas
    right = right_disparities(left)
    assert right[0, 2] == 48
    assert (right != UNKNOWN).sum() == 1


def test_pictures_of_nothing_match_nowhere(camera: Camera, tmp_path: Path) -> None:
    poses = two("along the rows")
    layout = rectify((camera, camera), (poses[0], poses[1]), ((70, 90), (70, 90)))
    assert layout is not None
    blank = np.full((240, 320), 120, np.uint8)
    found = disparities((blank, blank), (camera, camera), (poses[0], poses[1]), layout)
    assert (found == UNKNOWN).all()


def test_two_wrong_points_of_a_frame_do_not_widen_its_depths(camera: Camera) -> None:
    down = pose(rotation_from_gimbal(0, -90), [0, 0, 80])
    points = np.column_stack([np.random.default_rng(0).uniform(-15, 15, (60, 2)), np.zeros(60)])
    points[:2, 2] = 76.0, 70.0
    points[:2, :2] *= 0.02
    span = depth_ranges([camera], [down], points)[0]
    assert span.middle == pytest.approx(80)
    assert span.near > 70
    assert span.far < 90
