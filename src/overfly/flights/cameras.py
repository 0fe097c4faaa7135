"""Real drone cameras: sensor, focal length and names, and the pinhole camera of an image of any size from them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from overfly.errors import InputError, unknown
from overfly.geometry import Camera

FULL_FRAME_DIAGONAL_MM = math.hypot(36.0, 24.0)


@dataclass(frozen=True)
class CameraPreset:
    """What the maker states of a camera.

    Attributes:
        make, model: as they stand in EXIF.
        focal_mm: focal length.
        sensor_mm: width and height of the sensor.
        pixels: width and height of its largest image.
    """

    name: str
    make: str
    model: str
    focal_mm: float
    sensor_mm: tuple[float, float]
    pixels: tuple[int, int]

    def camera(self, width: int | None = None, height: int | None = None) -> Camera:
        """The ideal pinhole of an image ``width`` x ``height``; its lens can be set with ``dataclasses.replace``.

        One of the two alone keeps the sensor's aspect. Both together cut the largest image of that aspect out of the
        sensor's middle, as drones do for 16:9, and resample it.

        Raises:
            InputError: a size under 16 pixels or over 100000.
        """
        full_w, full_h = self.pixels
        if width is None and height is None:
            width, height = full_w, full_h
        w = width if width is not None else round((height or 0) * full_w / full_h)
        h = height if height is not None else round(w * full_h / full_w)
        for what, size in (("width", w), ("height", h)):
            if isinstance(size, bool) or not isinstance(size, int) or not 16 <= size <= 100_000:
                raise InputError(f"The image {what} {size!r} is not allowed: give whole pixels from 16 to 100000.")
        # Of two sides one rules; where only one was given, the other is rounded by a fraction of a pixel.
        scale = w / full_w if width is None or height is None else max(w / full_w, h / full_h)
        focal = self.focal_mm / self.sensor_mm[0] * full_w * scale
        return Camera(w, h, focal, focal, w / 2, h / 2)


def focal35_mm(camera: Camera) -> float:
    """The focal length at which a 36 x 24 mm film has the same diagonal field of view as this image."""
    return camera.fx * FULL_FRAME_DIAGONAL_MM / math.hypot(camera.width, camera.height)


CAMERAS: dict[str, CameraPreset] = {
    preset.name: preset
    for preset in (
        CameraPreset("phantom3", "DJI", "FC300S", 3.61, (6.16, 4.62), (4000, 3000)),
        CameraPreset("phantom4", "DJI", "FC330", 3.61, (6.17, 4.63), (4000, 3000)),
        CameraPreset("p4p", "DJI", "FC6310", 8.8, (13.2, 8.8), (5472, 3648)),
        CameraPreset("mavic2pro", "Hasselblad", "L1D-20c", 10.3, (13.2, 8.8), (5472, 3648)),
        CameraPreset("mavic3e", "DJI", "M3E", 12.3, (17.3, 13.0), (5280, 3956)),
        CameraPreset("p1", "DJI", "ZenmuseP1", 35.0, (35.9, 24.0), (8192, 5460)),
    )
}
"""Sensor widths: COLMAP's table src/colmap/sensor/specs.cc; focal lengths and sizes: the makers' data sheets."""


def find_preset(name: str) -> CameraPreset:
    """The preset called ``name``, or whose EXIF model is ``name``; capitals do not matter.

    Raises:
        InputError: no such camera.
    """
    for preset in CAMERAS.values():
        if str(name).lower() in (preset.name, preset.model.lower()):
            return preset
    raise unknown("The camera", name, CAMERAS)


def camera_preset(name: str, width: int | None = None, height: int | None = None) -> Camera:
    """The camera of a preset at an image size, see :meth:`CameraPreset.camera`."""
    return find_preset(name).camera(width, height)
