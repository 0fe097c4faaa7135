"""Small flights over a textured plain, whose every overlap, shift and height is known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from overfly.flights.write import frame_name, true_stamp, write_frame
from overfly.geodesy import Origin
from overfly.geometry import Camera, pose, rotation_from_gimbal

CAMERA = Camera(160, 120, 128.0, 128.0, 80.0, 60.0)
ALTITUDE = 48.0
GSD = ALTITUDE / CAMERA.fx  # 0.375 m: a footprint of 60 x 45 m
ORIGIN = Origin(46.0, 8.0, 450.0)
STEP, SPACING = 9.0, 24.0  # 80 % along, 60 % between the lines


def ground() -> np.ndarray:
    """[H, W] grey: fine and coarse texture."""
    rng = np.random.default_rng(0)
    fine = rng.normal(size=(1300, 1300)).astype(np.float32)
    texture = sum(cv2.GaussianBlur(fine, (0, 0), s) * s for s in (0.7, 2.0, 6.0))
    assert isinstance(texture, np.ndarray)
    return np.clip(128 + 45 * texture / texture.std(), 0, 255).astype(np.uint8)


def photograph(texture: np.ndarray, x: float, y: float) -> np.ndarray:
    """[H, W, 3] straight down at x, y, north up."""
    column, row = round(650 + x / GSD), round(650 - y / GSD)
    w, h = CAMERA.width // 2, CAMERA.height // 2
    return np.repeat(texture[row - h : row + h, column - w : column + w, None], 3, axis=2)


def grid(
    lines: Sequence[float] = (0, 1, 2), count: int = 8, step: float = STEP, spacing: float = SPACING
) -> np.ndarray:
    """x, y of images on lines to the north and back [n, 2]."""
    places = []
    for k, line in enumerate(lines):
        along = np.arange(count) * step - (count - 1) * step / 2
        places += [(line * spacing - spacing, y) for y in (along if k % 2 == 0 else along[::-1])]
    return np.array(places)


def write(
    root: Path,
    places: np.ndarray,
    *,
    change: Callable[[int, np.ndarray], np.ndarray] | None = None,
    model: Callable[[int], str] | None = None,
    gps: bool = True,
) -> Path:
    """A plain folder of photographs with EXIF and XMP, and no cameras beside them."""
    texture = ground()
    down = rotation_from_gimbal(0, -90)
    for i, (x, y) in enumerate(places):
        image = photograph(texture, x, y)
        image = change(i, image) if change is not None else image
        where = pose(down, [x, y, ALTITUDE])
        stamp = true_stamp(where, 0.0, ORIGIN if gps else None)
        stamp = replace(stamp, model=model(i)) if model is not None else stamp
        write_frame(root / frame_name(i), image, CAMERA, where, stamp, 3 * i)
    return root
