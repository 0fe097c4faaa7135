"""The window frame puts points where the cameras saw them, and back to the metre."""

from __future__ import annotations

import numpy as np
import pytest

from overfly.data.footprints import footprint
from overfly.data.windows import (
    resample,
    source_pixels,
    to_window,
    to_world,
    window_camera,
    window_frame,
    window_sample,
)
from overfly.errors import InputError
from overfly.geometry import Camera, pose, project, rotation_from_gimbal, transform

LENS = Camera(1600, 1200, 1100.0, 1105.0, 812.0, 590.0, k1=-0.09, k2=0.04, p1=0.001, p2=-0.002)
SQUARE = Camera(1000, 1000, 900, 900, 500, 500)
PINCUSHION = Camera(800, 600, 700, 700, 400, 300, k1=0.1)


def nadir(x: float, y: float, z: float, yaw: float = 0.0, pitch: float = -90.0) -> np.ndarray:
    return pose(rotation_from_gimbal(yaw, pitch), [x, y, z])


def test_footprint_of_a_nadir_camera_spans_one_unit_each_way_in_x() -> None:
    camera = Camera.from_fov(128, 96, 60)
    for yaw in (0, 37, 200):
        world_from_camera = nadir(1000, -500, 160, yaw)
        world_from_window, scale = window_frame(camera, world_from_camera, 10.0)
        assert scale == pytest.approx(150 * np.tan(np.radians(30)))
        outline = np.column_stack([footprint(camera, world_from_camera, 10.0), np.full(4, 10.0)])
        corners = to_window(outline, world_from_window, scale)
        # top left, top right, bottom right, bottom left of the image: x right, y forward
        np.testing.assert_allclose(corners, [[-1, 0.75, 0], [1, 0.75, 0], [1, -0.75, 0], [-1, -0.75, 0]], atol=1e-9)


def test_window_axes_follow_the_heading() -> None:
    world_from_window, _ = window_frame(Camera.from_fov(64, 64, 50), nadir(0, 0, 100, 90), 0.0)
    np.testing.assert_allclose(world_from_window[:3, 1], [1, 0, 0], atol=1e-12)  # flying east: forward is east
    np.testing.assert_allclose(world_from_window[:3, 2], [0, 0, 1])


def test_ten_metres_stay_ten_metres() -> None:
    rng = np.random.default_rng(0)
    world = rng.uniform([5e5, 5e6, 90], [5e5 + 10, 5e6 + 10, 100], (50, 3))
    frame, scale = window_frame(Camera.from_fov(64, 48, 70), nadir(5e5, 5e6, 200, 33, -60), 90.0)
    back = to_world(to_window(world, frame, scale), frame, scale)
    np.testing.assert_allclose(back, world, atol=1e-8)
    edges = np.linalg.norm(np.diff(to_window(world, frame, scale), axis=0), axis=1) * scale
    np.testing.assert_allclose(edges, np.linalg.norm(np.diff(world, axis=0), axis=1), rtol=1e-9)


@pytest.mark.parametrize(
    "lens", [LENS, Camera(1000, 1000, 900, 900, 500, 500), Camera(800, 600, 700, 700, 400, 300, k1=0.1)]
)
@pytest.mark.parametrize("size", [(128, 128), (256, 192), (96, 160)])
def test_a_world_point_has_one_pixel_in_the_original_and_in_the_window(lens: Camera, size: tuple[int, int]) -> None:
    world_from_camera = nadir(30, 40, 150, 25, -75)
    pinhole = window_camera(lens, *size)
    assert (pinhole.width, pinhole.height) == size
    assert not pinhole.is_distorted
    frame, scale = window_frame(pinhole, world_from_camera, 3.0)
    sample, frame_again = window_sample(
        [np.zeros((size[1], size[0], 3), np.uint8)], [pinhole], [world_from_camera], 3.0
    )
    np.testing.assert_array_equal(frame, frame_again)
    points = np.random.default_rng(1).uniform([-0.4, -0.4, 0], [0.4, 0.4, 0.2], (40, 3))
    world = to_world(points, frame, scale)
    # Through the sample's own matrices, as a network projects:
    local = transform(sample["camera_from_window"][0], points)
    pixels = (local / local[:, 2:]) @ sample["intrinsics"][0].T
    np.testing.assert_allclose(local[:, 2] * scale, project(world, lens, world_from_camera)[1], rtol=1e-5)
    # ... and through the original lens: the same place in the source image.
    np.testing.assert_allclose(
        source_pixels(pixels[:, :2], pinhole, lens), project(world, lens, world_from_camera)[0], atol=0.02
    )


