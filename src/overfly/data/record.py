"""The record of one flight at network resolution: what training reads, as plain arrays on disk.

A record is a folder that appears whole or not at all: it is written under another name and then renamed.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from overfly.errors import InputError
from overfly.geometry import Array, Camera


@dataclass(frozen=True)
class Record:
    """n frames of one flight, undistorted and resized, with their dense reference.

    Attributes:
        images: [n, H, W, 3] uint8.
        depth: [n, H, W] float32, camera z in metres, 0 where unknown.
        world_from_camera: [n, 4, 4] float64.
        cameras: n pinhole cameras.
        strips: [n] int64; frames of equal number follow each other in time.
        heights: [rows, columns] float32, top surface in metres, row 0 in the north, NaN where unknown.
        corner: world x of the west and y of the north edge of ``heights``, and its cell size, metres.
        ground_height: mean height of the ground, metres.
        facts: plain values: scene, style, seed, altitude, overlap, flight_path, measured_overlap, ...
    """

    images: NDArray[np.uint8]
    depth: NDArray[np.float32]
    world_from_camera: Array
    cameras: list[Camera]
    strips: NDArray[np.int64]
    heights: NDArray[np.float32]
    corner: tuple[float, float, float]
    ground_height: float
    facts: dict[str, Any]

    def __len__(self) -> int:
        return len(self.images)

    def surface(self, xy: NDArray) -> NDArray[np.float64]:
        """Height of the top surface at world x, y [..., 2]; NaN outside the reference."""
        west, north, cell = self.corner
        column = np.floor((xy[..., 0] - west) / cell).astype(np.int64)
        row = np.floor((north - xy[..., 1]) / cell).astype(np.int64)
        rows, columns = self.heights.shape
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        values = self.heights[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)].astype(np.float64)
        return np.where(inside, values, np.nan)


ARRAYS = ("images", "depth", "world_from_camera", "strips", "heights")


def write_record(record: Record, folder: Path) -> None:
    """Write a record so that ``folder`` is complete or absent, even after a kill.

    Raises:
        InputError: the disk is full.
    """
    part = folder.with_name(f"{folder.name}.{os.getpid()}.part")
    try:
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        for name in ARRAYS:
            np.save(part / f"{name}.npy", getattr(record, name))
        content = {
            "cameras": [camera.to_dict() for camera in record.cameras],
            "corner": list(record.corner),
            "ground_height": record.ground_height,
            "facts": record.facts,
        }
        (part / "record.json").write_text(json.dumps(content))
        os.replace(part, folder)
    except OSError as error:
        shutil.rmtree(part, ignore_errors=True)
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            free = shutil.disk_usage(folder.parent).free / 1e6
            raise InputError(
                f"The disk of the cache {folder.parent} is full ({free:.0f} MB free): make room there, or choose "
                "another folder with cache_dir=...; flights finished so far are kept and reused."
            ) from error
        raise


def read_record(folder: Path) -> Record:
    """Open a record; its arrays stay on disk until they are read."""
    content = json.loads((folder / "record.json").read_text())
    arrays = {name: np.load(folder / f"{name}.npy", mmap_mode="r") for name in ARRAYS}
    return Record(
        **arrays,
        cameras=[Camera(**camera) for camera in content["cameras"]],
        corner=tuple(content["corner"]),
        ground_height=content["ground_height"],
        facts=content["facts"],
    )


def cached(folder: Path, make: Callable[[], Record]) -> Path:
    """The record in ``folder``, made now unless it is there; two processes never make the same one."""
    from filelock import FileLock

    folder.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(folder.with_name(f"{folder.name}.lock")):
        if not (folder / "record.json").is_file():
            for stale in folder.parent.glob(f"{folder.name}.*.part"):  # left behind by a killed process
                shutil.rmtree(stale, ignore_errors=True)
            write_record(make(), folder)
    return folder
