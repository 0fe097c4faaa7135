"""Depth maps of many frames become one cloud: checked against each other, averaged where they agree, no place twice."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from overfly.cloud import Cloud, concatenate, voxel_thin
from overfly.errors import InputError
from overfly.flights import Frame
from overfly.geometry import unproject
from overfly.mapping.depth_map import DepthMap
from overfly.mapping.subpixel import Map, frame_to_frame

Progress = Callable[[int, int], None]

GATE = 3.0
"""Two depths of one place agree within this many standard deviations of their difference."""

WORST_SCORE = {True: 0.2, False: 0.45}
"""Smallest correlation of a point that several pairs confirm, and of one that only one pair has seen."""

LEAST_CONFIDENT = 0.5
"""Points that no pair has matched are left out with less confidence: on a real flight most of those were wrong."""

NEAR = 30
"""Points that no pair has matched are left out within this many ground pixels, in plan, of those that one has."""

WIDEST = 2.0
"""Ground pixels: the largest standard deviation with which depths of one place are compared, whatever they promise."""

ISLAND = 40
"""Connected pieces of depth with fewer pixels are speckle."""


def fuse(
    depth_maps: Sequence[DepthMap],
    frames: Sequence[Frame],
    *,
    voxel_m: float | None = None,
    single: bool = True,
    progress: Progress | None = None,
) -> Cloud:
    """Merge depth maps into a cloud in the cameras' frame.

    Args:
        depth_maps: from :func:`overfly.mapping.stereo.stereo`.
        frames: they were made from; they give the colours.
        voxel_m: at most one point per cube of this side; None takes the median ground sampling distance of the maps.
        single: keep points that only one pair has seen, with a low confidence. At 30 % overlap they are half the map.
        progress: called with (maps done, maps in all).

    Returns:
        Points with colour; ``views``, the frames that measured them (2 or more; 1 if predicted); ``sigma_m``, their
        standard deviation along the ray; ``confidence``, the share of such points that was found right; ``predicted``,
        the word of a network alone, kept where nothing was matched.

    Raises:
        InputError: the maps hold no depth at all.
    """
    by_name = {frame.name: frame for frame in frames}
    index = {m.name: k for k, m in enumerate(depth_maps)}
    load = lru_cache(maxsize=8)(lambda k: _cleaned(depth_maps[k]))
    used: dict[int, NDArray[np.bool_]] = {}
    matched: list[Cloud] = []
    guesses: list[Cloud] = []
    sampling: list[float] = []
    for k, own in enumerate(depth_maps):
        partners = [index[name] for name in own.partners if name in index]
        cloud, guessed, used[k], gsd = _points(
            own, load(k), {j: load(j) for j in partners}, depth_maps, used, single, by_name
        )
        if len(cloud):
            matched.append(cloud[~guessed])
            guesses.append(cloud[guessed])
            sampling.append(gsd)
        # A map is asked by later partners only.
        for j in [j for j in used if all(index.get(n, -1) <= k for n in depth_maps[j].partners)]:
            del used[j]
        if progress:
            progress(k + 1, len(depth_maps))
    if not matched:
        raise InputError(
            "Stereo found no depth in any pair: the images show no texture that matches (water, snow, blur), or the "
            "cameras do not belong to them."
        )
    size = voxel_m or float(np.median(sampling))
    first, second = (_thinned(concatenate(parts), size) for parts in (matched, guesses))
    first = first[_accompanied(first.points, 4 * size)] if len(first) else first
    assert second.confidence is not None
    second = second[second.confidence >= LEAST_CONFIDENT]
    return concatenate([first, second[_elsewhere(second, first, NEAR * size)]])


def _thinned(cloud: Cloud, size: float) -> Cloud:
    """The most confident point of each cube."""
    assert cloud.confidence is not None
    cloud = cloud[np.argsort(-cloud.confidence, kind="stable")]
    return cloud[voxel_thin(cloud.points, size)] if len(cloud) else cloud


def _cleaned(depth_map: DepthMap) -> dict[str, NDArray]:
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
    labels = steps.astype(np.int16)
    cv2.filterSpeckles(labels, -30000, ISLAND, 8)
    known &= labels > -30000
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
    }


def _points(
    own: DepthMap,
    data: Mapping[str, NDArray],
    partners: Mapping[int, Mapping[str, NDArray]],
    depth_maps: Sequence[DepthMap],
    used: Mapping[int, NDArray[np.bool_]],
    single: bool,
    frames: Mapping[str, Frame],
) -> tuple[Cloud, NDArray[np.bool_], NDArray[np.bool_], float]:
    """The points of one map that earlier maps have not given, which of them no pair has matched, which pixels are
    given now, and metres per pixel."""
    depth: Map = data["depth"]
    sigma = data["sigma"]
    guessed = data.get("guessed", np.zeros(depth.shape, bool))
    second = data.get("second", guessed)
    widest = WIDEST * depth / own.camera.fx
    weight = 1 / sigma**2
    total, mean = weight.copy(), weight * depth
    agree, deny, seen = (np.zeros(depth.shape, np.uint8) for _ in range(3))
    taken = np.zeros(depth.shape, bool)
    for j, other in partners.items():
        found, spread, given, inside, theirs = _look_up(own, depth, depth_maps[j], other, used.get(j))
        # What pairs have matched is judged by what pairs have matched alone: the cloud of them is that of stereo.
        found = np.where(theirs & ~second, np.float32(np.nan), found)
        with np.errstate(invalid="ignore"):
            gate = GATE * np.hypot(np.minimum(sigma, widest), np.minimum(spread, widest))
            same = np.abs(found - depth) < gate
            # The other frame looks through this point at something behind it.
            deny += found - depth > gate
        agree += same
        seen += inside
        taken |= same & given
        w = np.where(same, 1 / spread**2, 0)
        total += w
        mean += np.where(same, w * found, 0)
    # One pair alone must at least agree with itself, seen from its other frame.
    votes = np.maximum(agree, data["support"])
    known = np.isfinite(depth) & (votes >= (1 if single else 2)) & ((agree >= 1) | (data["support"] >= 2))
    alone = guessed & (agree == 0)  # predicted: no other frame agrees
    known |= alone
    fresh = known & ~taken
    merged, spread = mean[fresh] / total[fresh], 1 / np.sqrt(total[fresh])
    rows, columns = np.nonzero(fresh)
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=1)
    points = unproject(pixels, merged, own.camera, own.world_from_camera)
    votes = votes[fresh]
    image = _undistorted(frames[own.name], own)
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
    """What another map says of each pixel: its depth as a depth of this frame, its sigma, whether it is given, whether
    the other frame has the place inside at all, and whether no pair has matched it there."""
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
    inside = (u > 0) & (v > 0) & (u < other.camera.width - 1) & (v < other.camera.height - 1)
    # third * depth is the depth in the other frame: their ratio is how much nearer or farther it saw the place.
    return there / third, spread / third, was, inside, theirs


def _undistorted(frame: Frame, own: DepthMap) -> NDArray[np.uint8]:
    """The frame's image in the pixels of its depth map."""
    import cv2

    assert frame.camera is not None
    lens = frame.camera.resized(own.camera.width, own.camera.height)
    image = frame.image()
    if image.shape[:2] != (lens.height, lens.width):
        image = cv2.resize(image, (lens.width, lens.height), interpolation=cv2.INTER_AREA)
    if not lens.is_distorted:
        return image
    matrix = lens.matrix()
    matrix[:2, 2] -= 0.5
    return np.asarray(cv2.undistort(image, matrix, lens.distortion))


