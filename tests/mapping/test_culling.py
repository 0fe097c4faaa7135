"""Leaving out what a frame cannot see never leaves out what it sees."""

from __future__ import annotations

import numpy as np
import pytest

from overfly.geometry import Camera, pose, project, rotation_from_gimbal
from overfly.mapping.culling import Groups

CAMERA = Camera(400, 300, 350.0, 360.0, 190.0, 155.0)


@pytest.mark.parametrize("gimbal", [(0, -90, 0), (30, -45, 5), (120, -10, -8), (10, 80, 0)])
def test_every_point_inside_the_image_stays_and_most_others_go(gimbal: tuple[float, float, float]) -> None:
    points = np.random.default_rng(0).uniform([-500, -500, 0], [500, 500, 30], (40_000, 3))
    world_from_camera = pose(rotation_from_gimbal(*gimbal), [20.0, -30.0, 100.0])
    near = points[Groups(points).near(CAMERA, world_from_camera)]

    def inside(some: np.ndarray) -> np.ndarray:
        pixels, _ = project(some, CAMERA, world_from_camera)
        with np.errstate(invalid="ignore"):
            return some[((pixels > 0) & (pixels < [CAMERA.width, CAMERA.height])).all(1)]

    np.testing.assert_array_equal(inside(near), inside(points))
    if gimbal[1] == -90:
        assert 500 < len(near) < 3000  # of them about 500 are inside


def test_few_points_and_none() -> None:
    world_from_camera = pose(rotation_from_gimbal(0, -90), [0, 0, 50.0])
    assert len(Groups(np.zeros((0, 3))).near(CAMERA, world_from_camera)) == 0
    one = np.array([[1.0, 2.0, 3.0]])
    np.testing.assert_array_equal(Groups(one).near(CAMERA, world_from_camera), [0])
