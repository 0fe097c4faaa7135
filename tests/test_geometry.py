"""Cameras, transforms and frames: inverses undo, hand values hold, the conventions are what the module says."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from overfly import geometry as g

LENSES = [
    {},
    {"k1": -0.12, "k2": 0.02},
    {"k1": 0.05, "k2": -0.08, "p1": 0.002, "p2": -0.001, "k3": 0.01},
    {"k1": -0.28, "k2": 0.09, "p1": 0.0005, "p2": 0.0003, "k3": -0.012},  # a GoPro-like barrel
]


def camera(**lens: float) -> g.Camera:
    return g.Camera(1600, 1200, 1200.0, 1190.0, 805.0, 595.0, **lens)


def some_pose(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return g.pose(
        g.rotation_from_gimbal(rng.uniform(0, 360), rng.uniform(-90, -20), rng.uniform(-10, 10)), [10, -20, 150]
    )


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("seed", range(3))
def test_project_and_unproject_undo_each_other(lens: dict[str, float], seed: int) -> None:
    cam, pose, rng = camera(**lens), some_pose(seed), np.random.default_rng(seed)
    pixels = rng.uniform([0, 0], [1600, 1200], (500, 2))
    depth = rng.uniform(20, 300, 500)
    points = g.unproject(pixels, depth, cam, pose)
    again, again_depth = g.project(points, cam, pose)
    assert_allclose(again, pixels, atol=1e-6)
    assert_allclose(again_depth, depth, rtol=1e-12)
    assert_allclose(g.unproject(again, again_depth, cam, pose), points, atol=1e-6)


@pytest.mark.parametrize("lens", LENSES)
def test_projection_is_opencvs(lens: dict[str, float]) -> None:
    cv2 = pytest.importorskip("cv2")
    cam, pose = camera(**lens), some_pose(4)
    points = g.unproject([[100, 200], [1500, 1100], [800, 600.0]], [100, 150, 120], cam, pose)
    inverse = g.invert(pose)
    rotation, _ = cv2.Rodrigues(inverse[:3, :3])
    expected, _ = cv2.projectPoints(points, rotation, inverse[:3, 3].reshape(3, 1), cam.matrix(), cam.distortion)
    assert_allclose(g.project(points, cam, pose)[0], expected.reshape(-1, 2), atol=1e-6)


def test_pixels_beyond_the_fold_of_a_barrel_have_no_ray() -> None:
    cam = g.Camera(1600, 1200, 1100, 1100, 800, 600, k1=-0.3)  # r (1 - 0.3 r²) never exceeds 0.703
    rays = g.rays([[0.5, 0.5], [800, 600], [100, 600]], cam)
    assert np.isnan(rays[0, :2]).all()
    assert_allclose(g.project(rays[1:], cam, np.eye(4))[0], [[800, 600], [100, 600]], atol=1e-6)
    far_outside = g.project([[1.75, 0, 1.0]], cam, np.eye(4))[0]  # 60 degrees off the axis, thrown back to x = 0.14
    assert np.isnan(far_outside).all()
    assert g.fold(cam) == pytest.approx(1 / 0.9)
    assert g.fold(camera()) == np.inf


def test_hand_projection_straight_down() -> None:
    cam = g.Camera.from_fov(200, 100, 90)
    assert cam.fx == cam.fy == pytest.approx(100)
    pose = g.pose(g.rotation_from_gimbal(0, -90), [0, 0, 50])  # heading north: up in the image is north
    pixels, depth = g.project([[0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 60]], cam, pose)
    assert_allclose(pixels[:3], [[100, 50], [120, 50], [100, 30]], atol=1e-9)
    assert_allclose(depth, [50, 50, 50, -10])
    assert np.isnan(pixels[3]).all(), "behind the camera"


def test_points_in_the_plane_of_the_camera_have_no_pixel() -> None:
    assert np.isnan(g.project([[5.0, 0, 0]], camera(), np.eye(4))[0]).all()


def test_pixel_grid_has_centres_at_a_half() -> None:
    grid = g.pixel_grid(3, 2)
    assert grid.shape == (2, 3, 2)
    assert_allclose(grid[0, 0], [0.5, 0.5])
    assert_allclose(grid[1, 2], [2.5, 1.5])


def test_resized_camera_sees_the_same_in_the_scaled_image() -> None:
    cam = camera(**LENSES[2])
    small = cam.resized(400, 300)
    points = g.unproject(g.pixel_grid(1600, 1200)[::100, ::100].reshape(-1, 2), 100.0, cam, some_pose())
    assert_allclose(g.project(points, small, some_pose())[0] * 4, g.project(points, cam, some_pose())[0], atol=1e-9)
    assert_allclose(small.fov_deg, cam.fov_deg)
    uneven = cam.resized(800, 1200)
    assert (uneven.fx, uneven.fy) == (cam.fx / 2, cam.fy)


def test_fov_and_lens_flags() -> None:
    assert g.Camera.from_fov(4000, 3000, 81).fov_deg[0] == pytest.approx(81)
    assert camera(k3=1e-9).is_distorted
    assert not camera(k1=0.1).undistorted().is_distorted
    assert g.Camera(**camera(k1=0.1).to_dict()) == camera(k1=0.1)


def test_on_plane() -> None:
    cam, pose = camera(**LENSES[1]), g.pose(g.rotation_from_gimbal(30, -60), [5, 6, 100])
    pixels = g.pixel_grid(1600, 1200)[::200, ::200].reshape(-1, 2)
    points = g.on_plane(pixels, cam, pose, 12.0)
    assert_allclose(points[:, 2], 12, atol=1e-9)
    assert_allclose(g.project(points, cam, pose)[0], pixels, atol=1e-6)
    level = g.pose(g.rotation_from_gimbal(0, 0), [0, 0, 100])
    assert np.isnan(g.on_plane([[800, 100.0]], camera(), level, 0.0)).all(), "above the horizon"
    assert np.isfinite(g.on_plane([[800, 1100.0]], camera(), level, 0.0)).all()


def test_gimbal_hand_values() -> None:
    north_level = g.rotation_from_gimbal(0, 0)
    assert_allclose(north_level @ [0, 0, 1], [0, 1, 0], atol=1e-12)  # looks north
    assert_allclose(north_level @ [1, 0, 0], [1, 0, 0], atol=1e-12)  # its right is east
    assert_allclose(north_level @ [0, 1, 0], [0, 0, -1], atol=1e-12)  # its down is down
    assert_allclose(g.rotation_from_gimbal(90, 0) @ [0, 0, 1], [1, 0, 0], atol=1e-12)  # east
    assert_allclose(g.rotation_from_gimbal(0, -90) @ [0, 0, 1], [0, 0, -1], atol=1e-12)  # down
    assert_allclose(g.rotation_from_gimbal(90, -90) @ [0, -1, 0], [1, 0, 0], atol=1e-12)  # image up is east
    assert (g.rotation_from_gimbal(0, 0, 10) @ [1, 0, 0])[2] < 0  # clockwise: the right side sinks


def test_gimbal_round_trip() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        yaw, pitch, roll = rng.uniform(0, 360), rng.uniform(-89.9, 89.9), rng.uniform(-179, 179)
        rotation = g.rotation_from_gimbal(yaw, pitch, roll)
        assert g.is_rotation(rotation, 1e-9)
        assert_allclose(g.gimbal_from_rotation(rotation), [yaw, pitch, roll], atol=1e-6)


@pytest.mark.parametrize("pitch", [-90.0, 90.0])
def test_gimbal_at_the_pole_keeps_the_rotation(pitch: float) -> None:
    for yaw in (0, 37, 180, 300):
        rotation = g.rotation_from_gimbal(yaw, pitch, 25)
        back = g.gimbal_from_rotation(rotation)
        assert back[2] == 0
        assert_allclose(g.rotation_from_gimbal(*back), rotation, atol=1e-9)


def test_gimbal_near_the_pole_keeps_the_rotation() -> None:
    for off in (1e-3, 1e-5, 1e-7):
        rotation = g.rotation_from_gimbal(123, -90 + off, 5)
        assert_allclose(g.rotation_from_gimbal(*g.gimbal_from_rotation(rotation)), rotation, atol=1e-5)


def test_look_at() -> None:
    pose = g.look_at([10, 20, 100], [40, -20, 5])
    pixel, depth = g.project([40, -20, 5.0], g.Camera(100, 80, 90, 90, 50, 40), pose)
    assert_allclose(pixel, [50, 40], atol=1e-9)
    assert depth == pytest.approx(np.linalg.norm([30, -40, -95]))
    assert pose[2, 0] == pytest.approx(0), "level"
    down = g.look_at([0, 0, 10], [0, 0, 0])
    assert_allclose(down[:3, 2], [0, 0, -1], atol=1e-12)
    assert g.is_rotation(down[:3, :3])


def test_transform_and_invert() -> None:
    matrix = some_pose()
    matrix[:3, :3] *= 2.5
    points = np.random.default_rng(0).normal(size=(4, 5, 3))
    moved = g.transform(matrix, points)
    assert_allclose(moved[1, 2], matrix[:3, :3] @ points[1, 2] + matrix[:3, 3])
    assert_allclose(g.transform(g.invert(matrix), moved), points, atol=1e-9)


def test_is_rotation() -> None:
    assert g.is_rotation(np.eye(3))
    assert not g.is_rotation(np.diag([1, 1, -1]))
    assert not g.is_rotation(2 * np.eye(3))
    assert not g.is_rotation(np.full((3, 3), np.nan))


@pytest.mark.parametrize("far", [0.0, 5e6], ids=["local", "utm"])
def test_fit_similarity_recovers_what_was_applied(far: float) -> None:
    rng = np.random.default_rng(0)
    source = rng.normal(size=(30, 3)) * 20 + far
    wanted = np.eye(4)
    wanted[:3, :3] = 1.7 * Rotation.from_euler("xyz", [20, -40, 70], degrees=True).as_matrix()
    wanted[:3, 3] = [5, -7, 100]
    found = g.fit_similarity(source, g.transform(wanted, source))
    assert_allclose(found[:3, :3], wanted[:3, :3], atol=1e-8)
    assert_allclose(g.transform(found, source), g.transform(wanted, source), atol=1e-6)


def test_fit_similarity_hand_values_and_restrictions() -> None:
    source = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3.0]])
    target = source * 2 + [10, 20, 30]
    assert_allclose(
        g.fit_similarity(source, target), [[2, 0, 0, 10], [0, 2, 0, 20], [0, 0, 2, 30], [0, 0, 0, 1]], atol=1e-12
    )
    shift = g.fit_similarity(source, target, rotate=False, scale=False)
    assert_allclose(shift[:3, :3], np.eye(3))
    assert_allclose(shift[:3, 3], target.mean(0) - source.mean(0))
    rigid = g.fit_similarity(source, target, scale=False)
    assert np.linalg.det(rigid[:3, :3]) == pytest.approx(1)
    assert_allclose(g.fit_similarity(source, target, rotate=False), g.fit_similarity(source, target), atol=1e-12)


def test_fit_similarity_never_reflects() -> None:
    source = np.random.default_rng(1).normal(size=(10, 3))
    found = g.fit_similarity(source, source * [1, 1, -1])
    assert np.linalg.det(found[:3, :3]) > 0


def test_fit_similarity_weights() -> None:
    rng = np.random.default_rng(2)
    source = rng.normal(size=(20, 3))
    target = g.transform(some_pose(), source)
    target[:3] += 50  # three wrong pairs
    weights = np.r_[np.zeros(3), np.ones(17)]
    assert_allclose(g.fit_similarity(source, target, weights=weights), some_pose(), atol=1e-9)
    double = g.fit_similarity(source, target, weights=np.r_[2.0, np.ones(19)])
    repeated = g.fit_similarity(np.vstack([source, source[:1]]), np.vstack([target, target[:1]]))
    assert_allclose(double, repeated, atol=1e-9)


def test_fit_similarity_of_points_in_a_line_or_plane_is_a_rotation() -> None:
    """GPS tracks of one strip: the roll about the line is free, but the result stays a rotation."""
    line = np.outer(np.arange(5.0), [3, 4, 0])
    for source in (line, line + np.outer([0, 1, 0, 1, 0], [1.0, -1, 0])):
        found = g.fit_similarity(source, g.transform(some_pose(), source))
        assert g.is_rotation(found[:3, :3], 1e-6)
        assert_allclose(g.transform(found, source), g.transform(some_pose(), source), atol=1e-9)
