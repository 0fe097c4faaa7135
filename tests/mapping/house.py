"""A house on a meadow whose colours are known everywhere, photographed from above; and its true surface model."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from overfly.flights import Frame
from overfly.geometry import Array, Camera, pixel_grid, pose, rays, rotation_from_gimbal
from overfly.mapping.raster import Grid

HALF = np.array([6.0, 4.0])
"""Half the sides of the house, metres; it stands at 0, 0 with its sides along the axes."""

HEIGHT = 8.0
CAMERA = Camera(320, 240, 320.0, 320.0, 160.0, 120.0, k1=-0.05, k2=0.01)
WALL = np.array([255.0, 0.0, 255.0])
ALTITUDE = 50.0
PAINT, REACH = 0.1, 64.0


def on_roof(xy: Array) -> np.ndarray:
    return np.asarray((np.abs(xy) <= HALF).all(-1))


def height(xy: Array) -> Array:
    return np.where(on_roof(xy), HEIGHT, 0.0)


@cache
def waves() -> np.ndarray:
    """Shades with waves of 2 to 12 m, on a lattice of :data:`PAINT` metres over +- :data:`REACH` metres."""
    rng = np.random.default_rng(2)
    turn, phase = rng.uniform(0, 2 * np.pi, (2, 16))
    number = 2 * np.pi / np.geomspace(2, 12, 16)
    at = np.arange(-REACH, REACH + PAINT, PAINT)
    angle = at[None, :, None] * (number * np.cos(turn)) + at[:, None, None] * (number * np.sin(turn)) + phase
    return (6 * np.sin(angle).sum(-1)).astype(np.float32)


def color(xy: Array) -> Array:
    """The true orthophoto [H, W, 3] in 0..255: a green meadow and a red roof."""
    column, row = np.moveaxis((xy + REACH) / PAINT, -1, 0).astype(np.float32)
    shade = cv2.remap(waves(), column, row, cv2.INTER_LINEAR)[..., None]
    return np.clip(np.where(on_roof(xy)[..., None], [170.0, 60, 50], [70.0, 130, 60]) + shade, 10, 245)


@cache
def directions(camera: Camera) -> Array:
    """Of the rays of an image with twice the pixels each way, in camera axes [2 H, 2 W, 3]."""
    fine = camera.resized(2 * camera.width, 2 * camera.height)
    return rays(pixel_grid(fine.width, fine.height), fine)


def photograph(camera: Camera, world_from_camera: Array) -> np.ndarray:
    """[H, W, 3] uint8, four samples a pixel."""
    world = directions(camera) @ world_from_camera[:3, :3].T
    slope, centre = world[..., :2] / -world[..., 2:], world_from_camera[:3, 3]
    ground, above = centre[:2] + slope * centre[2], centre[:2] + slope * (centre[2] - HEIGHT)
    # The ray's way from the height of the roof to the ground, cut with the house (slab method).
    with np.errstate(divide="ignore"):
        t = np.sort(np.stack([(s * HALF - above) / (ground - above) for s in (-1, 1)]), axis=0)
    meets = (np.maximum(t[0].max(-1), 0) <= np.minimum(t[1].min(-1), 1))[..., None]
    seen = np.where(on_roof(above)[..., None], color(above), np.where(meets, WALL, color(ground)))
    small = seen.reshape(camera.height, 2, camera.width, 2, 3).mean((1, 3))
    return np.rint(small).astype(np.uint8)


@cache
def taken(i: int) -> np.ndarray:
    """The photograph of pose ``i`` of :data:`BLOCK`."""
    return photograph(CAMERA, BLOCK[i])


def nadir(x: float, y: float, yaw: float = 0.0) -> Array:
    return pose(rotation_from_gimbal(yaw, -90, 0), [x, y, ALTITUDE])


BLOCK = [nadir(x, y, yaw) for x, yaw in ((-10.0, 0.0), (0.0, 180.0), (10.0, 3.0)) for y in (-14.0, -5.0, 5.0, 14.0)]
"""Three strips of four."""


def frames(folder: Path, poses: Sequence[Array] = BLOCK, exposures: dict[int, float] | None = None) -> list[Frame]:
    """The photographs on disk; ``exposures`` of some of them are factors of their colours."""
    made = []
    for i, world_from_camera in enumerate(poses):
        path = folder / f"{i:02d}.png"
        image = taken(i) if poses is BLOCK else photograph(CAMERA, world_from_camera)
        image = np.rint(image * (exposures or {}).get(i, 1.0)).astype(np.uint8)
        cv2.imwrite(str(path), image[..., ::-1])
        made.append(Frame(path.name, path, CAMERA.width, CAMERA.height, CAMERA, world_from_camera))
    return made


def surface(cell: float = 0.25, half: float = 20.0) -> tuple[Grid, Array]:
    """The true surface model, a square of +- ``half`` metres."""
    n = round(2 * half / cell)
    grid = Grid(-half, half, cell, n, n)
    return grid, height(grid.centres())


def overview(grid: Grid, heights: Array, step: int = 4) -> tuple[Grid, Array]:
    """The surface model thinned to every ``step``-th cell."""
    rows, columns = grid.rows // step, grid.columns // step
    thin = heights[step // 2 :: step, step // 2 :: step][:rows, :columns]
    return Grid(grid.x_min, grid.y_max, step * grid.cell, rows, columns), thin
