"""Cameras, poses and pixels of small flights."""

from __future__ import annotations

import numpy as np

from overfly.geodesy import Origin
from overfly.geometry import Camera, pose, rotation_from_gimbal

CAMERA = Camera(64, 48, 50.0, 50.0, 32.0, 24.0)
ORIGIN = Origin(46.0, 8.0, 450.0)


def some_poses(n: int) -> list[np.ndarray]:
    rng = np.random.default_rng(5)
    low, high = [0, -90, -5], [360, -50, 5]
    return [pose(rotation_from_gimbal(*rng.uniform(low, high).tolist()), 50 * rng.normal(size=3)) for _ in range(n)]


def textured(seed: int, height: int = 48, width: int = 64) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3), dtype=np.uint8)
