"""A recorded flight over an analytic landscape: a tilted plane with a step, so that every true value is known."""

from __future__ import annotations

import numpy as np

from overfly.data.record import Record
from overfly.geometry import Camera, pixel_grid, pose, rays, rotation_from_gimbal

CAMERA = Camera.from_fov(32, 24, 70)


def surface(xy: np.ndarray) -> np.ndarray:
    """A plane that rises eastwards by 5 %."""
    return 0.05 * xy[..., 0]


def depth_of(world_from_camera: np.ndarray) -> np.ndarray:
    """Depth [H, W] of that plane: z = 0.05 x along each ray."""
    eye = world_from_camera[:3, 3]
    direction = rays(pixel_grid(CAMERA.width, CAMERA.height), CAMERA) @ world_from_camera[:3, :3].T
    return (0.05 * eye[0] - eye[2]) / (direction[..., 2] - 0.05 * direction[..., 0])


def make_record(frames: int = 6, scene: int = 3) -> Record:
    poses = [pose(rotation_from_gimbal(0, -90), [0, 30.0 * i - 75, 100]) for i in range(frames)]
    cell = 2.0
    centres = np.arange(-300, 300, cell) + cell / 2
    heights = surface(np.stack(np.meshgrid(centres, centres[::-1]), axis=-1)).astype(np.float32)
    rng = np.random.default_rng(0)
    return Record(
        images=rng.integers(0, 255, (frames, CAMERA.height, CAMERA.width, 3)).astype(np.uint8),
        depth=np.stack([depth_of(p) for p in poses]).astype(np.float32),
        world_from_camera=np.stack(poses),
        cameras=[CAMERA] * frames,
        strips=np.zeros(frames, np.int64),
        heights=heights,
        corner=(-300.0, 300.0, cell),
        ground_height=0.0,
        facts={"scene": scene, "style": "plane"},
    )
