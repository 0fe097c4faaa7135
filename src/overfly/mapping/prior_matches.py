"""Matches that are looked for where cameras say they can be: by their priors, then by a first adjustment."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from overfly.geometry import Array
from overfly.mapping.bundle import Bundle
from overfly.mapping.guided import guided_matches
from overfly.mapping.model import FEWEST_MATCHES
from overfly.mapping.overlays import Prior
from overfly.mapping.relative import agreeing, unit_px

REACH_PX, FAR_REACH_PX = 3.0, 40.0
"""Off its epipolar line a key point is looked for so far, and so far if one of the images has no match yet."""

FIRST_REACH_PX, FIRST_HEIGHTS = 60.0, (-0.15, 0.3)
"""Off its epipolar line, and between which heights over the ground, in the cameras' heights over it, a key point is
looked for before any camera is adjusted."""

FOOTPRINTS_APART, NEAREST = 1.2, 8
"""Images are compared with so many whose middles lie nearest, no farther than so many times the ground that one sees,
corner to corner."""

FLATTEST = 0.4
"""Cosine from nadir: of flatter images the nearer ground counts."""

BY_CHANCE, DISPLACED = 0.25, (0.13, 0.17)
"""Share of the matches along epipolar lines that may be found there by chance, or none is taken; and shares of an image
by which its key points are moved to count these."""

RELIEF = (0.02, 0.98, 0.5)
"""Shares of the points between whose heights the ground is looked for, and how much more, of their range, each way."""

Features = tuple[NDArray, NDArray]
Verified = Mapping[tuple[int, int], NDArray[np.uint32]]


def first_matches(
    start: Bundle,
    features: Sequence[Features],
    rows: Verified,
    priors: Sequence[Prior | None],
    seed: int,
    progress: Callable[[int, int], None] | None,
) -> Verified:
    """The matches, and of pairs with few those that agree with the priors among what is alike where these put it.

    Args:
        start: cameras where GPS and gimbals say they are.
        features: pixels and descriptors of each of its images.
        rows: of pairs (i, j) of images of the bundle, indices of key points [m, 2].
        priors: of its images; nothing is looked for where one is None.
        seed: of random draws.
        progress: called with (pairs looked at, in all).
    """
    above = [p.world_from_camera[2, 3] for p in priors if p is not None]
    if not above:
        return rows
    tops = [z - p.world_from_camera[2, 3] for z, p in zip(start.centres[:, 2], priors, strict=True) if p is not None]
    level, height = float(np.median(tops)), float(np.median(above))
    heights = level + FIRST_HEIGHTS[0] * height, level + FIRST_HEIGHTS[1] * height
    unit, near, found = _unit(start), _near(start, level), dict(rows)
    for done, (i, j) in enumerate(near):
        if progress:
            progress(done, len(near))
        first, second = priors[i], priors[j]
        had = rows.get((i, j), np.zeros((0, 2), np.uint32))
        if first is None or second is None or len(had) >= FEWEST_MATCHES:
            continue
        new = _guided(start, (i, j), features, heights, FIRST_REACH_PX * max(unit[i], unit[j]))
        both = np.unique(np.concatenate([had, new]), axis=0)
        pixels = features[i][0][both[:, 0]], features[j][0][both[:, 1]]
        if (good := agreeing(first, second, pixels, seed, FIRST_REACH_PX)).sum() > len(had):
            found[i, j] = both[good]
    return found


def more_matches(
    bundle: Bundle, features: Sequence[Features], rows: Verified, progress: Callable[[int, int], None] | None
) -> Verified:
    """The matches and those that the cameras' poses lead to."""
    least, most, more = RELIEF
    low, high = np.quantile(bundle.points[:, 2], [least, most])
    heights = float(low - more * (high - low)), float(high + more * (high - low))
    seen = np.bincount(bundle.image, minlength=len(bundle)) > 0
    unit, near, found = _unit(bundle), _near(bundle, float(low)), dict(rows)
    for done, (i, j) in enumerate(near):
        reach = (REACH_PX if seen[i] and seen[j] else FAR_REACH_PX) * max(unit[i], unit[j])
        new = _guided(bundle, (i, j), features, heights, reach)
        chance = len(_guided(bundle, (i, j), _displaced(features, j, bundle), heights, reach)) if len(new) else 0
        if len(new) and chance <= BY_CHANCE * len(new):
            found[i, j] = np.unique(np.concatenate([rows.get((i, j), new[:0]), new]), axis=0)
        if progress:
            progress(done + 1, len(near))
    return found


def _unit(bundle: Bundle) -> Array:
    """Pixels [n] of each image in one of the lengths above."""
    return np.array([unit_px(*(2 * lens[1:3])) for lens in bundle.lenses])[bundle.lens_of]


def _near(bundle: Bundle, ground: float) -> list[tuple[int, int]]:
    """Pairs i < j of images that may see common ground at a height: what is in their middles lies near."""
    corner = np.linalg.norm(bundle.lenses[bundle.lens_of, 1:3], axis=1) / bundle.lenses[bundle.lens_of, 0]
    above = np.maximum(bundle.centres[:, 2] - ground, 0)
    ahead = bundle.rotations[:, 2]
    middle = bundle.centres[:, :2] + ahead[:, :2] / np.maximum(-ahead[:, 2:], FLATTEST) * above[:, None]
    near: set[tuple[int, int]] = set()
    for i in range(len(bundle)):
        away = np.linalg.norm(middle - middle[i], axis=1)
        away[i] = np.inf
        partners = np.argsort(away, kind="stable")[:NEAREST]
        partners = partners[away[partners] < FOOTPRINTS_APART * 2 * corner[i] * above[i]]
        near |= {(min(i, j), max(i, j)) for j in partners.tolist()}
    return sorted(near)


def _guided(
    bundle: Bundle, pair: tuple[int, int], features: Sequence[Features], heights: tuple[float, float], reach: float
) -> NDArray[np.uint32]:
    looks = features[pair[0]][1], features[pair[1]][1]
    pixels = features[pair[0]][0][: len(looks[0])], features[pair[1]][0][: len(looks[1])]
    return guided_matches(bundle, pair, pixels, looks, heights, reach)


def _displaced(features: Sequence[Features], j: int, bundle: Bundle) -> list[Features]:
    """The features, with the key points of image j where they are not: what is found there is found by chance."""
    size = 2 * bundle.lenses[bundle.lens_of[j], 1:3]
    moved = list(features)
    moved[j] = (features[j][0] + DISPLACED * size) % size, features[j][1]
    return moved