def test_window_camera_keeps_inside_a_pincushion_and_uses_the_whole_width() -> None:
    bent = PINCUSHION
    corners = source_pixels([[0, 0], [128, 96]], window_camera(bent, 128, 96), bent)
    assert (corners >= -1e-6).all()
    assert (corners <= [800.001, 600.001]).all()
    straight = window_camera(Camera(800, 600, 700, 700, 400, 300), 100, 100)
    np.testing.assert_allclose(straight.fx, 700 / 6)
    np.testing.assert_allclose(straight.cx, 50)


def test_resample_shows_the_same_world() -> None:
    """A smooth picture painted on the ground, seen through the lens, then resampled: equal to seeing it directly."""
    from overfly.geometry import on_plane, pixel_grid

    def paint(camera: Camera) -> np.ndarray:
        ground = on_plane(pixel_grid(camera.width, camera.height), camera, nadir(0, 0, 100, 10, -80), 0.0)
        waves = 127 + 100 * np.sin(ground[..., 0] / 9) * np.cos(ground[..., 1] / 7)
        return np.repeat(waves[..., None], 3, -1).astype(np.uint8)

    lens = LENS.resized(800, 600)
    pinhole = window_camera(lens, 128, 128)
    seen, expected = resample(paint(lens), lens, pinhole), paint(pinhole)
    assert seen.shape == (128, 128, 3)
    assert np.abs(seen.astype(int) - expected).max() <= 3
    with pytest.raises(InputError, match="own camera"):
        resample(np.zeros((10, 10, 3), np.uint8), lens, pinhole)


def test_sample_has_the_contracts_shapes() -> None:
    pinhole = Camera.from_fov(32, 24, 60)
    poses = np.stack([nadir(0, 0, 100), nadir(0, 30, 100), nadir(20, 0, 110, 180)])
    images = [np.full((24, 32, 3), v, np.uint8) for v in (0, 128, 255)]
    priors = poses.copy()
    priors[:, 0, 3] += 1.0
    sample, frame = window_sample(images, [pinhole] * 3, poses, 0.0, prior_world_from_camera=priors)
    shapes = {k: v.shape for k, v in sample.items()}
    assert shapes == {
        "images": (3, 3, 24, 32), "intrinsics": (3, 3, 3), "camera_from_window": (3, 4, 4),
        "prior_from_window": (3, 4, 4), "overlaps": (3, 3), "scale": (), "gsd": (), "altitude": (),
            "height_range": (2,),
    }  # fmt: skip
    assert all(v.dtype == np.float32 for v in sample.values())
    assert sample["images"][2].max() == 1
    assert float(sample["altitude"]) == 100
    assert float(sample["gsd"]) == pytest.approx(2 * 100 * np.tan(np.radians(30)) / 32)
    np.testing.assert_allclose(frame[:3, 3], [0, 0, 0], atol=1e-9)
    shift = sample["prior_from_window"][0] - sample["camera_from_window"][0]
    np.testing.assert_allclose(np.abs(shift[:3, 3]).max() * sample["scale"], 1.0, rtol=1e-5)


def test_a_camera_under_the_ground_is_refused() -> None:
    with pytest.raises(InputError, match="sees no ground"):
        window_frame(Camera.from_fov(32, 32, 60), nadir(0, 0, 5), 10.0)
