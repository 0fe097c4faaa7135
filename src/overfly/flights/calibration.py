"""Cameras that were calibrated before: read from what programs write, and given to the frames of a flight."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from overfly.errors import InputError
from overfly.flights.colmap import read_colmap_cameras
from overfly.flights.exif import SHAPE
from overfly.flights.flight import Flight, Frame
from overfly.flights.opensfm import opensfm_camera
from overfly.flights.transforms import INTRINSICS, transforms_camera
from overfly.geometry import Camera, invertible

FILES = (
    "transforms.json",
    "sparse/0/cameras.bin",
    "sparse/0/cameras.txt",
    "sparse/cameras.bin",
    "sparse/cameras.txt",
    "cameras.bin",
    "cameras.txt",
    "reconstruction.json",
    "cameras.json",
    "camera_models.json",
)
"""Where a folder may hold cameras, in the order in which they are looked for."""


ALLOWED = (
    "Give the folder of a map or flight, a transforms.json, COLMAP's cameras.txt or .bin, OpenSfM's "
    "reconstruction.json or the cameras.json of ODM."
)


def read_calibration(path: Path | str) -> list[Camera]:
    """The different cameras in a file, or in a folder with one of :data:`FILES`: a map, a flight or a COLMAP model.

    Read are ``transforms.json`` (with or without frames), COLMAP's ``cameras.txt`` and ``.bin``, OpenSfM's
    ``reconstruction.json`` and ``camera_models.json``, and ODM's ``cameras.json``. Images need not be there.

    Raises:
        InputError: there is no such file, or it holds no camera that can be used.
    """
    asked = Path(path)
    if not asked.exists():
        raise InputError(f"--calibration {asked} does not exist: check the path. {ALLOWED}")
    file = next((asked / name for name in FILES if (asked / name).is_file()), None) if asked.is_dir() else asked
    if file is None or not file.is_file():
        raise InputError(f"--calibration {asked} holds no cameras. {ALLOWED}")
    if file.suffix not in (".txt", ".bin", ".json"):
        raise InputError(f"--calibration {asked} is no file of cameras. {ALLOWED}")
    found = list(read_colmap_cameras(file).values()) if file.suffix in (".txt", ".bin") else _of_json(file)
    cameras = list(dict.fromkeys(found))
    if not cameras:
        raise InputError(f"{file} holds no camera. {ALLOWED}")
    for camera in cameras:
        _check_lens(camera, file)
    return cameras


def with_calibration(flight: Flight, cameras: list[Camera], source: str) -> Flight:
    """The flight with the camera that fits it in every frame's ``calibration``, scaled to the frame's size.

    Raises:
        InputError: none or several of the cameras have the shape of an image.
    """
    return replace(flight, frames=[replace(f, calibration=_fitting(f, cameras, source)) for f in flight.frames])


def _fitting(frame: Frame, cameras: list[Camera], source: str) -> Camera:
    def shape_differs(camera: Camera) -> float:
        return abs(camera.width * frame.height / (camera.height * frame.width) - 1)

    same = [c for c in cameras if (c.width, c.height) == (frame.width, frame.height)]
    same = same or [c for c in cameras if shape_differs(c) <= SHAPE]
    fitting = list(dict.fromkeys(camera.resized(frame.width, frame.height) for camera in same))
    size = f"{frame.width} x {frame.height}"
    if not fitting:
        known = ", ".join(sorted({f"{c.width} x {c.height}" for c in cameras}))
        raise InputError(
            f"The calibration {source} is of images of {known}, but {frame.name} has {size}, another shape: give that "
            "of the camera as it was set, or leave --calibration out."
        )
    if len(fitting) > 1:
        raise InputError(
            f"The calibration {source} holds {len(fitting)} different cameras for images of {size}: give a file "
            "with the one that took this flight."
        )
    return fitting[0]


def _of_json(file: Path) -> list[Camera]:
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, UnicodeDecodeError) as error:
        raise InputError(f"{file} is not valid JSON ({error}): export it again, or give another file.") from error
    if isinstance(data, list):  # OpenSfM's reconstructions
        parts = [part.get("cameras") for part in data if isinstance(part, dict)]
        return [camera for part in parts if isinstance(part, dict) for camera in _opensfm(part, file)]
    if not isinstance(data, dict):
        return []
    if isinstance(data.get("frames"), list) or "fl_x" in data or "camera_angle_x" in data:
        entries = data.get("frames") or [{}]
        own = [{k: entry[k] for k in INTRINSICS if k in entry} for entry in entries if isinstance(entry, dict)]
        shared = {key: data[key] for key in INTRINSICS if key in data}
        return [transforms_camera(shared | values, None, str(file)) for values in own]
    cameras = data.get("cameras", data)
    return _opensfm(cameras, file) if isinstance(cameras, dict) else []


def _opensfm(cameras: Mapping[str, Any], file: Path) -> list[Camera]:
    known = {key: values for key, values in cameras.items() if isinstance(values, dict) and "width" in values}
    return [opensfm_camera(key, values, file) for key, values in known.items()]


def _check_lens(camera: Camera, file: Path) -> None:
    if not invertible(camera):
        raise InputError(
            f"The lens in {file} (k1={camera.k1:g}, k2={camera.k2:g}, k3={camera.k3:g}) has no inverse at the border "
            "of the image: calibrate the camera again, or leave --calibration out."
        )
