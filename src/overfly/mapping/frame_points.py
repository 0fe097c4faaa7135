"""Points of one frame's depth map: checked against the maps of its partners and averaged where they agree."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from overfly.cloud import Cloud
from overfly.flights import Frame
from overfly.geometry import Array, project, unproject
from overfly.mapping.depth_map import DepthMap
from overfly.mapping.subpixel import Map, frame_to_frame

GATE = 3.0
"""Two depths of one place agree within this many standard deviations of their difference."""

WORST_SCORE = {True: 0.2, False: 0.3}
"""Smallest correlation of a point that several pairs confirm, and of one that only one pair has seen."""

UNMATCHED = 0.15
"""What is added to that for each further partner that has the place inside and has not matched it."""

SURE_THOUGH_SEEN = 0.7
"""Confidence from which on a network's word alone stands where other frames have the place inside and match nothing."""

WIDEST = 2.0
"""Ground pixels: the largest standard deviation with which depths of one place are compared, whatever they promise."""

SPECK, ISLAND, ISLAND_SCORE = 15, 40, 0.7
"""Connected pieces of depth with fewer pixels are speckle; pieces up to the second size must correlate so well."""

CONNECTED = 32
"""Standard deviations that neighbouring pixels of a piece may be apart: 8 pixels of disparity, as on walls."""


def cleaned(depth_map: DepthMap) -> dict[str, NDArray]:
    """The map without badly correlated pixels and speckle."""
    import cv2

    data = depth_map.load()
    depth = data["depth"]
    threshold = np.where(data["support"] >= 2, WORST_SCORE[True], WORST_SCORE[False])
    known = np.isfinite(depth) & (data["score"] >= threshold)
    # Speckle is judged in steps of sigma along the inverse depth, where a slope is smooth.
    middle = float(np.median(depth[known])) if known.any() else 1.0
    unit = float(np.median((data["sigma"] / depth**2)[known])) if known.any() else 1.0
    steps = np.clip(np.where(known, (1 / np.where(known, depth, middle) - 1 / middle) / unit, -30000), -30000, 30000)
    for pixels, score in ((SPECK, np.inf), (ISLAND, ISLAND_SCORE)):
        labels = steps.astype(np.int16)
        cv2.filterSpeckles(labels, -30000, pixels, CONNECTED)
        known &= (labels > -30000) | (data["score"] >= score)
    depth = np.where(known, depth, np.float32(np.nan))
    opinion = depth_map.opinion()
    if opinion is None:
        return {**data, "depth": depth}
    size = depth.shape[::-1]
    said, sigma, sure = (
        cv2.resize(part, size, interpolation=cv2.INTER_LINEAR)
        for part in (opinion.depth, opinion.sigma, opinion.confidence)
    )
    # Where nothing could be measured, the network's word stands.
    guessed = ~known & np.isfinite(said)
    return {
        **data,
        "depth": np.where(guessed, said, depth),
        "sigma": np.where(guessed, sigma, data["sigma"]),
        "support": np.where(guessed, 0, data["support"]).astype(np.uint8),
        "guessed": guessed,
        "second": guessed | ~data["paired"],
        "sure": sure,
        "once": cv2.resize(opinion.views, size, interpolation=cv2.INTER_NEAREST) < 2,
    }


def frame_points(
    own: DepthMap,
    data: Mapping[str, NDArray],
    partners: Iterable[tuple[DepthMap, Mapping[str, NDArray], NDArray[np.bool_] | None]],
    frame: Frame,
    single: bool,
) -> tuple[Cloud, NDArray[np.bool_], NDArray[np.bool_], float]:
    """The points of one map that earlier maps have not given.

    Args:
        own, data: the map and its cleaned content.
        partners: of each map that it is compared with, the map, its cleaned content and, if it was asked before this
            one, the pixels [H, W] that it has given.
        frame: it was made from, for the colours.
        single: keep points that only one pair has seen.

    Returns:
        The points, which of them no pair has matched [N], which pixels are given now [H, W], and metres per pixel.
    """
    depth: Map = data["depth"]
    sigma = data["sigma"]
    guessed = data.get("guessed", np.zeros(depth.shape, bool))
    second = data.get("second", guessed)
    widest = WIDEST * depth / own.camera.fx
    weight = 1 / sigma**2
    total, mean = weight.copy(), weight * depth
    agree = np.zeros(depth.shape, np.uint8)
    taken = np.zeros(depth.shape, bool)
    visible = np.zeros(depth.shape, np.uint8)
    partners = list(partners)
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
    places = unproject(
        np.stack([columns + 0.5, rows + 0.5], 1), depth[rows, columns], own.camera, own.world_from_camera
    )
    for partner, other, _ in partners:
        agree[rows, columns] |= _on_slope(places, sigma[rows, columns], partner, other)
    votes = np.maximum(agree, data["support"])
    known = np.isfinite(depth) & (votes >= (1 if single else 2)) & ((agree >= 1) | (data["support"] >= 2))
    enough = WORST_SCORE[False] + UNMATCHED * np.maximum(visible - 1.0, 0)
    known &= guessed | (data["support"] >= 2) | (data["score"] >= enough)
    alone = guessed & (agree == 0)  # predicted: no other frame agrees
    if "once" in data:
        alone &= data["once"] | (data["sure"] >= SURE_THOUGH_SEEN)
    image, shown = _shown(frame, own)
    known = (known | alone) & shown
    fresh = known & ~taken
    merged, spread = mean[fresh] / total[fresh], 1 / np.sqrt(total[fresh])
    rows, columns = np.nonzero(fresh)
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=1)
    points = unproject(pixels, merged, own.camera, own.world_from_camera)
    votes = votes[fresh]
    cloud = Cloud(
        points,
        image[rows, columns],
        confidence=np.where(
            guessed[fresh],
            data["sure"][fresh] if "sure" in data else 0,
            _confidence(votes, agree[fresh], data["score"][fresh]),
        ).astype(np.float32),
        sigma_m=spread.astype(np.float32),
        views=(1 + votes).astype(np.uint8),
        predicted=alone[fresh],
    )
    measured = merged[~second[fresh]] if (~second[fresh]).any() else merged
    gsd = float(np.median(measured)) / own.camera.fx if len(merged) else float("nan")
    return cloud, second[fresh], known, gsd


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


def _shown(frame: Frame, own: DepthMap) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """The frame's image in the pixels of its depth map [H, W, 3], and which of them [H, W] the lens has shown."""
    import cv2

    assert frame.camera is not None
    lens = frame.camera.resized(own.camera.width, own.camera.height)
    image = frame.image()
    if image.shape[:2] != (lens.height, lens.width):
        image = cv2.resize(image, (lens.width, lens.height), interpolation=cv2.INTER_AREA)
    whole = np.full(image.shape[:2], 255, np.uint8)
    if lens.is_distorted:
        matrix = lens.matrix()
        matrix[:2, 2] -= 0.5
        image, whole = (np.asarray(cv2.undistort(part, matrix, lens.distortion)) for part in (image, whole))
    return image, whole == 255


def _confidence(votes: NDArray, agree: NDArray, score: NDArray) -> NDArray[np.float32]:
    """0..1 from the number of confirming pairs and maps and the correlation."""
    base = np.select([(votes <= 1) & (agree == 0), agree == 0, agree == 1], [0.45, 0.7, 0.85], 0.95)
    return (base * np.clip(0.4 + 0.7 * score, 0, 1)).astype(np.float32)
