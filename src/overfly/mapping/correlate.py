"""Correspondences made precise: normalised cross-correlation of small patches, from coarse to full resolution."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from overfly.geometry import Array

PATCH = 15
"""Side of the patch that is compared, pixels of the octave."""

REACH = 3
"""How far from where it is expected a patch is looked for, pixels of the octave."""

CHUNK = 1000
"""Patches that are compared at once: about 50 MB."""

Gray = NDArray[np.uint8]


def octaves(gray: Gray, count: int) -> list[Gray]:
    """The image and ``count`` halvings of it."""
    import cv2

    levels = [gray]
    for _ in range(count):
        levels.append(cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    return levels


def refine(
    first: Gray, second: Gray, pixels_a: Array, pixels_b: Array, jacobians: Array, *, error_px: float
) -> tuple[Array, Array]:
    """Where the patches around pixels of one image lie in another, to a fraction of a pixel.

    Args:
        first, second: [H, W] each.
        pixels_a: [M, 2] in ``first``, which stay where they are.
        pixels_b: [M, 2] where they are expected in ``second``.
        jacobians: [M, 2, 2] pixels of ``second`` for a pixel of ``first``: how patches are turned and scaled.
        error_px: how far off the expectation may be, pixels; the search begins in the octave where that is ``REACH``.

    Returns:
        Pixels in ``second`` [M, 2], and the correlation there [M]: -1 where a patch leaves its image or the best
        place was at the end of the search, so that nothing agrees.
    """
    if not len(pixels_a):
        return np.zeros((0, 2)), np.zeros(0)
    start = max(0, int(np.ceil(np.log2(max(error_px, 1e-9) / REACH))))
    levels = list(zip(octaves(first, start), octaves(second, start), strict=True))
    places, scores = [], []
    for i in range(0, len(pixels_a), CHUNK):
        part = slice(i, i + CHUNK)
        at, score = pixels_b[part].astype(float), np.zeros(len(pixels_b[part]))
        # The last search is centred on the place found: there a parabola through the peak has no bias.
        for octave, reach in [*((k, REACH) for k in range(start, -1, -1)), (0, 1)]:
            moved, score_here = _search(*levels[octave], pixels_a[part], at, jacobians[part], 2**octave, reach)
            at, score = at + moved, np.where(score < 0, score, score_here)
        places.append(at)
        scores.append(score)
    return np.concatenate(places), np.concatenate(scores)


def _search(
    first: Gray, second: Gray, pixels_a: Array, pixels_b: Array, jacobians: Array, scale: int, reach: int
) -> tuple[Array, Array]:
    """Moves [M, 2] of the pixels in ``second`` to the best places, full pixels, and the correlations there [M]."""
    template, inside_a = _patches(first, pixels_a, np.broadcast_to(np.eye(2), jacobians.shape), scale, PATCH)
    window, inside_b = _patches(second, pixels_b, jacobians, scale, PATCH + 2 * reach)
    views = np.lib.stride_tricks.sliding_window_view(window, (PATCH, PATCH), axis=(1, 2))
    views = views.reshape(*views.shape[:3], -1)  # [M, places, places, PATCH ** 2]
    template = template.reshape(len(template), -1)
    template = template - template.mean(1, keepdims=True)
    mean = views.mean(3)
    spread = np.sqrt(np.maximum(np.einsum("mijk,mijk->mij", views, views) / views.shape[3] - mean**2, 0))
    product = np.einsum("mijk,mk->mij", views, template) / views.shape[3]
    correlation = product / np.maximum(spread * template.std(1)[:, None, None], 1e-3)
    side, rows = 2 * reach + 1, np.arange(len(template))
    best = correlation.reshape(len(template), -1).argmax(1)
    row, column = best // side, best % side
    within = (row > 0) & (row < side - 1) & (column > 0) & (column < side - 1)
    y, x = np.clip(row, 1, side - 2), np.clip(column, 1, side - 2)
    here = correlation[rows, y, x]
    step = [
        _parabola(correlation[rows, y - dy, x - dx], here, correlation[rows, y + dy, x + dx])
        for dx, dy in ((1, 0), (0, 1))
    ]
    offset = np.column_stack([x + step[0], y + step[1]]) - reach
    moved = scale * np.einsum("mij,mj->mi", jacobians, offset)
    good = within & inside_a & inside_b
    return np.where(good[:, None], moved, 0.0), np.where(good, here, -1.0)


def _parabola(before: Array, here: Array, after: Array) -> Array:
    """Where the parabola through three values one step apart has its peak, -0.5 to 0.5."""
    curvature = before + after - 2 * here
    bent = curvature < -1e-6
    return np.where(bent, np.clip((before - after) / (2 * np.where(bent, curvature, 1.0)), -0.5, 0.5), 0.0)


def _patches(
    image: Gray, pixels: Array, jacobians: Array, scale: int, side: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Patches [M, side, side] around full pixels [M, 2] of an octave, turned and scaled; and which lie inside."""
    import cv2

    steps = np.arange(side) - (side - 1) / 2
    grid = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)
    places = pixels[:, None] / scale + np.einsum("mij,nj->mni", jacobians, grid)  # [M, side ** 2, 2]
    size = np.array([image.shape[1], image.shape[0]])
    inside = ((places > 0) & (places < size)).all((1, 2))
    maps = (places - 0.5).astype(np.float32).reshape(-1, side, 2)  # cv2 counts pixel centres from 0
    found = cv2.remap(
        image.astype(np.float32), maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return found.reshape(-1, side, side), inside
