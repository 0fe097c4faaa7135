"""The photographs of one flight as a pinhole sees them: undistorted once, at the size at which they are compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset

from overfly.errors import InputError
from overfly.flights import Frame
from overfly.geometry import Array, Camera, invert


@dataclass(frozen=True, eq=False)
class Photographs:
    """n undistorted photographs of one size with their pinhole cameras, in a local frame.

    Attributes:
        names: of the frames.
        images: [n, 3, H, W] float32 in 0..1.
        valid: [n, H, W] bool: pixels that the undistorted photograph covers.
        intrinsics: [n, 3, 3] float32.
        camera_from_local: [n, 4, 4] float32, metres.
        origin: [3] float64: the local frame's zero in the frame of the cameras that were given.
        held_out: [n] bool: never used to refine, only to measure.
    """

    names: list[str]
    images: NDArray[np.float32]
    valid: NDArray[np.bool_]
    intrinsics: NDArray[np.float32]
    camera_from_local: NDArray[np.float32]
    origin: Array
    held_out: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.names)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.images.shape[3], self.images.shape[2]

    @property
    def cameras(self) -> list[Camera]:
        """Their pinholes."""
        return [Camera(*self.size, *k[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()) for k in self.intrinsics]


def photographs(
    frames: Sequence[Frame], *, width: int | None, hold_out: int, multiple: int, origin: Array
) -> Photographs:
    """Read, undistort and scale the images of frames with known cameras.

    Args:
        frames: two or more, each with camera and pose.
        width: of the results, pixels; None or more than the images have: as they are. Rounded down to ``multiple``.
        hold_out: every so manieth frame is held out, 0 for none.
        multiple: of which width and height are multiples; the rest is cut off at the right and the bottom.
        origin: [3], becomes the zero of the local frame.

    Raises:
        InputError: there is only one frame, nothing would be left to refine on, or the images are too small or of
            several sizes.
    """
    import cv2

    if len(frames) < 2:
        raise InputError(
            f"{len(frames)} photograph cannot show depth, and a mesh is refined against several: give two or more "
            "that overlap."
        )
    held = held_out(len(frames), hold_out)
    images, valid, intrinsics, poses = [], [], [], []
    for frame in frames:
        assert frame.camera is not None
        assert frame.world_from_camera is not None
        wide = frame.camera.width if width is None else min(width, frame.camera.width)
        high = round(frame.camera.height * wide / frame.camera.width)
        camera = frame.camera.resized(wide, high)
        shrunk = cv2.resize(frame.image(), (wide, high), interpolation=cv2.INTER_AREA)
        image, seen = undistorted(shrunk, camera)
        if min(wide, high) < multiple:
            raise InputError(
                f"{frame.name} is compared at only {wide} x {high} pixels: give a larger width, or images of "
                f"{multiple} or more a side."
            )
        high, wide = high // multiple * multiple, wide // multiple * multiple
        images.append(image[:high, :wide].astype(np.float32).transpose(2, 0, 1) / 255)
        valid.append(seen[:high, :wide])
        intrinsics.append(camera.matrix())
        pose = np.array(frame.world_from_camera, np.float64)
        pose[:3, 3] -= origin
        poses.append(invert(pose))
    if len(sizes := sorted({image.shape[1:] for image in images})) > 1:
        told = " and ".join(f"{w} x {h}" for h, w in sizes)
        raise InputError(f"The photographs are of several sizes ({told}): refine with those of one camera at a time.")
    return Photographs(
        [frame.name for frame in frames],
        np.stack(images),
        np.stack(valid),
        np.array(intrinsics, np.float32),
        np.stack(poses).astype(np.float32),
        np.asarray(origin, np.float64),
        held,
    )


def held_out(count: int, every: int) -> NDArray[np.bool_]:
    """Which of ``count`` frames are held out: the middle one of every ``every``, never an end of the flight [count].

    One of three or more is held out however large ``every`` is, none of two.

    Raises:
        InputError: ``every`` is 1 or negative.
    """
    if every == 1 or every < 0:
        raise InputError(
            f"hold_out={every} leaves no photograph to refine on: hold out every sixth (hold_out=6), or none (0)."
        )
    held = np.zeros(count, bool)
    if every:
        held[min(every, count) // 2 : count - 1 : every] = True
    return held


def undistorted(image: NDArray[np.uint8], camera: Camera) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """The image [H, W, 3] through a pinhole of the same focal length and principal point, and where it is known."""
    import cv2

    if not camera.is_distorted:
        return image, np.ones(image.shape[:2], bool)
    # OpenCV counts from the centre of the first pixel, Overfly from its corner.
    matrix = camera.matrix() - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    wide_high = (camera.width, camera.height)
    u, v = cv2.initUndistortRectifyMap(matrix, camera.distortion, None, matrix, wide_high, cv2.CV_32FC1)
    known = (u >= 0) & (u <= image.shape[1] - 1) & (v >= 0) & (v <= image.shape[0] - 1)
    return cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), known


NEIGHBOURS = 4
"""Photographs from the nearest places, one of which is drawn as the other of a pair."""

PAIR = ("image", "valid", "intrinsics", "camera_from_local")


class PhotographPairs(Dataset):
    """Photographs that are refined on (or held out), each with one that was taken near it.

    An item holds ``image`` [3, H, W] in 0..1, ``valid`` [H, W], ``intrinsics`` [3, 3], ``camera_from_local`` [4, 4],
    the same with ``other_`` before it, and ``index``. The other one is drawn by (seed, epoch, index) among the nearest
    that are not held out.
    """

    def __init__(self, photographs: Photographs, chosen: NDArray[np.bool_], *, seed: int) -> None:
        self.photographs, self.seed = photographs, seed
        self.indices = np.flatnonzero(chosen)
        free = np.flatnonzero(~photographs.held_out)
        poses = photographs.camera_from_local
        centres = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
        away = np.linalg.norm(centres[:, None] - centres[None, free], axis=2)
        away[free[None] == np.arange(len(photographs))[:, None]] = np.inf
        self.near = free[np.argsort(away, axis=1, kind="stable")[:, : min(NEIGHBOURS, len(free) - 1)]]

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, key: int | tuple[int, int]) -> dict[str, torch.Tensor]:
        epoch, place = key if isinstance(key, tuple) else (0, key)
        index, shots = self.indices[place], self.photographs
        rng = np.random.default_rng([self.seed, epoch, int(index)])
        values = {
            "image": shots.images,
            "valid": shots.valid,
            "intrinsics": shots.intrinsics,
            "camera_from_local": shots.camera_from_local,
        }
        other = rng.choice(self.near[index])
        item = {name: torch.from_numpy(values[name][index]) for name in PAIR}
        item |= {f"other_{name}": torch.from_numpy(values[name][other]) for name in PAIR}
        return {**item, "index": torch.tensor(index)}
