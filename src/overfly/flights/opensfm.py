"""Cameras of OpenSfM's and ODM's ``reconstruction.json``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from overfly.errors import InputError, unknown
from overfly.flights.transforms import Cameras
from overfly.geodesy import Origin
from overfly.geometry import Camera, invert, pose

PROJECTIONS = ("perspective", "brown", "simple_radial", "radial")


def read_reconstruction(path: Path) -> Cameras:
    """Read the largest reconstruction of the file; poses are camera-from-world rotation vectors and translations.

    Intrinsics are in units of the larger image side, the principal point relative to the image's middle
    (https://opensfm.org/docs/geometry.html). With ``reference_lla`` the world is local ENU there.

    Raises:
        InputError: invalid JSON, missing or NaN values, another projection.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not valid JSON ({error}): export it again, or remove it.") from error
    parts = [p for p in (data if isinstance(data, list) else [data]) if isinstance(p, dict) and p.get("shots")]
    if not parts:
        raise InputError(f"{path} holds no shots: run the reconstruction again, or remove the file.")
    part = max(parts, key=lambda p: len(p["shots"]))
    result = Cameras("reconstruction.json", {}, {})
    if len(parts) > 1:
        lost = sum(len(p["shots"]) for p in parts) - len(part["shots"])
        result.warnings.append(
            f"reconstruction.json has {len(parts)} separate parts; the largest ({len(part['shots'])} images) is used, "
            f"{lost} images of the others have no camera."
        )
    cameras = {key: opensfm_camera(key, values, path) for key, values in part.get("cameras", {}).items()}
    for name, shot in part["shots"].items():
        try:
            camera = cameras[shot["camera"]]
            rotation = Rotation.from_rotvec(np.array(shot["rotation"], float)).as_matrix()
            camera_from_world = pose(rotation, np.array(shot["translation"], float))
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"Shot {name} of {path} is broken ({error!r}): export the file again.") from error
        if not np.isfinite(camera_from_world).all():
            raise InputError(f"Shot {name} of {path} holds NaN or infinity: export the file again.")
        result.cameras[name], result.poses[name] = camera, invert(camera_from_world)
    lla = part.get("reference_lla")
    if isinstance(lla, dict):
        result.origin = Origin(float(lla["latitude"]), float(lla["longitude"]), float(lla.get("altitude", 0.0)))
    return result


def opensfm_camera(key: str, values: dict[str, Any], path: Path) -> Camera:
    """A camera as OpenSfM and ODM write it, in pixels; intrinsics as in :func:`read_reconstruction`.

    Raises:
        InputError: another projection; missing, wrong or NaN values.
    """
    projection = values.get("projection_type", "perspective")
    if projection not in PROJECTIONS:
        raise unknown(f"{path}: the projection of camera {key!r}", projection, PROJECTIONS)
    try:
        width, height = int(values["width"]), int(values["height"])
        size = max(width, height)
        fx = float(values["focal_x"] if "focal_x" in values else values["focal"])
        fy = float(values.get("focal_y", fx))
        cx, cy = float(values.get("c_x", 0.0)), float(values.get("c_y", 0.0))
        lens = {k: float(values.get(k, 0.0)) for k in ("k1", "k2", "p1", "p2", "k3")}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"Camera {key!r} of {path} is broken ({error!r}): export the file again.") from error
    if min(fx, fy, width, height) <= 0:
        raise InputError(f"Camera {key!r} of {path} has the focal length {fx:g} at {width} x {height}: give both > 0.")
    camera = Camera(width, height, fx * size, fy * size, cx * size + width / 2, cy * size + height / 2, **lens)
    if not np.isfinite(list(camera.to_dict().values())).all():
        raise InputError(f"Camera {key!r} of {path} holds NaN or infinity: export the file again.")
    return camera
