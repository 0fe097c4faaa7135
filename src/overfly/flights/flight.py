"""A flight in memory: frames with all that is known of them."""

from __future__ import annotations

import warnings
from collections.abc import Hashable
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from overfly.errors import InputError
from overfly.geodesy import Origin
from overfly.geometry import Array, Camera, rays


@dataclass(frozen=True)
class Gps:
    """A position on the Earth, degrees and metres as the file states them (its height datum is often not known).

    ``horizontal_m`` and ``vertical_m`` are the stated standard deviations, None where not stated.
    """

    latitude: float
    longitude: float
    altitude: float | None
    horizontal_m: float | None = None
    vertical_m: float | None = None


@dataclass(frozen=True, eq=False)
class Frame:
    """One image and what its file and the flight folder say about it. None means: not said.

    Attributes:
        name: path below the image folder; unique in a flight.
        path: the image file.
        width, height: pixels as stored.
        camera: calibrated camera, if the folder holds one.
        world_from_camera: [4, 4], if the folder holds it.
        gps: from geo.txt, else EXIF.
        relative_altitude: metres above the place of take-off (XMP).
        gimbal: yaw, pitch, roll in degrees (XMP), convention of :mod:`overfly.geometry`.
        time: when it was taken.
        focal_mm, focal35_mm: focal length, and the one with the same field of view on 36 x 24 mm film.
        focal_px: focal length in pixels from the EXIF focal-plane tags.
        orientation: the EXIF tag; pixels are always used as stored, so it is never applied.
        calibration: camera that was calibrated before and that an estimation of poses keeps.
        lens: camera that the file tells with its distortion (DJI's DewarpData): where a calibration starts.
    """

    name: str
    path: Path
    width: int
    height: int
    camera: Camera | None = None
    world_from_camera: Array | None = None
    gps: Gps | None = None
    relative_altitude: float | None = None
    gimbal: tuple[float, float, float] | None = None
    time: datetime | None = None
    make: str | None = None
    model: str | None = None
    focal_mm: float | None = None
    focal35_mm: float | None = None
    focal_px: float | None = None
    orientation: int = 1
    calibration: Camera | None = None
    lens: Camera | None = None

    @property
    def camera_key(self) -> Hashable:
        """Frames with equal keys were taken by the same camera at the same settings and may share a calibration."""
        known = (self.focal_mm, self.focal35_mm, self.camera)
        lens = () if self.known_lens is None else (self.calibration, self.lens)
        return (self.make, self.model, self.width, self.height, *known, *lens)

    @property
    def known_lens(self) -> Camera | None:
        """The camera that is known before any is estimated: the calibration, else the lens that the file tells."""
        return self.calibration or self.lens

    @property
    def pinhole(self) -> Camera | None:
        """The camera without distortion, centred and with one focal length, that stands for the one that is told."""
        if (lens := self.known_lens) is None:
            return None
        focal = float(np.sqrt(lens.fx * lens.fy))
        return Camera(self.width, self.height, focal, focal, self.width / 2, self.height / 2)

    def straight(self, pixels: NDArray) -> Array:
        """Pixels [..., 2] of the image as its :attr:`pinhole` would show them; as they are where nothing is told."""
        pinhole, lens = self.pinhole, self.known_lens
        if pinhole is None or lens is None:
            return np.asarray(pixels)
        return rays(pixels, lens)[..., :2] * pinhole.fx + [pinhole.cx, pinhole.cy]

    def image(self) -> NDArray[np.uint8]:
        """The pixels [H, W, 3] RGB exactly as stored: the Orientation tag is not applied.

        Raises:
            InputError: the file cannot be decoded.
        """
        from PIL import Image

        try:
            with warnings.catch_warnings(), Image.open(self.path) as image:
                warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # aerial cameras exceed 90 Mpx
                if image.mode in ("I;16", "I;16B", "I;16L", "I"):
                    values = np.asarray(image, np.float64)
                    gray = np.clip(values / 256, 0, 255).astype(np.uint8)
                    return np.repeat(gray[..., None], 3, axis=-1)
                return np.asarray(image.convert("RGB"))
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
            raise InputError(
                f"The image {self.path} cannot be decoded ({error}): copy it again from the drone, or remove it."
            ) from error


@dataclass(frozen=True)
class ControlPoint:
    """A ground control point: a surveyed place and the pixels at which frames see it.

    Attributes:
        position: x, y, z in ``crs`` (for a geographic CRS: longitude, latitude, height).
        crs: as written in the file: EPSG code, PROJ string or "WGS84 UTM 16N".
        pixels: frame name -> (u, v) as written in the file.
    """

    name: str
    position: tuple[float, float, float]
    crs: str
    pixels: dict[str, tuple[float, float]]


@dataclass(frozen=True, eq=False)
class Flight:
    """The frames of one flight in their order, and the folder's common facts.

    Attributes:
        root: the folder.
        origin: where the world frame of the cameras stands; None where it is unknown or there are no cameras.
        cameras_from: "transforms.json", "sparse/0" or "reconstruction.json"; None without cameras.
        facts: the ``overfly`` block of transforms.json; ``located``: how cameras of a model came to the images' GPS.
        warnings: sentences for the user, each once.
        skipped: image files that could not be used, with the reason.
        reference: reference cloud in the cameras' frame.
        gcps: ground control points.
    """

    root: Path
    frames: list[Frame]
    origin: Origin | None = None
    cameras_from: str | None = None
    facts: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    skipped: dict[str, str] = field(default_factory=dict)
    reference: Path | None = None
    gcps: list[ControlPoint] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def has_cameras(self) -> bool:
        """Whether every frame has a camera and a pose."""
        return all(f.camera is not None and f.world_from_camera is not None for f in self.frames)

    def camera_groups(self) -> dict[Hashable, list[int]]:
        """Indices of the frames that share a camera, by :attr:`Frame.camera_key`."""
        groups: dict[Hashable, list[int]] = {}
        for i, frame in enumerate(self.frames):
            groups.setdefault(frame.camera_key, []).append(i)
        return groups

    def gps_origin(self) -> Origin | None:
        """An origin in the middle of the frames' GPS positions, height 0 where no altitude is known; None without."""
        known = [f.gps for f in self.frames if f.gps is not None]
        if not known:
            return None
        heights = [g.altitude for g in known if g.altitude is not None]
        return Origin(
            float(np.median([g.latitude for g in known])),
            float(np.median([g.longitude for g in known])),
            float(np.median(heights)) if heights else 0.0,
        )
