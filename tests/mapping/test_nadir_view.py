"""Tilted images as seen from straight above, and the key points that are found in them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from overfly.flights import Frame
from overfly.geometry import Camera, on_plane, pixel_grid, pose, project, rotation_from_gimbal
from overfly.mapping.features import features
from overfly.mapping.nadir_view import nadir_view

CAMERA = Camera(640, 480, 480.0, 480.0, 320.0, 240.0)
GROUND = np.random.default_rng(0).uniform(0, 255, (512, 512)).astype(np.float32)
"""A level ground of 400 x 400 m."""


def photo(world_from_camera: np.ndarray) -> np.ndarray:
    """What a camera sees of the ground, gray [H, W]."""
    places = on_plane(pixel_grid(640, 480), CAMERA, world_from_camera, 0.0)[..., :2]
    at = ((places + 200) / 400 * 512 - 0.5).astype(np.float32)
    smooth = cv2.GaussianBlur(GROUND, (0, 0), 1.5)
    stretched = (smooth - smooth.mean()) / smooth.std() * 50 + 128
    return np.clip(cv2.remap(stretched, at[..., 0], at[..., 1], cv2.INTER_LINEAR), 0, 255).astype(np.uint8)


def tilted(yaw: float, tilt: float) -> np.ndarray:
    """A camera 100 m up that looks at the origin."""
    back = 100 * np.tan(np.radians(tilt))
    place = (-back * np.sin(np.radians(yaw)), -back * np.cos(np.radians(yaw)), 100.0)
    return pose(rotation_from_gimbal(yaw, tilt - 90), place)


def test_level_ground_keeps_its_shape() -> None:
    """Distances on the ground are the same everywhere in the view, and pixels come back to where they were."""
    at = tilted(40.0, 40.0)
    view = nadir_view(photo(at), (40.0, -50.0, 0.0), 480.0)
    assert view is not None
    rows, columns = np.nonzero(view.mask)
    chosen = np.random.default_rng(1).permutation(len(rows))[:200]
    pixels = np.column_stack([columns, rows])[chosen] + 0.5
    own = view.in_image(pixels)
    assert ((own > 0) & (own < (640, 480))).all()
    places = on_plane(own, CAMERA, at, 0.0)[:, :2]
    apart = np.linalg.norm(pixels[1:] - pixels[:-1], axis=1) / np.linalg.norm(places[1:] - places[:-1], axis=1)
    assert np.ptp(apart) < 1e-6 * apart.mean()


@pytest.mark.parametrize("tilt", [0.0, 10.0, 70.0, 95.0])
def test_images_that_look_down_or_along_the_horizon_stay_as_they_are(tilt: float) -> None:
    assert nadir_view(np.zeros((48, 64), np.uint8), (0.0, tilt - 90, 0.0), 48.0) is None


def test_the_view_is_not_larger_than_it_may_be() -> None:
    view = nadir_view(np.zeros((480, 640), np.uint8), (0.0, -35.0, 0.0), 480.0)
    assert view is not None
    assert view.image.size <= 4.01 * 480 * 640
    assert view.image.shape == view.mask.shape


def right_matches(folder: Path, gimbals: bool) -> int:
    """Matches of two photos of one ground from sides 70 degrees apart that are right to 2 pixels."""
    poses, found = [tilted(0.0, 45.0), tilted(70.0, 45.0)], []
    for name, yaw, at in zip("ab", (0.0, 70.0), poses, strict=True):
        Image.fromarray(np.repeat(photo(at)[..., None], 3, axis=2)).save(folder / f"{name}.png")
        gimbal = (yaw + 1.0, -46.0, 0.5) if gimbals else None
        frame = Frame(f"{name}.png", folder / f"{name}.png", 640, 480, gimbal=gimbal, focal_px=480.0)
        kept = folder / f"features_{gimbals}"
        kept.mkdir(exist_ok=True)
        found.append(features(frame, kept))
    matcher = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True)
    pairs = matcher.match(*(d.astype(np.float32) for _, d in found))
    first = found[0][0][[m.queryIdx for m in pairs]]
    second = found[1][0][[m.trainIdx for m in pairs]]
    there, _ = project(on_plane(first, CAMERA, poses[0], 0.0), CAMERA, poses[1])
    return int((np.linalg.norm(there - second, axis=1) < 2).sum())


def test_key_points_are_found_again_from_another_side(tmp_path: Path) -> None:
    with_view, without = right_matches(tmp_path, True), right_matches(tmp_path, False)
    assert with_view > 200
    assert with_view > 5 * without
