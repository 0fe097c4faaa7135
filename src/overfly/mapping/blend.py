"""Blending photographs on one grid in two bands (after Burt & Adelson 1983): details from one frame, tones from all.

Every cell has the detail of the frame that is worth most there, so that nothing is blurred by frames that do not fit to
the pixel. Its tone comes from all frames that see it: each frame is moved by its difference from the weighted mean of
all, taken over the very cells it sees and averaged over blocks of :data:`BLOCK` cells. A frame that sees a roof only is
compared with the others on that roof only, so that misfits leave no halo.

Frames lose their worth where they show another colour than most others: a passing car, or a crown that the surface
model lacks, lies there before the ground.

Sums are of integers, so that a cell's colour does not depend on the window in which it is computed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from overfly.mapping.lattice import Map

BLOCK = 16
"""Cells over which tones are averaged, each way."""

UNLIKE = 16.0
"""Difference of two mean colours, of 255, at which frames support each other by a quarter only."""

VOTE = 32
"""Mean weight, of 255, from which on a frame has a full vote."""

Place = tuple[slice, slice]


@dataclass
class _Drawing:
    """One frame: places with colours [3, r, c] and worth [r, c]; block sums [4, ...] of weighted colours, weights."""

    parts: list[tuple[Place, NDArray[np.uint8], NDArray[np.uint16]]]
    sums: NDArray[np.int64]


class Canvas:
    """Colours of a window of [rows, columns] cells, both multiples of :data:`BLOCK`, from several frames.

    Holds five bytes for each cell and frame that sees it.
    """

    def __init__(self, rows: int, columns: int) -> None:
        self.rows, self.columns = rows, columns
        self._drawn: list[_Drawing] = []

    def begin(self) -> None:
        """What is drawn from now on belongs to the next frame."""
        self._drawn.append(_Drawing([], np.zeros((4, self.rows // BLOCK, self.columns // BLOCK), np.int64)))

    def draw(self, place: Place, colors: NDArray[np.uint8], worth: Map) -> None:
        """Draw a part of the frame.

        Args:
            place: rows and columns, from and to multiples of :data:`BLOCK`.
            colors: [3, r, c].
            worth: [r, c] in 0..1; 0 where the frame sees nothing.
        """
        fine = np.ceil(worth * np.float32(65535)).astype(np.uint16)
        self._drawn[-1].parts.append((place, colors, fine))
        self._drawn[-1].sums[:, *_blocks(place)] = _colour_sums(colors, _weights(fine))

    def blended(self) -> tuple[NDArray[np.uint8], Map]:
        """Colours [3, rows, columns], black where no frame sees the cell, and the best frame's worth, 0 there."""
        self._agree()
        made = np.zeros((3, self.rows, self.columns), np.uint8)
        best, owner = np.zeros(made.shape[1:], np.uint16), np.full(made.shape[1:], -1, np.int16)
        totals, weight = np.zeros(made.shape, np.int32), np.zeros(made.shape[1:], np.int32)
        for label, drawing in enumerate(self._drawn):
            for place, colors, worth in drawing.parts:
                weights = _weights(worth)
                totals[:, *place] += np.multiply(colors, weights, dtype=np.uint16)
                weight[place] += weights
                better = worth > best[place]
                np.copyto(best[place], worth, where=better)
                np.copyto(owner[place], np.int16(label), where=better)
                np.copyto(made[:, *place], colors, where=better)
        for total in totals:  # to the mean in eighths; in place, for a window is large
            np.floor_divide(8 * total + weight // 2, np.maximum(weight, 1), out=total)
        for label, drawing in enumerate(self._drawn):
            used = [owner[place] == label for place, _, _ in drawing.parts]
            if any(mine.any() for mine in used):
                shift = _shift(drawing, totals)
                for (place, _, _), mine in zip(drawing.parts, used):
                    if mine.any():
                        tone = np.rint(made[:, *place] + _interpolated(shift, *_blocks(place)))
                        np.copyto(made[:, *place], np.clip(tone, 0, 255).astype(np.uint8), where=mine)
        return made, np.divide(best, 65535, dtype=np.float32)

    def _agree(self) -> None:
        """Lower each frame's worth by the square of its share of the votes that the best supported frame has."""
        votes, means, boxes = [], [], []
        for drawing in self._drawn:
            smooth = _smooth(drawing.sums)
            means.append((smooth[:3] / np.maximum(smooth[3], 1)).astype(np.float32))
            votes.append(np.minimum(1, smooth[3] / np.float32(VOTE * BLOCK * BLOCK * 16)).astype(np.float32))
            boxes.append(_box(smooth[3]))
        support = [vote.copy() for vote in votes]
        most = np.zeros((self.rows // BLOCK + 2, self.columns // BLOCK + 2), np.float32)
        for i, box in enumerate(boxes):
            for j, other in enumerate(boxes):
                both = (
                    slice(max(box[0].start, other[0].start), min(box[0].stop, other[0].stop)),
                    slice(max(box[1].start, other[1].start), min(box[1].stop, other[1].stop)),
                )
                if i != j and both[0].start < both[0].stop and both[1].start < both[1].stop:
                    off = ((means[i][:, *both] - means[j][:, *both]) ** 2).sum(0) / np.float32(3 * UNLIKE**2)
                    support[i][both] += votes[j][both] / (1 + off) ** 2
            np.maximum(most, np.where(votes[i] > 0, support[i], 0), out=most)
        for drawing, mine in zip(self._drawn, support):
            share = np.minimum(1, mine / np.maximum(most, np.float32(1e-6)))[None] ** 2
            for k, (place, colors, worth) in enumerate(drawing.parts):
                left = worth * _interpolated(share, *_blocks(place))[0]
                drawing.parts[k] = place, colors, np.ceil(left).astype(np.uint16)


def _weights(worth: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Worth in 255 steps, above 0 where it is: sums of them fit into 32 bits."""
    return ((worth.astype(np.uint32) + 256) // 257).astype(np.uint8)


def _shift(drawing: _Drawing, mean: NDArray[np.int32]) -> Map:
    """The difference of the mean (in eighths) from a frame, over the cells it sees: padded blocks [3, ...]."""
    off = np.zeros_like(drawing.sums)
    for place, colors, worth in drawing.parts:
        differences = mean[:, *place] - np.left_shift(colors, 3, dtype=np.int32)
        off[:, *_blocks(place)] = _colour_sums(differences, _weights(worth))
    smooth = _smooth(off)
    shift: Map = (smooth[:3] / (8 * np.maximum(smooth[3], 1))).astype(np.float32)
    return shift


def _blocks(place: Place) -> Place:
    rows, columns = place
    return slice(rows.start // BLOCK, rows.stop // BLOCK), slice(columns.start // BLOCK, columns.stop // BLOCK)


def _box(weights: NDArray[np.int64]) -> Place:
    """The rows and columns that hold everything above 0."""
    rows, columns = np.flatnonzero(weights.any(1)), np.flatnonzero(weights.any(0))
    return (
        (slice(0, 0), slice(0, 0))
        if not len(rows)
        else (
            slice(rows[0], rows[-1] + 1),
            slice(columns[0], columns[-1] + 1),
        )
    )


def _colour_sums(colors: NDArray, weights: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Sums over blocks of weighted colours [3, r, c] and of weights [r, c]: [4, r / BLOCK, c / BLOCK]."""
    planes = np.concatenate([np.multiply(colors, weights, dtype=np.int32), weights[None]])
    _, rows, columns = planes.shape
    strips = planes.reshape(4, rows // BLOCK, BLOCK, columns).sum(2, dtype=np.int32)
    return strips.reshape(4, rows // BLOCK, columns // BLOCK, BLOCK).sum(3, dtype=np.int64)


def _smooth(sums: NDArray[np.int64]) -> NDArray[np.int64]:
    """Sums over each block and its neighbours by the kernel 1 2 1, padded by one block: [4, rows + 2, columns + 2]."""
    wide = np.pad(sums, ((0, 0), (2, 2), (2, 2)))
    wide = wide[:, :-2] + 2 * wide[:, 1:-1] + wide[:, 2:]
    return wide[:, :, :-2] + 2 * wide[:, :, 1:-1] + wide[:, :, 2:]


def _interpolated(values: Map, rows: slice, columns: slice) -> Map:
    """Bilinear values of a padded block lattice [C, ...] at the cells of some of its blocks."""
    (i, v), (j, u) = _halfway(rows), _halfway(columns)
    line = values[:, i] * (1 - v)[:, None] + values[:, i + 1] * v[:, None]
    return np.asarray(np.take(line, j, axis=2) * (1 - u) + np.take(line, j + 1, axis=2) * u, np.float32)


def _halfway(blocks: slice) -> tuple[NDArray[np.int64], Map]:
    """For each cell of the blocks the block whose centre comes before it, in the padded axis, and the next one's share.

    Shares are multiples of a power of two: exact.
    """
    at = (np.arange(blocks.start * BLOCK, blocks.stop * BLOCK) + 0.5) / BLOCK + 0.5
    return np.floor(at).astype(np.int64), (at - np.floor(at)).astype(np.float32)
