"""How a map is cut into tiles: squares of whole voxels, so many that each holds no more points than memory allows."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from overfly.files import replacing
from overfly.mapping.parts import Part
from overfly.mapping.thinning import BLOCK, MARGIN

SMALLEST = 4
"""Least side of a tile, in blocks (:data:`overfly.mapping.thinning.BLOCK`)."""


@dataclass(frozen=True, eq=False)
class Layout:
    """The tiles of a map and the frames' points that they are made from.

    Attributes:
        voxel: side of a voxel, metres.
        tiles: first voxel and the one behind the last [2] of each, in the order in which they are made.
        parts: of all frames.
    """

    voxel: float
    tiles: list[tuple[NDArray[np.int64], NDArray[np.int64]]]
    parts: list[Part]

    def last_needed(self, t: int) -> list[int]:
        """Frames whose points no tile after number ``t`` needs."""
        return self._ends.get(t, [])

    @cached_property
    def _ends(self) -> dict[int, list[int]]:
        """The frames that each tile is the last to need."""
        ends: dict[int, list[int]] = {}
        lows = np.array([low for low, _ in self.tiles]).reshape(-1, 2)
        highs = np.array([high for _, high in self.tiles]).reshape(-1, 2)
        lows, highs = reach(lows, highs, self.voxel)
        for k, part in enumerate(self.parts):
            if len(part.squares):
                west, east = part.squares.min(0) * part.side, (part.squares.max(0) + 1) * part.side
                near = np.flatnonzero(((lows <= east) & (highs >= west)).all(1))
                ends.setdefault(int(near[-1]), []).append(k)
        return ends

    def write(self, path: Path) -> None:
        """Keep it: a resumed map must have the same tiles, whatever memory is free by then."""
        content = {
            "voxel": self.voxel,
            "tiles": [[low.tolist(), high.tolist()] for low, high in self.tiles],
            "parts": [[p.gsd, p.side, p.squares.tolist(), p.counts.tolist()] for p in self.parts],
        }
        with replacing(path) as temporary:
            temporary.write_text(json.dumps(content))

    @classmethod
    def read(cls, path: Path) -> Layout | None:
        """The layout that was kept, None if there is none or it cannot be read."""
        try:
            content = json.loads(path.read_text())
            tiles = [(np.array(low, np.int64), np.array(high, np.int64)) for low, high in content["tiles"]]
            parts = [
                Part(gsd, side, np.array(squares, np.int64).reshape(-1, 2), np.array(counts, np.int64))
                for gsd, side, squares, counts in content["parts"]
            ]
            return cls(float(content["voxel"]), tiles, parts)
        except (OSError, ValueError, KeyError, TypeError):
            return None


def reach(low: NDArray, high: NDArray, voxel: float) -> tuple[NDArray, NDArray]:
    """The corners [..., 2], in metres, of all that a tile must know; a voxel more, for what rounding does."""
    return (low - MARGIN - 1) * voxel, (high + MARGIN + 1) * voxel


def laid_out(parts: Sequence[Part], voxel: float | None, tile_points: int) -> Layout:
    """Cut the map.

    Args:
        parts: of all frames, at least one with points.
        voxel: side of a voxel; None takes the median ground sampling distance of the frames.
        tile_points: the fullest tile has about so many at most, before thinning, unless it is the smallest possible.
    """
    seen = [part for part in parts if part.counts.sum()]
    size = voxel or float(np.median([part.gsd for part in seen]))
    block = BLOCK * size
    middles = np.concatenate([(part.squares + 0.5) * part.side for part in seen])
    counts = np.concatenate([part.counts for part in seen])
    low = np.floor(np.min([part.squares.min(0) * part.side for part in seen], axis=0) / block).astype(np.int64)
    high = np.floor(np.max([(part.squares.max(0) + 1) * part.side for part in seen], axis=0) / block).astype(np.int64)
    blocks = high + 1 - low
    side = int(blocks.max())
    while side > SMALLEST:
        at = np.floor((middles / block - low) / side).astype(np.int64)
        _, owner = np.unique(at, axis=0, return_inverse=True)
        if np.bincount(owner.reshape(-1), weights=counts).max() <= tile_points:
            break
        side = max(SMALLEST, int(side / 1.2) if side > 6 else side - 1)
    tiles = set()
    for part in seen:  # every tile that one of its squares meets
        first = np.floor((part.squares * part.side / block - low - 1e-6) / side).astype(np.int64)
        last = np.floor(((part.squares + 1) * part.side / block - low + 1e-6) / side).astype(np.int64)
        for (x0, y0), (x1, y1) in zip(first.tolist(), last.tolist(), strict=True):
            tiles |= {(y, x) for y in range(y0, y1 + 1) for x in range(x0, x1 + 1)}
    corners = [(low + side * np.array([x, y])) * BLOCK for y, x in sorted(tiles)]
    return Layout(size, [(corner, corner + side * BLOCK) for corner in corners], list(parts))
