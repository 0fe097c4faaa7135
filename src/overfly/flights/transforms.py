"""Cameras in nerfstudio's ``transforms.json``: OpenGL camera axes, camera to world, local ENU metres."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from overfly.errors import InputError, unknown
from overfly.files import replacing
from overfly.flights.flight import Frame
from overfly.flights.images import SUFFIXES
from overfly.geodesy import Origin
from overfly.geometry import OPENCV_FROM_OPENGL, Array, Camera, is_rotation

CAMERA_MODELS = ("PINHOLE", "OPENCV", "SIMPLE_PINHOLE")
INTRINSICS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "p1", "p2", "k3", "camera_angle_x", "camera_model")


@dataclass
class Cameras:
    """What a camera file holds: image name -> camera and pose (the names as in the file), and the common facts."""

    source: str
    cameras: dict[str, Camera]
    poses: dict[str, Array]
    paths: dict[str, Path] = field(default_factory=dict)
    origin: Origin | None = None
    facts: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


def read_transforms(path: Path) -> Cameras:
    """Read ``transforms.json``; see design/interfaces.md and https://docs.nerf.studio (data conventions).

    Raises:
        InputError: invalid JSON, missing or NaN values, a matrix that is no rotation, an unknown camera model, an
            image that is not there; the sentence names the frame.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not valid JSON ({error}): write the file again, or remove it.") from error
    if not isinstance(data, dict) or not isinstance(data.get("frames"), list) or not data["frames"]:
        raise InputError(f"{path} holds no frames: it needs a list 'frames' with file_path and transform_matrix.")
    result = Cameras("transforms.json", {}, {})
    for index, entry in enumerate(data["frames"]):
        where = f"Frame {index} of {path}"
        name = entry.get("file_path") if isinstance(entry, dict) else None
        if not isinstance(name, str) or not name:
            raise InputError(f"{where} has no file_path: give the image's path relative to this file.")
        where = f"Frame {index} ({name}) of {path}"
        if name in result.poses:
            raise InputError(f"{where} names an image that an earlier frame names too: remove one of them.")
        values = {key: data[key] for key in INTRINSICS if key in data}
        values |= {key: entry[key] for key in INTRINSICS if key in entry}
        result.paths[name] = _find_image(path.parent, name, where)
        result.poses[name] = _pose(entry.get("transform_matrix"), where)
        result.cameras[name] = transforms_camera(values, result.paths[name], where)
    block = data.get("overfly")
    if block is not None:
        if not isinstance(block, dict):
            raise InputError(f"'overfly' in {path} must be an object with origin, altitude and so on, all optional.")
        result.facts = dict(block)
        result.origin = _origin(block.get("origin"), path)
    return result


def _find_image(root: Path, name: str, where: str) -> Path:
    relative = Path(name.replace("\\", "/"))
    for base in (root / relative, root / "images" / relative.name):
        for candidate in (base, *(base.with_name(base.name + end) for end in (*SUFFIXES, ".JPG", ".JPEG", ".PNG"))):
            if candidate.is_file():
                return candidate
    raise InputError(f"{where} names an image that does not exist: put it there, or remove this frame from the file.")


def _pose(matrix: Any, where: str) -> Array:
    try:
        pose = np.array(matrix, dtype=float)
    except (TypeError, ValueError):
        pose = np.empty(0)
    if pose.shape == (3, 4):
        pose = np.vstack([pose, [0, 0, 0, 1]])
    if pose.shape != (4, 4):
        raise InputError(f"{where}: transform_matrix must be 4 x 4 numbers, camera to world.")
    if not np.isfinite(pose).all():
        raise InputError(f"{where}: transform_matrix holds NaN or infinity; write real numbers or remove the frame.")
    if not is_rotation(pose[:3, :3]):
        raise InputError(
            f"{where}: the upper left 3 x 3 of transform_matrix is not a rotation (determinant "
            f"{np.linalg.det(pose[:3, :3]):.3g}, rows must be orthonormal): write a rigid camera-to-world matrix."
        )
    if not np.allclose(pose[3], [0, 0, 0, 1]):
        raise InputError(f"{where}: the last row of transform_matrix must be 0, 0, 0, 1.")
    return pose @ OPENCV_FROM_OPENGL


