"""What one frame adds to the cloud, kept in a file: its points, sorted into squares of the plan, read square by square.

The squares have a side of their own in every frame, a power of two metres (or units), so that they do not depend on how
the map is cut into tiles later, when the sampling of all frames is known.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from overfly.cloud import Cloud
from overfly.files import opened_arrays, save_arrays

PIXELS = 256
"""Least side of a square, ground pixels."""

RECORD = np.dtype(
    [
        ("points", "<f8", 3), ("colors", "u1", 3), ("confidence", "<f4"), ("sigma_m", "<f4"), ("views", "u1"),
        ("predicted", "?"), ("apart", "u1"),
    ]
)  # fmt: skip


@dataclass(frozen=True)
class Part:
    """What is known of a frame's points without reading them.

    Attributes:
        gsd: metres per pixel, NaN without points.
        side: of the squares, metres.
        squares: [S, 2] column and row, counted from the frame of reference's origin to the east and the north.
        counts: [S] points in each.
    """

    gsd: float
    side: float
    squares: NDArray[np.int64]
    counts: NDArray[np.int64]

    def touched(self, low: NDArray, high: NDArray) -> NDArray[np.int64]:
        """Numbers of the squares that meet the rectangle from ``low`` to ``high`` [2]."""
        if not len(self.squares):
            return np.zeros(0, np.int64)
        west = self.squares * self.side
        return np.flatnonzero(((west <= high) & (west + self.side >= low)).all(1))


def write_part(path: Path, cloud: Cloud, apart: NDArray[np.uint8], gsd: float) -> Part:
    """Write a frame's points, atomically, and with them how far ``apart`` from matched points they must be [N]."""
    if not len(cloud):
        part = Part(float("nan"), 1.0, np.zeros((0, 2), np.int64), np.zeros(0, np.int64))
        save_arrays(path, {"facts": np.array([part.gsd, part.side]), "squares": part.squares, "counts": part.counts})
        return part
    side = float(2.0 ** np.ceil(np.log2(PIXELS * gsd)))
    at = np.floor(cloud.points[:, :2] / side).astype(np.int64)
    low, rows = at.min(0), int(np.ptp(at[:, 1])) + 1
    flat = (at[:, 0] - low[0]) * rows + at[:, 1] - low[1]
    order = np.argsort(flat, kind="stable")
    known, starts, counts = np.unique(flat[order], return_index=True, return_counts=True)
    squares = np.stack([known // rows, known % rows], axis=1) + low
    records = np.empty(len(cloud), RECORD)
    for name in RECORD.names or ():
        records[name] = (apart if name == "apart" else getattr(cloud, name))[order]
    pieces = {str(i): piece for i, piece in enumerate(np.split(records, starts[1:]))}
    save_arrays(path, {"facts": np.array([gsd, side]), "squares": squares, "counts": counts, **pieces})
    return Part(gsd, side, squares, counts)


def read_part(path: Path) -> Part:
    """What is known of the points in a file.

    Raises:
        Damaged: it is missing or damaged.
    """
    with opened_arrays(path) as arrays:
        gsd, side = (float(v) for v in arrays["facts"])
        return Part(gsd, side, arrays["squares"], arrays["counts"])


def read_squares(path: Path, numbers: NDArray[np.int64]) -> NDArray:
    """The points (:data:`RECORD`) in some squares of a file.

    Raises:
        Damaged: it is missing or damaged.
    """
    with opened_arrays(path) as arrays:
        found = [arrays[str(i)] for i in numbers]
    return np.concatenate(found) if found else np.empty(0, RECORD)


def cloud_of(records: NDArray) -> Cloud:
    """Records as a cloud."""
    arrays: dict[str, Any] = {name: np.ascontiguousarray(records[name]) for name in RECORD.names or ()}
    arrays.pop("apart")
    return Cloud(**arrays)
