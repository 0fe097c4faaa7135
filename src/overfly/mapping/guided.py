"""Matches between frames whose poses are roughly known: a key point is looked for only where it can be."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from overfly.geometry import Array
from overfly.mapping.bundle import Bundle, Index

RATIO = 0.75
"""Largest distance of a descriptor's match as a share of that of the second best: few candidates compete."""

ROWS = 256
"""Key points that are looked for at a time."""

MOST_DISTANT = 0.6
"""Largest distance of two matching unit descriptors."""


def guided_matches(
    bundle: Bundle,
    pair: tuple[int, int],
    pixels: tuple[NDArray, NDArray],
    descriptors: tuple[NDArray, NDArray],
    heights: tuple[float, float],
    reach: float,
) -> NDArray[np.uint32]:
    """Rows of indices [m, 2] of key points of two images that lie on each other's epipolar lines and look alike.

    Args:
        bundle: its cameras; the images' distortion is taken as none.
        pair: two images i, j of the bundle.
        pixels: their key points [p, 2], [q, 2].
        descriptors: of these, [p, d], [q, d].
        heights: between which the ground lies, in the bundle's z: they end the epipolar lines.
        reach: pixels off such a piece of line.
    """
    i, j = pair
    low, high = (_seen_at(bundle, i, j, pixels[0], z) for z in heights)
    size = 2 * bundle.lenses[bundle.lens_of[j], 1:3]
    with np.errstate(invalid="ignore"):
        may = ((np.maximum(low, high) > -reach) & (np.minimum(low, high) < size + reach)).all(1)
    own = np.flatnonzero(may)
    if not len(own):
        return np.zeros((0, 2), np.uint32)
    box = np.stack([np.minimum(low, high)[own].min(0), np.maximum(low, high)[own].max(0)])
    theirs = np.flatnonzero(((pixels[1] > box[0] - reach) & (pixels[1] < box[1] + reach)).all(1))
    if not len(theirs):
        return np.zeros((0, 2), np.uint32)
    a, b = (_unit(d[k]) for d, k in zip(descriptors, (own, theirs), strict=True))
    alike = a @ b.T
    for start in range(0, len(own), ROWS):
        some = own[start : start + ROWS]
        with np.errstate(invalid="ignore"):
            near = _off_pieces(pixels[1][theirs], low[some], high[some]) < reach
        alike[start : start + ROWS][~near] = -1
    first, second = _best(alike), _best(alike.T)
    rows = np.flatnonzero((first >= 0) & (second[np.maximum(first, 0)] == np.arange(len(own))))
    return np.column_stack([own[rows], theirs[first[rows]]]).astype(np.uint32)


def _seen_at(bundle: Bundle, i: int, j: int, pixels: NDArray, z: float) -> Array:
    """Where image j shows the points [p, 2] of level ground at height z that image i shows at ``pixels`` [p, 2]."""
    f, cx, cy = bundle.lenses[bundle.lens_of[i], :3]
    rays = np.column_stack([(pixels - [cx, cy]) / f, np.ones(len(pixels))]) @ bundle.rotations[i]
    with np.errstate(divide="ignore", invalid="ignore"):
        far = (z - bundle.centres[i, 2]) / rays[:, 2]
        points = bundle.centres[i] + np.where(far > 0, far, np.nan)[:, None] * rays
    return bundle.project(points, np.full(len(pixels), j, np.intp))


def _off_pieces(points: NDArray, start: Array, end: Array) -> Array:
    """Distances [p, q] of points [q, 2] from pieces of line [p, 2] to [p, 2]; NaN where these are."""
    along = end - start
    length = np.maximum((along**2).sum(1), 1e-9)
    away = points[None] - start[:, None]
    share = np.clip((away * along[:, None]).sum(2) / length[:, None], 0, 1)
    return np.asarray(np.linalg.norm(away - share[..., None] * along[:, None], axis=2))


def _unit(descriptors: NDArray) -> NDArray[np.float32]:
    raw = descriptors.astype(np.float32)
    return raw / np.maximum(np.linalg.norm(raw, axis=1, keepdims=True), 1e-9)


def _best(alike: NDArray[np.float32]) -> Index:
    """The column of each row [p] that is clearly the most alike, -1 where none is."""
    best = alike.argmax(1)
    rows = np.arange(len(alike))
    top = alike[rows, best]
    others = alike.copy()
    others[rows, best] = -1
    distance, next_best = np.sqrt(np.maximum(2 - 2 * top, 0)), np.sqrt(np.maximum(2 - 2 * others.max(1), 0))
    return np.where((distance < MOST_DISTANT) & (distance < RATIO * next_best), best, -1)
