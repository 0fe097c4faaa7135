"""SIFT key points, the pairs of images worth comparing, and their matches."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from overfly.flights import Frame
from overfly.geometry import Array

FEATURES = 5000
LONGEST_SIDE = 2000
RATIO = 0.8
FEWEST_MATCHES = 15
SMALL_FLIGHT = 45
NEIGHBOURS = 12


def features(frame: Frame, folder: Path) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Pixels [n, 2] (centres at +0.5) and RootSIFT descriptors [n, 128]; kept in ``folder`` for the next call."""
    import cv2

    kept = folder / f"{frame.name.replace('/', '_')}.npz"
    if kept.is_file():
        with np.load(kept) as data:
            return data["pixels"], data["descriptors"].astype(np.float32) / 512
    gray = cv2.cvtColor(frame.image(), cv2.COLOR_RGB2GRAY)
    factor = min(1.0, LONGEST_SIDE / max(gray.shape))
    if factor < 1:
        gray = cv2.resize(gray, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    # A low contrast threshold: meadows and asphalt have key points too, and the strongest are chosen anyway.
    sift = cv2.SIFT_create(nfeatures=FEATURES, contrastThreshold=0.02, enable_precise_upscale=True)
    found, raw = sift.detectAndCompute(gray, None)
    pixels = (np.array([point.pt for point in found], np.float32).reshape(-1, 2) + 0.5) / np.float32(factor)
    root = np.sqrt(raw / np.maximum(raw.sum(1, keepdims=True), 1e-9)) if len(found) else np.zeros((0, 128))
    # A tie at the last place lets SIFT return one more; half precision of 512 steps halves the file.
    pixels, root = pixels[:FEATURES], root[:FEATURES].astype(np.float32)
    part = kept.with_suffix(".part.npz")
    np.savez(part, pixels=pixels, descriptors=np.round(root * 512).astype(np.uint16))
    part.replace(kept)
    return pixels, np.round(root * 512).astype(np.float32) / 512


def match(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Mutual nearest neighbours that pass the ratio test: index pairs [m, 2].

    Lowe, "Distinctive image features from scale-invariant keypoints" (2004), section 7.1.
    """
    if min(len(a), len(b)) < 2:
        return np.zeros((0, 2), np.uint32)
    similarity = a @ b.T
    rows = np.arange(len(a))
    best = similarity.argmax(1)
    first = similarity[rows, best]
    mutual = similarity.argmax(0)[best] == rows
    similarity[rows, best] = -1
    second = similarity.max(1)
    # Unit vectors: squared distance = 2 - 2 cos.
    good = mutual & (2 - 2 * first < RATIO**2 * (2 - 2 * second))
    return np.stack([rows[good], best[good]], axis=1).astype(np.uint32)


def image_pairs(frames: list[Frame], positions: Array | None) -> list[tuple[int, int]]:
    """Which images to compare.

    Args:
        frames: n frames in the order of the flight.
        positions: [n, 3] local GPS positions, NaN where a frame has none; None without GPS.

    Returns:
        Pairs i < j: all of a small flight without GPS; the nearest in plan and the neighbours in time with GPS;
        neighbours in time and a coarse net of all others in a large flight without.
    """
    n = len(frames)
    if n <= 12 or (positions is None and n <= SMALL_FLIGHT):
        return [(i, j) for i in range(n) for j in range(i + 1, n)]
    pairs = {(i, j) for i in range(n) for j in range(i + 1, min(n, i + 4))}
    if positions is None:
        pairs |= {(i, j) for i in range(n) for j in range(i + 1, min(n, i + 11))}
        net = range(0, n, max(1, n // SMALL_FLIGHT))
        return sorted(pairs | {(i, j) for i in net for j in net if i < j})
    known = np.flatnonzero(np.isfinite(positions[:, :2]).all(1))
    for i in known:
        away = np.linalg.norm(positions[known, :2] - positions[i, :2], axis=1)
        for j in known[np.argsort(away, kind="stable")[1 : NEIGHBOURS + 1]]:
            pairs.add((int(min(i, j)), int(max(i, j))))
    for i in set(range(n)) - set(known.tolist()):
        pairs |= {(min(i, j), max(i, j)) for j in range(n) if j != i and abs(i - j) <= 10}
    return sorted(pairs)
