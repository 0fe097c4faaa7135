"""Cameras of a COLMAP model, text or binary (format: https://colmap.github.io/format.html)."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import numpy as np
from scipy.spatial.transform import Rotation

from overfly.errors import InputError, unknown
from overfly.flights.transforms import Cameras
from overfly.geometry import Array, Camera, invert, pose

MODELS: dict[str, tuple[int, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": (0, ("f", "cx", "cy")),
    "PINHOLE": (1, ("fx", "fy", "cx", "cy")),
    "SIMPLE_RADIAL": (2, ("f", "cx", "cy", "k1")),
    "RADIAL": (3, ("f", "cx", "cy", "k1", "k2")),
    "OPENCV": (4, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    "FULL_OPENCV": (6, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
}
"""COLMAP's name -> id and parameters, in COLMAP's order, by the names of :class:`Camera` (f: both focal lengths)."""


def read_colmap(folder: Path, source: str = "sparse/0") -> Cameras:
    """Cameras and poses of the model in ``folder``; the world is the model's own frame, unchanged.

    Raises:
        InputError: files missing or broken, a camera model that :class:`Camera` cannot hold.
    """
    binary = (folder / "cameras.bin", folder / "images.bin")
    text = (folder / "cameras.txt", folder / "images.txt")
    if all(f.is_file() for f in binary):
        files, read_images = binary, _binary_images
    elif all(f.is_file() for f in text):
        files, read_images = text, _text_images
    else:
        raise InputError(f"{folder} is no COLMAP model: it needs cameras.bin and images.bin, or both as .txt.")
    cameras = read_colmap_cameras(files[0])
    result = Cameras(source, {}, {})
    with _sentence(files[1]):
        for camera_id, name, camera_from_world in read_images(files[1]):
            result.cameras[name] = cameras[camera_id]
            result.poses[name] = invert(camera_from_world)
    if not result.poses:
        raise InputError(f"{files[1]} holds no images: run the reconstruction again, or remove the model.")
    return result


def read_colmap_cameras(file: Path) -> dict[int, Camera]:
    """The cameras in ``cameras.bin`` or ``cameras.txt`` by their numbers.

    Raises:
        InputError: the file is broken, or of a camera model that :class:`Camera` cannot hold.
    """
    with _sentence(file):
        return _binary_cameras(file) if file.suffix == ".bin" else _text_cameras(file)


def read_colmap_points(folder: Path) -> Array:
    """The points [M, 3] of the model in ``folder``, in its own frame; none where it has no file of them.

    Raises:
        InputError: the file is broken.
    """
    binary, text = folder / "points3D.bin", folder / "points3D.txt"
    if binary.is_file():
        with _sentence(binary):
            return _binary_points(binary.read_bytes())
    if text.is_file():
        with _sentence(text):
            lines = [line for line in text.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
            return np.array([[float(v) for v in line.split()[1:4]] for line in lines if line.strip()]).reshape(-1, 3)
    return np.zeros((0, 3))


def _binary_points(data: bytes) -> Array:
    """Number, place, colour, error and track (image, observation) of each point, one after the other."""
    places, at = [], 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        places.append(struct.unpack_from("<3d", data, at + 8))
        at += 51 + 8 * struct.unpack_from("<Q", data, at + 43)[0]
    return np.array(places).reshape(-1, 3)


@contextmanager
def _sentence(path: Path) -> Iterator[None]:
    try:
        yield
    except (ValueError, struct.error, IndexError, KeyError, TypeError) as error:
        raise InputError(f"{path} is broken ({error!r}): export the COLMAP model again, or remove it.") from error


def _camera(model: str, width: int, height: int, parameters: list[float], path: Path) -> Camera:
    if model not in MODELS:
        raise unknown(f"{path}: the camera model", model, MODELS, "Undistort the images with COLMAP first.")
    names = MODELS[model][1]
    if len(parameters) != len(names):
        raise ValueError(f"{model} has {len(names)} parameters, not {len(parameters)}")
    if not np.isfinite(parameters).all():
        raise ValueError("NaN or infinity")
    values = dict(zip(names, parameters, strict=True))
    rational = [values.pop(k, 0.0) for k in ("k4", "k5", "k6")]
    if any(rational):
        raise InputError(f"{path}: FULL_OPENCV with k4, k5, k6 is not supported: undistort the images with COLMAP.")
    if "f" in values:
        values["fx"] = values["fy"] = values.pop("f")
    if min(values["fx"], values["fy"], width, height) <= 0:
        raise InputError(
            f"{path}: a camera has the focal length {values['fx']:g} at {width} x {height}: give pixels > 0."
        )
    return Camera(width, height, **values)


def _pose(quaternion: list[float], translation: list[float]) -> Array:
    w, x, y, z = quaternion
    if not np.isfinite([*quaternion, *translation]).all():
        raise ValueError("NaN or infinity")
    return pose(Rotation.from_quat([x, y, z, w]).as_matrix(), translation)


def _text_cameras(path: Path) -> dict[int, Camera]:
    cameras = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.strip() and not line.startswith("#"):
            number, model, width, height, *rest = line.split()
            cameras[int(number)] = _camera(model, int(width), int(height), [float(v) for v in rest], path)
    return cameras


def _text_images(path: Path) -> Iterator[tuple[int, str, Array]]:
    for line in path.read_text(encoding="utf-8").splitlines():
        fields = line.split(maxsplit=9)
        # Every second line lists observations, (x, y, point) triples of numbers; some writers leave it out.
        if line.startswith("#") or len(fields) < 10 or _all_numbers(fields[9]):
            continue
        values = [float(v) for v in fields[1:8]]
        yield int(fields[8]), fields[9].strip(), _pose(values[:4], values[4:])


def _all_numbers(text: str) -> bool:
    try:
        for part in text.split():
            float(part)
    except ValueError:
        return False
    return True


def _unpack(file: BinaryIO, form: str) -> tuple:
    form = "<" + form
    return struct.unpack(form, file.read(struct.calcsize(form)))


def _binary_cameras(path: Path) -> dict[int, Camera]:
    names = {number: (name, len(parts)) for name, (number, parts) in MODELS.items()}
    cameras = {}
    with path.open("rb") as file:
        for _ in range(_unpack(file, "Q")[0]):
            number, model, width, height = _unpack(file, "iiQQ")
            if model not in names:
                raise unknown(f"{path}: the camera model", f"number {model}", MODELS, "Undistort the images first.")
            name, count = names[model]
            cameras[number] = _camera(name, width, height, list(_unpack(file, f"{count}d")), path)
    return cameras


def _binary_images(path: Path) -> Iterator[tuple[int, str, Array]]:
    with path.open("rb") as file:
        for _ in range(_unpack(file, "Q")[0]):
            values = _unpack(file, "I7dI")
            name = bytearray()
            while (byte := _unpack(file, "c")[0]) != b"\0":
                name += byte
            file.seek(24 * _unpack(file, "Q")[0], 1)  # observations
            yield values[8], name.decode("utf-8"), _pose(list(values[1:5]), list(values[5:8]))
