"""One frame's depth map beside those of its partners: where they agree, what their mean is, who could see the place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from overfly.geometry import Array, project, unproject
from overfly.mapping.depth_map import DepthMap
from overfly.mapping.subpixel import Map, frame_to_frame

Partner = tuple[DepthMap, Mapping[str, NDArray], NDArray[np.bool_] | None]
"""A map that is compared, its cleaned content and, if it was asked before, the pixels [H, W] that it has given."""

GATE = 3.0
"""Two depths of one place agree within this many standard deviations of their difference."""

WIDEST = 2.0
"""Ground pixels: the largest standard deviation with which depths of one place are compared, whatever they promise."""


@dataclass(frozen=True)
class Compared:
    """What the partners make of each pixel of a frame, maps [H, W].

    Attributes:
        depth, sigma: weighted mean of the depths that agree and its standard deviation, metres.
        agree: partners that have measured the same place.
        taken: whether one of them has given the place already.
        visible: partners that have the place inside.
    """

    depth: NDArray
    sigma: NDArray
    agree: NDArray[np.uint8]
    taken: NDArray[np.bool_]
    visible: NDArray[np.uint8]


def compared(
    own: DepthMap, data: Mapping[str, NDArray], second: NDArray[np.bool_], partners: Sequence[Partner]
) -> Compared:
    """Look up every pixel of a map in those of its partners.

    Args:
        own, data: the map and its cleaned content.
        second: pixels [H, W] that no pair has matched.
        partners: to compare it with.
    """
    depth, sigma = data["depth"], data["sigma"]
    widest = WIDEST * depth / own.camera.fx
    weight = 1 / sigma**2
    total, mean = weight.copy(), weight * depth
    agree, visible = np.zeros(depth.shape, np.uint8), np.zeros(depth.shape, np.uint8)
    taken = np.zeros(depth.shape, bool)
    for partner, other, before in partners:
        found, spread, given, theirs, inside = _look_up(own, depth, partner, other, before)
        visible += inside
        # What pairs have matched is judged by what pairs have matched alone: the cloud of them is that of stereo.
        found = np.where(theirs & ~second, np.float32(np.nan), found)
        with np.errstate(invalid="ignore"):
            gate = GATE * np.hypot(np.minimum(sigma, widest), np.minimum(spread, widest))
            same = np.abs(found - depth) < gate
        agree += same
        taken |= same & given
        w = np.where(same, 1 / spread**2, 0)
        total += w
        mean += np.where(same, w * found, 0)
    # One pair alone must at least agree with itself, seen from its other frame.
    rows, columns = np.nonzero(np.isfinite(depth) & ~second & (agree == 0) & (data["support"] == 1) & (visible == 1))
    pixels = np.stack([columns + 0.5, rows + 0.5], 1)
    places = unproject(pixels, depth[rows, columns], own.camera, own.world_from_camera)
    for partner, other, _ in partners:
        agree[rows, columns] |= _on_slope(places, sigma[rows, columns], partner, other)
    return Compared(mean / total, 1 / np.sqrt(total), agree, taken, visible)


def _look_up(
    own: DepthMap, depth: Map, other: DepthMap, data: Mapping[str, NDArray], given: NDArray[np.bool_] | None
) -> tuple[Map, Map, NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    """What another map says of each pixel: its depth as a depth of this frame, its sigma, whether it is given,
    whether no pair has matched it there, and whether it lies inside that map at all."""
    import cv2

    q, t = frame_to_frame(own.camera, own.world_from_camera, other.camera, other.world_from_camera)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / depth
        third = q[2] + inverse * t[2]
        u = np.nan_to_num((q[0] + inverse * t[0]) / third - np.float32(0.5), nan=-9, posinf=-9, neginf=-9)
        v = np.nan_to_num((q[1] + inverse * t[1]) / third - np.float32(0.5), nan=-9, posinf=-9, neginf=-9)
    nan = float("nan")
    there, spread = (
        cv2.remap(data[name], u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=nan)
        for name in ("depth", "sigma")
    )
    was, theirs = (
        np.zeros(depth.shape, bool)
        if mask is None
        else cv2.remap(mask.astype(np.uint8), u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT) > 0
        for mask in (given, data.get("second"))
    )
    # third * depth is the depth in the other frame: their ratio is how much nearer or farther it saw the place.
    inside = (third > 0) & (u > -0.5) & (v > -0.5) & (u < other.camera.width - 0.5) & (v < other.camera.height - 0.5)
    return there / third, spread / third, was, theirs, inside


def _on_slope(places: Array, sigma: NDArray, other: DepthMap, data: Mapping[str, NDArray]) -> NDArray[np.bool_]:
    """Which points [N, 3] lie between the depths that pairs have matched in the 3 x 3 pixels of another map round them.

    On walls and crowns the depth changes from pixel to pixel by more than its standard deviation, and what was matched
    from pixel to pixel in one frame leaves holes in the other.
    """
    pixels, depth = project(places, other.camera, other.world_from_camera)
    with np.errstate(invalid="ignore"):
        inside = (depth > 0) & ((pixels > 0) & (pixels < [other.camera.width, other.camera.height])).all(1)
    columns, rows = np.where(inside[:, None], pixels, 0).astype(int).T
    matched = np.where(data["second"], np.float32(np.nan), data["depth"]) if "second" in data else data["depth"]
    around = np.pad(matched, 1, constant_values=np.nan), np.pad(data["sigma"], 1, constant_values=np.nan)
    depths, spreads = (np.stack([m[rows + i, columns + j] for i in range(3) for j in range(3)]) for m in around)
    spread = np.minimum(np.fmax.reduce(spreads), WIDEST * depth / other.camera.fx)
    gate = GATE * np.hypot(np.minimum(sigma, WIDEST * depth / other.camera.fx), spread)
    return inside & (depth > np.fmin.reduce(depths) - gate) & (depth < np.fmax.reduce(depths) + gate)
