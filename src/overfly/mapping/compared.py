"""One frame's depth map beside those of its partners: where they agree, what their mean is, who could see the place."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from overfly.geometry import project, unproject
from overfly.mapping.depth_map import DepthMap
from overfly.mapping.neighbours import is_wide
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
        agree: partners whose depth there is the same.
        slope: whether the only partner that has the place inside has it between the depths of neighbouring pixels.
        taken: whether one of them has given the place already.
        against: partners that have the place inside and know nothing there, or something else. One that makes a wide
            pair with this frame counts only if it sees through the place: it matches much less, and often something
            hides the place from it.
    """

    depth: NDArray
    sigma: NDArray
    agree: NDArray[np.uint8]
    slope: NDArray[np.bool_]
    taken: NDArray[np.bool_]
    against: NDArray[np.uint8]


def compared(
    own: DepthMap, data: Mapping[str, NDArray], second: NDArray[np.bool_], partners: Iterable[Partner]
) -> Compared:
    """Look up every pixel of a map in those of its partners, one of which is in memory at a time.

    Args:
        own, data: the map and its cleaned content.
        second: pixels [H, W] that no pair has matched, or of which nothing is left.
        partners: to compare it with.
    """
    depth, sigma = data["depth"], data["sigma"]
    widest = WIDEST * depth / own.camera.fx
    weight = 1 / sigma**2
    total, mean = weight.copy(), weight * depth
    agree, visible, against = (np.zeros(depth.shape, np.uint8) for _ in range(3))
    middle = float(np.nanmedian(depth)) if np.isfinite(depth).any() else 1.0
    taken, slope, given_there = (np.zeros(depth.shape, bool) for _ in range(3))
    one_pair = np.isfinite(depth) & ~second & (data["support"] == 1)
    for partner, other, before in partners:
        found, spread, given, theirs, inside = _look_up(own, depth, partner, other, before)
        visible += inside
        # What pairs have matched is judged by what is left of what pairs have matched: guesses have no vote.
        found = np.where(theirs & ~second, np.float32(np.nan), found)
        with np.errstate(invalid="ignore"):
            gate = GATE * np.hypot(np.minimum(sigma, widest), np.minimum(spread, widest))
            same = np.abs(found - depth) < gate
            through = found > depth
        agree += same
        wide = is_wide(own.camera, own.world_from_camera, middle, partner.world_from_camera)
        against += inside & ~same & (through | (not wide))
        taken |= same & given
        w = np.where(same, 1 / spread**2, 0)
        total += w
        mean += np.where(same, w * found, 0)
        doubtful = one_pair & inside & (visible == 1) & (agree == 0)
        slope[doubtful] = _on_slope(own, depth, np.minimum(sigma, widest), doubtful, partner, other)
        given_there |= doubtful & given & ~theirs
    # Where more than one could see the place, one whose neighbouring pixels allow it proves nothing.
    slope &= (visible == 1) & (agree == 0)
    taken |= slope & given_there
    return Compared(mean / total, 1 / np.sqrt(total), agree, slope, taken, against)


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


def _on_slope(
    own: DepthMap, depth: Map, sigma: NDArray, asked: NDArray[np.bool_], other: DepthMap, data: Mapping[str, NDArray]
) -> NDArray[np.bool_]:
    """Which of the asked pixels lie between the depths that pairs have matched in 3 x 3 pixels of another map.

    On walls and crowns the depth changes from pixel to pixel by more than its standard deviation, and what was matched
    from pixel to pixel in one frame leaves holes in the other. The price: what floats between a roof's edge and the
    ground passes, too.

    Args:
        own, depth, sigma: the map, its depth and standard deviation [H, W], metres.
        asked: pixels [H, W] that the other map has inside.
        other, data: the other map and its cleaned content.
    """
    rows, columns = np.nonzero(asked)
    if not len(rows):
        return np.zeros(0, bool)
    pixels = np.stack([columns + 0.5, rows + 0.5], 1)
    places = unproject(pixels, depth[asked], own.camera, own.world_from_camera)
    found, there = project(places, other.camera, other.world_from_camera)
    scale = there / depth[asked]
    u, v = np.clip(found.astype(int), 0, [other.camera.width - 1, other.camera.height - 1]).T
    matched = np.isfinite(data["depth"])
    if "second" in data:
        matched &= ~data["second"]
    low, high, widest = np.full(len(rows), np.inf), np.full(len(rows), -np.inf), np.zeros(len(rows))
    height, width = matched.shape
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            at = np.clip(v + i, 0, height - 1), np.clip(u + j, 0, width - 1)
            known = matched[at]
            low = np.where(known, np.minimum(low, data["depth"][at]), low)
            high = np.where(known, np.maximum(high, data["depth"][at]), high)
            widest = np.where(known, np.maximum(widest, data["sigma"][at]), widest)
    most = WIDEST * depth[asked] / own.camera.fx
    gate = GATE * np.hypot(sigma[asked], np.minimum(widest / scale, most)) * scale
    return np.asarray((there > low - gate) & (there < high + gate))
