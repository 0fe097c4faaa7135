"""The last fraction of a pixel: a few hypotheses around each depth, scored by correlation in all neighbouring frames.

The windows are warped by the current depth map itself, so that they lie on the surface, also where it slants.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from overfly.geometry import Array, Camera, invert

Map = NDArray[np.float32]

NOT_SEEN = -0.999
FAINT = 0.5
"""Smallest variance of a window, gray levels squared: below it there is only noise, which must not correlate."""


@dataclass(frozen=True)
class Shot:
    """An undistorted gray image [H, W] float32 with its camera and pose."""

    gray: Map
    camera: Camera
    world_from_camera: Array


@dataclass(frozen=True)
class Refined:
    """depth [H, W] metres; score [H, W], the mean correlation -1..1 of the best neighbours at that depth; step [H, W],
    metres of depth per pixel of disparity in the widest neighbour."""

    depth: Map
    score: Map
    step: Map


def refine(
    reference: Shot,
    neighbours: Sequence[Shot],
    depth: Map,
    *,
    steps: Sequence[float],
    window: int = 7,
    best: int = 2,
    reluctance: float = 0.01,
) -> Refined:
    """Move each depth to the best correlated of a few hypotheses, with a parabola between them.

    Args:
        reference: the frame.
        neighbours: frames that see the same ground.
        depth: [H, W] metres, NaN where unknown.
        steps: symmetric, evenly spaced offsets, in pixels of the neighbour with the widest baseline.
        window: side of the correlation window, pixels.
        best: number of neighbours that must agree; the worst ones may be occluded.
        reluctance: correlation lost per pixel of offset, which keeps textureless ground where it was.
    """
    height, width = depth.shape
    with np.errstate(divide="ignore"):
        inverse = (1 / depth).astype(np.float32)
    middle = float(np.nanmedian(inverse)) if np.isfinite(inverse).any() else 1.0
    looks = [look for shot in neighbours if (look := _look(reference, shot, inverse, window)) is not None]
    blank = np.full(depth.shape, -1, np.float32)
    if not looks:
        return Refined(depth.copy(), blank, np.full(depth.shape, np.nan, np.float32))
    unit = np.float32(1 / max(_rate(look, middle, width, height) for look in looks))
    scores = []
    for step in steps:
        trial = inverse + np.float32(step) * unit
        # The best correlations of each pixel, among the neighbours that see it.
        top = [blank.copy() for _ in range(best)]
        for look in looks:
            found = _correlate(look, trial, window)
            for k in range(best):
                box = top[k][look.box]
                top[k][look.box], found = np.maximum(box, found), np.minimum(box, found)
        total, seen = top[0].copy(), np.ones(depth.shape, np.float32)
        for more in top[1:]:
            counts = more > NOT_SEEN
            total += np.where(counts, more, 0)
            seen += counts
        scores.append(total / seen - np.float32(reluctance * abs(step)))
    cube = np.stack(scores)
    top_step = cube.argmax(0)
    inner = np.clip(top_step, 1, len(steps) - 2)
    before, here, after = (np.take_along_axis(cube, (inner + k)[None], axis=0)[0] for k in (-1, 0, 1))
    bend = before - 2 * here + after
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = np.where(bend < 0, np.clip(0.5 * (before - after) / bend, -1, 1), 0)
    at = np.asarray(steps, np.float32)
    # At the end of the range the parabola has no other side: take the sample itself.
    offset = np.where(top_step == inner, at[inner] + shift * (at[1] - at[0]), at[top_step])
    score = cube.max(0)
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = 1 / (inverse + np.where(score > 0, offset, 0) * unit)
    return Refined(moved.astype(np.float32), score.astype(np.float32), (depth * depth * unit).astype(np.float32))


def frame_to_frame(
    camera: Camera, world_from_camera: Array, other: Camera, world_from_other: Array
) -> tuple[list[Map], NDArray[np.float32]]:
    """q [3][H, W] and t [3]: a pixel with inverse depth w is seen by the other frame at (q + w t) / (q + w t)[2].

    (q + w t)[2] / w is its depth there. Both cameras are without distortion.
    """
    relative = invert(world_from_other) @ world_from_camera
    matrix = other.matrix() @ relative[:3, :3] @ np.linalg.inv(camera.matrix())
    u, v = np.arange(camera.width) + 0.5, np.arange(camera.height)[:, None] + 0.5
    q = [(row[0] * u + row[1] * v + row[2]).astype(np.float32) for row in matrix]
    return q, (other.matrix() @ relative[:3, 3]).astype(np.float32)


@dataclass(frozen=True)
class _Look:
    """The part of the frame that a neighbour sees, with all that does not change between hypotheses.

    ``gray`` is of the frame, ``mean`` and ``deviation`` (the root of at least :data:`FAINT`) of its windows; ``unseen``
    are pixels that the neighbour does not see, ``q`` and ``t`` as of :func:`frame_to_frame`.
    """

    box: tuple[slice, slice]
    gray: Map
    mean: Map
    deviation: Map
    unseen: NDArray[np.bool_]
    q: list[Map]
    t: NDArray[np.float32]
    shot: Shot


def _look(reference: Shot, shot: Shot, inverse: Map, window: int) -> _Look | None:
    import cv2

    q, t = frame_to_frame(reference.camera, reference.world_from_camera, shot.camera, shot.world_from_camera)
    with np.errstate(divide="ignore", invalid="ignore"):
        third = q[2] + inverse * t[2]
        u, v = (q[0] + inverse * t[0]) / third, (q[1] + inverse * t[1]) / third
        inside = (third > 0) & (u > 2) & (v > 2) & (u < shot.camera.width - 2) & (v < shot.camera.height - 2)
    rows, columns = np.flatnonzero(inside.any(1)), np.flatnonzero(inside.any(0))
    if not len(rows):
        return None
    box = (slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1))
    gray, *lines = (np.ascontiguousarray(m[box]) for m in (reference.gray, *q))
    mean = np.asarray(cv2.boxFilter(gray, -1, (window, window)), np.float32)
    square = cv2.sqrBoxFilter(gray, cv2.CV_32F, (window, window)) - mean * mean
    return _Look(box, gray, mean, np.sqrt(np.maximum(square, np.float32(FAINT))), ~inside[box], lines, t, shot)


def _rate(look: _Look, middle: float, width: int, height: int) -> float:
    """Pixels that the middle of the seen part moves in the neighbour per unit of inverse depth."""
    q = np.array([m[m.shape[0] // 2, m.shape[1] // 2] for m in look.q], float)
    a, b = q + middle * 0.99 * look.t, q + middle * 1.01 * look.t
    return float(np.linalg.norm(b[:2] / b[2] - a[:2] / a[2]) / (0.02 * middle)) + 1e-9


def _correlate(look: _Look, trial: Map, window: int) -> Map:
    """Zero-mean normalised correlation of the seen part and the neighbour warped by the inverse depth ``trial``."""
    import cv2

    inverse, t, size = trial[look.box], look.t, (window, window)
    third, u, v = (inverse * t[k] for k in (2, 0, 1))  # changed in place from here on: memory is what takes the time
    third += look.q[2]
    np.reciprocal(third, out=third)
    for at, q in ((u, look.q[0]), (v, look.q[1])):
        at += q
        at *= third
        at -= np.float32(0.5)
    other = np.asarray(cv2.remap(look.shot.gray, u, v, cv2.INTER_LINEAR), np.float32)
    # Where the neighbour sees nothing, the frame itself stands in, so that windows beside it are not spoilt.
    np.copyto(other, look.gray, where=look.unseen)
    mean = np.asarray(cv2.boxFilter(other, -1, size), np.float32)
    deviation = np.asarray(cv2.sqrBoxFilter(other, cv2.CV_32F, size), np.float32)
    deviation -= np.multiply(mean, mean, out=third)
    np.maximum(deviation, np.float32(FAINT), out=deviation)
    np.sqrt(deviation, out=deviation)
    other *= look.gray
    score = np.asarray(cv2.boxFilter(other, -1, size), np.float32)
    score -= np.multiply(mean, look.mean, out=third)
    deviation *= look.deviation
    score /= deviation
    np.copyto(score, np.float32(-1), where=look.unseen)
    return score
