"""Rectification and matching of single pairs, in every direction that strips are flown."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from overfly.geometry import Camera, pose, project, rotation_from_gimbal
from overfly.mapping.depth_ranges import depth_ranges
from overfly.mapping.matcher import UNKNOWN, depth_in_frame, disparities, right_disparities
from overfly.mapping.rectify import ordered, rectify

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


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_matching_points_share_a_row_and_their_disparity_is_their_depth(direction: str, camera: Camera) -> None:
    poses = two(direction)
    if not ordered((poses[0], poses[1])):
        poses = poses[::-1]
    pair = rectify((camera, camera), (poses[0], poses[1]), ((70, 90), (70, 90)))
    assert pair is not None
    points = np.random.default_rng(0).uniform([-15, -15, -4], [25, 20, 4], (50, 3))
    canvas = Camera(*pair.size, pair.focal, pair.focal, *pair.left_centre)
    left, depth = project(points, canvas, pose(pair.rotation, poses[0][:3, 3]))
    right, _ = project(
        points, replace(canvas, cx=pair.right_centre[0], cy=pair.right_centre[1]), pose(pair.rotation, poses[1][:3, 3])
    )
    np.testing.assert_allclose(left[:, 1], right[:, 1], atol=1e-6)
    np.testing.assert_allclose(pair.depth(left[:, 0] - right[:, 0]), depth, rtol=1e-6)


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_a_matched_pair_gives_the_depth_of_both_frames(direction: str, camera: Camera, hill) -> None:  # type: ignore[no-untyped-def]
    poses = two(direction)
    if not ordered((poses[0], poses[1])):
        poses = poses[::-1]
    layout = rectify((camera, camera), (poses[0], poses[1]), ((70, 92), (70, 92)))
    assert layout is not None
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
    assert pair.disparity(pair.nearest) - pair.disparity(pair.farthest) == pytest.approx(camera.width)
    assert pair.farthest == pytest.approx(99)


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