def _confidence(votes: NDArray, agree: NDArray, score: NDArray) -> NDArray[np.float32]:
    """0..1 from the number of confirming pairs and maps and the correlation."""
    base = np.select([(votes <= 1) & (agree == 0), agree == 0, agree == 1], [0.45, 0.7, 0.85], 0.95)
    return (base * np.clip(0.4 + 0.7 * score, 0, 1)).astype(np.float32)


def _elsewhere(guesses: Cloud, matched: Cloud, size: float) -> NDArray[np.bool_]:
    """Guessed points in whose cell of the plan nothing was matched: what is measured needs no guess beside it."""
    if not len(guesses) or not len(matched):
        return np.ones(len(guesses), bool)
    low = np.minimum(guesses.points[:, :2].min(0), matched.points[:, :2].min(0))
    cells = [np.floor((cloud.points[:, :2] - low) / size).astype(np.int64) for cloud in (guesses, matched)]
    columns = max(int(c[:, 1].max()) for c in cells) + 1
    plan = [c[:, 0] * columns + c[:, 1] for c in cells]
    return ~np.isin(*plan)


def _accompanied(points: NDArray, size: float) -> NDArray[np.bool_]:
    """Points whose coarse cell and its 26 neighbours hold enough others not to be stray."""
    from scipy.ndimage import uniform_filter

    cells = np.floor((points - points.min(0)) / (2 * size)).astype(np.int64)
    spans = cells.max(0) + 3
    if np.prod(spans, dtype=float) > 4e8:  # stray points far away: nothing dense can be laid out
        near = np.abs(points - np.median(points, 0)) < 20 * np.median(np.abs(points - np.median(points, 0)), 0) + size
        keep = near.all(1)
        if keep.all():
            return keep
        keep[keep] = _accompanied(points[keep], size)
        return keep
    grid = np.zeros(spans, np.float32)
    np.add.at(grid, tuple((cells + 1).T), 1)
    around = uniform_filter(grid, 3, mode="constant") * 27
    return np.asarray(around[tuple((cells + 1).T)] >= 6)