def transforms_camera(values: dict[str, Any], image: Path | None, where: str) -> Camera:
    """A camera by its :data:`INTRINSICS`; without w and h it is as large as its image, where there is one.

    Raises:
        InputError: an unknown model, missing or NaN values; ``where`` begins the sentence.
    """
    model = values.pop("camera_model", "OPENCV")
    if model not in CAMERA_MODELS:
        raise unknown(f"{where}: the camera_model", model, CAMERA_MODELS, "Undistort the images for other lenses.")
    for key, value in values.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise InputError(f"{where}: {key}={value!r} must be a finite number.")
    if "w" not in values or "h" not in values:
        from PIL import Image

        if image is None:
            raise InputError(f"{where} has no image size: give w and h in pixels.")
        try:
            with Image.open(image) as opened:
                values["w"], values["h"] = opened.size
        except OSError as error:
            raise InputError(f"{where}: w and h are missing and the image cannot be read: give them.") from error
    w, h = int(values["w"]), int(values["h"])
    focal = values.get("fl_x")
    if focal is None and values.get("camera_angle_x"):
        focal = w / 2 / math.tan(values["camera_angle_x"] / 2)
    if (focal is not None and focal <= 0) or w <= 0 or h <= 0:
        raise InputError(f"{where}: the focal length {focal} at {w} x {h} pixels is not possible: give both above 0.")
    if focal is None:
        raise InputError(f"{where}: no focal length: give fl_x in pixels, at the top of the file or in the frame.")
    lens = {} if model != "OPENCV" else {k: float(values.get(k, 0.0)) for k in ("k1", "k2", "p1", "p2", "k3")}
    fy = values.get("fl_y", focal) if model != "SIMPLE_PINHOLE" else focal
    if fy <= 0:
        raise InputError(f"{where}: fl_y={fy} is not possible: give pixels above 0, or leave it out.")
    return Camera(w, h, float(focal), float(fy), float(values.get("cx", w / 2)), float(values.get("cy", h / 2)), **lens)


def _origin(block: Any, path: Path) -> Origin | None:
    if block is None:
        return None
    try:
        numbers = [float(block["latitude"]), float(block["longitude"]), float(block.get("height", 0.0))]
        epsg, vertical = (None if block.get(k) is None else int(block[k]) for k in ("epsg", "vertical_epsg"))
    except (TypeError, KeyError, ValueError, AttributeError) as error:
        raise InputError(f"The origin in {path} must have latitude, longitude and height as numbers.") from error
    if not all(math.isfinite(n) for n in numbers):
        raise InputError(f"The origin in {path} holds NaN or infinity: give degrees and metres.")
    return Origin(numbers[0], numbers[1], numbers[2], epsg, vertical)


def write_transforms(
    path: Path | str, frames: Iterable[Frame], origin: Origin | None, facts: Mapping[str, Any] | None = None
) -> None:
    """Write the frames that have a camera and a pose; intrinsics go to the top where all frames share them.

    Args:
        path: the JSON file; image paths are written relative to its folder.
        frames: order is kept.
        origin: of the local ENU frame; None for an unknown one.
        facts: further entries of the ``overfly`` block, plain values.
    """
    path = Path(path)
    posed = [f for f in frames if f.camera is not None and f.world_from_camera is not None]
    shared = len({f.camera for f in posed}) == 1
    data: dict[str, Any] = {}
    if shared and posed[0].camera is not None:
        data |= _intrinsics(posed[0].camera)
    data["frames"] = []
    folder = path.parent.resolve()
    for frame in posed:
        assert frame.camera is not None
        relative = Path(os.path.relpath(frame.path.resolve(), folder))
        entry: dict[str, Any] = {"file_path": relative.as_posix()}
        if not shared:
            entry |= _intrinsics(frame.camera)
        entry["transform_matrix"] = (np.asarray(frame.world_from_camera, float) @ OPENCV_FROM_OPENGL).tolist()
        data["frames"].append(entry)
    block: dict[str, Any] = dict(facts or {})
    if origin is not None:
        height = {"latitude": origin.latitude, "longitude": origin.longitude, "height": origin.height}
        crs = {"epsg": origin.crs_epsg}
        crs |= {} if origin.vertical_epsg is None else {"vertical_epsg": origin.vertical_epsg}
        block = {"origin": height | crs} | {k: v for k, v in block.items() if k != "origin"}
    if block:
        data["overfly"] = block
    text = json.dumps(data, indent=1, allow_nan=False)
    with replacing(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def _intrinsics(camera: Camera) -> dict[str, Any]:
    values: dict[str, Any] = {"camera_model": "OPENCV" if camera.is_distorted else "PINHOLE"}
    values |= {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    values |= {"w": camera.width, "h": camera.height}
    if camera.is_distorted:
        values |= {"k1": camera.k1, "k2": camera.k2, "p1": camera.p1, "p2": camera.p2}
        if camera.k3:
            values["k3"] = camera.k3
    return values
