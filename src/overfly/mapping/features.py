"""SIFT key points of a frame, and the pairs of frames worth matching."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from overfly.flights import Frame
from overfly.geometry import Array
from overfly.mapping.database import focal_px
from overfly.mapping.nadir_view import nadir_view

FEATURES = 5000
LONGEST_SIDE = 1600
NEIGHBOURS = 2
"""Nearest frames in each of eight directions that a frame may be matched with."""

COARSE_FEATURES = 600
COARSE_RATIO = 0.8
FEWEST_COARSE = 5
MOST_PARTNERS = 14
CHUNK = 16
SMALL_FLIGHT = 8
"""Up to this many frames all pairs are matched."""


def features(frame: Frame, folder: Path) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Pixels [n, 2] (centres at +0.5) and RootSIFT descriptors [n, 128], the coarsest first; kept in ``folder``.

    Tilted images are looked at from straight above (:mod:`overfly.mapping.nadir_view`).
    Lowe, "Distinctive image features from scale-invariant keypoints" (2004); square roots after Arandjelović &
    Zisserman (2012), scaled to bytes as COLMAP expects them.
    """
    import cv2

    kept = folder / f"{frame.name.replace('/', '_')}.npz"
    focal = focal_px(frame)
    seen_as = np.array([np.nan] * 4 if frame.gimbal is None or focal is None else [*frame.gimbal, focal])
    if kept.is_file():
        with np.load(kept) as data:
            if np.array_equal(data["seen_as"], seen_as, equal_nan=True):
                return data["pixels"], data["descriptors"]
    gray = cv2.cvtColor(frame.image(), cv2.COLOR_RGB2GRAY)
    factor = min(1.0, LONGEST_SIDE / max(gray.shape))
    if factor < 1:
        gray = cv2.resize(gray, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    down = None if frame.gimbal is None or focal is None else nadir_view(gray, frame.gimbal, focal * factor)
    # A low contrast threshold: meadows and asphalt have key points too, and the strongest are chosen anyway.
    sift = cv2.SIFT.create(nfeatures=FEATURES, contrastThreshold=0.02, enable_precise_upscale=True)
    found, raw = sift.detectAndCompute(gray, None) if down is None else sift.detectAndCompute(down.image, down.mask)
    if len(found):
        order = np.argsort([-point.size for point in found], kind="stable")[:FEATURES]
        places = np.array([point.pt for point in found], np.float32)[order] + np.float32(0.5)
        pixels = (places if down is None else down.in_image(places).astype(np.float32)) / np.float32(factor)
        root = np.sqrt(raw[order] / np.maximum(raw[order].sum(1, keepdims=True), 1e-9))
        descriptors = np.clip(np.round(512 * root), 0, 255).astype(np.uint8)
    else:
        pixels, descriptors = np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8)
    part = kept.with_suffix(".part")
    with part.open("wb") as file:
        np.savez(file, pixels=pixels, descriptors=descriptors, seen_as=seen_as)
    part.replace(kept)
    return pixels, descriptors


def image_pairs(
    positions: Array | None,
    descriptors: Sequence[NDArray[np.uint8]],
    progress: Callable[[int, int], None] | None = None,
) -> list[tuple[int, int]]:
    """Which frames to match, as sorted pairs i < j.

    Args:
        positions: [n, 3] local GPS positions, NaN where a frame has none; None without GPS.
        descriptors: of n frames in the order of the flight, the coarsest first.
        progress: called with (coarse pairs compared, in all), where that is needed.

    Frames with GPS get the nearest others in each of eight directions, so that strips connect; frames without are
    compared with all others by their few hundred coarsest key points. The next two in time are pairs, too.
    """
    n = len(descriptors)
    if n <= SMALL_FLIGHT:
        return [(i, j) for i in range(n) for j in range(i + 1, n)]
    pairs = {(i, j) for i in range(n) for j in range(i + 1, min(n, i + 3))} | nearest_pairs(positions, NEIGHBOURS)
    known = np.zeros(n, bool) if positions is None else np.isfinite(positions[:, :2]).all(1)
    blind = np.flatnonzero(~known).tolist()
    if blind:
        pairs |= _alike(blind, descriptors, progress)
    return sorted(pairs)


def nearest_pairs(positions: Array | None, neighbours: int) -> set[tuple[int, int]]:
    """Pairs i < j of each frame with GPS and so many nearest others in each of eight directions.

    Args:
        positions: [n, 3] local GPS positions, NaN where a frame has none; None without GPS.
        neighbours: in each direction.
    """
    pairs: set[tuple[int, int]] = set()
    if positions is not None:
        places = np.flatnonzero(np.isfinite(positions[:, :2]).all(1))
        for i in places:
            away = positions[places, :2] - positions[i, :2]
            distance = np.linalg.norm(away, axis=1)
            sector = np.floor((np.arctan2(away[:, 1], away[:, 0]) / np.pi + 1) * 4).astype(int) % 8
            for s in range(8):
                inside = np.flatnonzero((sector == s) & (places != i))
                for j in places[inside[np.argsort(distance[inside], kind="stable")[:neighbours]]]:
                    pairs.add((int(min(i, j)), int(max(i, j))))
    return pairs


def _alike(
    asking: list[int], descriptors: Sequence[NDArray[np.uint8]], progress: Callable[[int, int], None] | None
) -> set[tuple[int, int]]:
    """Pairs that share coarse key points: the best partners of each asking frame among all frames."""
    n = len(descriptors)
    units = np.zeros((n, COARSE_FEATURES, 128), np.float32)
    for unit, raw in zip(units, descriptors, strict=True):
        few = raw[:COARSE_FEATURES].astype(np.float32)
        unit[: len(few)] = few / np.maximum(np.linalg.norm(few, axis=1, keepdims=True), 1e-9)
    counts = np.zeros((n, n), int)
    for done, i in enumerate(asking):
        for start in range(0, n, CHUNK):  # one product for many frames: small ones cost more to start than to run
            counts[i, start : start + CHUNK] = _count_matches(units[i], units[start : start + CHUNK])
        counts[i, i] = 0
        if progress:
            progress(done + 1, len(asking))
    counts = np.maximum(counts, counts.T)
    pairs = set()
    for i in asking:
        for j in np.argsort(-counts[i], kind="stable")[:MOST_PARTNERS].tolist():
            if counts[i, j] >= FEWEST_COARSE:
                pairs.add((min(i, j), max(i, j)))
    return pairs


def _count_matches(own: NDArray[np.float32], others: NDArray[np.float32]) -> NDArray[np.int64]:
    """Matches [m] of unit descriptors [n, 128] with each of [m, n, 128] that pass the ratio test, each taken once."""
    m, n, _ = others.shape
    similarity = (others.reshape(m * n, -1) @ own.T).reshape(m, n, len(own))
    best = similarity.argmax(2)
    first = np.take_along_axis(similarity, best[..., None], axis=2)
    np.put_along_axis(similarity, best[..., None], -1, axis=2)
    # Unit vectors: squared distance = 2 - 2 cos. Blank rows have similarity 0 to all and fail.
    good = 1 - first[..., 0] < COARSE_RATIO**2 * (1 - similarity.max(2))
    return np.array([len(np.unique(b[g])) for b, g in zip(best, good, strict=True)])
