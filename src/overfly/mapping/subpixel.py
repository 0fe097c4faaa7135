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
    warps = [
        frame_to_frame(reference.camera, reference.world_from_camera, shot.camera, shot.world_from_camera)
        for shot in neighbours
    ]
    inverse = np.where(np.isfinite(depth), 1 / depth, np.nan).astype(np.float32)
    middle = float(np.nanmedian(inverse))
    # pixels per unit of inverse depth
    rates = [_rate(w, middle, width, height) for w in warps]
    unit = np.float32(1 / max(rates))
    mean, spread = _moments(reference.gray, window)
    scores = []
    for step in steps:
        trial = inverse + np.float32(step) * unit
        found = []
        for shot, warp in zip(neighbours, warps):
            found.append(_correlate(reference.gray, mean, spread, shot, warp, trial, window))
        stack = np.sort(np.stack(found), axis=0)[::-1][:best]
        scores.append(stack.mean(0) - np.float32(reluctance * abs(step)))
    cube = np.stack(scores)
    top = cube.argmax(0)
    inner = np.clip(top, 1, len(steps) - 2)
    before, here, after = (np.take_along_axis(cube, (inner + k)[None], axis=0)[0] for k in (-1, 0, 1))
    bend = before - 2 * here + after
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = np.where(bend < 0, np.clip(0.5 * (before - after) / bend, -1, 1), 0)
    spacing = np.float32(steps[1] - steps[0])
    offset = np.asarray(steps, np.float32)[inner] + shift * spacing
    # At the end of the range the parabola has no other side: take the sample itself.
    offset = np.where(top == inner, offset, np.asarray(steps, np.float32)[top])
    score = cube.max(0)
    moved = inverse + np.where(score > 0, offset, 0) * unit
    return Refined((1 / moved).astype(np.float32), score.astype(np.float32), (depth * depth * unit).astype(np.float32))


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


def _rate(warp: tuple[list[Map], NDArray[np.float32]], middle: float, width: int, height: int) -> float:
    """Pixels that the middle of the frame moves in the neighbour per unit of inverse depth."""
    q, t = warp
    centre = np.array([m[height // 2, width // 2] for m in q], float)
    a, b = centre + middle * 0.99 * t, centre + middle * 1.01 * t
    return float(np.linalg.norm(b[:2] / b[2] - a[:2] / a[2]) / (0.02 * middle)) + 1e-9


def _moments(image: Map, window: int) -> tuple[Map, Map]:
    import cv2

    size = (window, window)
    mean = cv2.boxFilter(image, -1, size)
    spread = np.sqrt(np.maximum(cv2.boxFilter(image * image, -1, size) - mean * mean, 0.25))
    return mean, spread


def _correlate(
    gray: Map, mean: Map, spread: Map, shot: Shot, warp: tuple[list[Map], NDArray[np.float32]], trial: Map, window: int
) -> Map:
    """Zero-mean normalised correlation [H, W] of the frame and the neighbour warped by the inverse depth ``trial``."""
    import cv2

    q, t = warp
    third = q[2] + trial * np.float32(t[2])
    u = (q[0] + trial * np.float32(t[0])) / third - np.float32(0.5)
    v = (q[1] + trial * np.float32(t[1])) / third - np.float32(0.5)
    outside = ~((u > 0) & (v > 0) & (u < shot.camera.width - 1) & (v < shot.camera.height - 1) & (third > 0))
    u[outside], v[outside] = 0, 0
    other = cv2.remap(shot.gray, u, v, cv2.INTER_LINEAR)
    other[outside] = gray[outside]  # does not count: masked below
    other_mean, other_spread = _moments(other, window)
    cross = cv2.boxFilter(gray * other, -1, (window, window)) - mean * other_mean
    score = cross / (spread * other_spread)
    score[outside] = -1
    return score
