"""How many images of a flight will be placed, before any two of them are matched."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from overfly.geometry import Array
from overfly.preflight.images import Look

BLUR_OF_NO_USE = 0.25
"""Sharpness relative to the flight's median from which on an image is matched as well as its overlap allows."""

HALF_LINKED, SOFTNESS = 0.15, 0.03
"""Shared usable ground at which two images are linked in half of the cases, and how fast this changes: the first by
thirty rendered flights, most of them spoilt; ``benchmarks/registration.py`` measures it on others."""

FACING_DEG, APART_DEG = 20.0, 50.0
"""Between views that differ by less than the first, overlap alone decides; by more than the second nothing matches."""


def facing(directions: Array) -> Array:
    """How much of their overlap images can match, by the angle between their viewing directions [n, 3] -> [n, n]."""
    angles = np.degrees(np.arccos(np.clip(directions @ directions.T, -1, 1)))
    return np.asarray(np.clip((APART_DEG - angles) / (APART_DEG - FACING_DEG), 0, 1))


def usable_shares(looks: Sequence[Look], sharpness: Array) -> Array:
    """The part of each picture that can be matched [n]: textured, not clipped, sharp; 0 where it cannot be decoded.

    Args:
        looks: at n images.
        sharpness: of each relative to the flight's median [n]; NaN counts as sharp.
    """
    flat, clipped = (np.array(v, float) for v in ([x.flat for x in looks], [x.dark + x.bright for x in looks]))
    seen = np.array([look.error is None for look in looks])
    sharp = np.clip(np.nan_to_num(sharpness, nan=1.0) / BLUR_OF_NO_USE, 0, 1)
    return np.asarray(np.where(seen, (1 - np.nan_to_num(flat)) * np.clip(1 - np.nan_to_num(clipped), 0, 1) * sharp, 0))


def chances(overlaps: Array, usable: Array) -> Array:
    """The chance of each image to be placed with most of the others [n].

    An image is as well placed as the weakest link on the best way from it to the best linked image.

    Args:
        overlaps: share of footprint i inside footprint j [n, n].
        usable: the part of each picture that can be matched [n].
    """
    links = np.minimum(overlaps, overlaps.T) * np.sqrt(usable[:, None] * usable)
    np.fill_diagonal(links, 0)
    # The best ways run along the maximum spanning tree; scipy drops zeros, so that links are turned to costs above 1.
    tree = minimum_spanning_tree(csr_array(np.where(links > 0, 2 - links, 0)))
    tree = tree + tree.T
    root = int(links.sum(1).argmax())
    weakest = np.zeros(len(links))
    weakest[root] = links[root].max()
    order, before = breadth_first_order(tree, root)
    for i in order[1:]:
        weakest[i] = min(weakest[before[i]], 2 - tree[before[i], i])
    return np.asarray(1 / (1 + np.exp(-(weakest - HALF_LINKED) / SOFTNESS)))


def placed_chances(names: Sequence[str], usable: Array, placed: Sequence[str], overlaps: Array | None) -> Array:
    """The chance of each image of a flight to be placed [n].

    Args:
        names: of the n images.
        usable: the part of each picture that can be matched [n].
        placed: names of those whose footprint is known.
        overlaps: of these among each other; None where no footprint is known: overlap is then taken as enough.
    """
    if overlaps is None or len(placed) < 2:
        return chances(np.ones((len(names), len(names))), usable)
    # Images without a position are taken to overlap as the median one does.
    best = np.minimum(overlaps, overlaps.T) - np.eye(len(placed))
    known = {name: i for i, name in enumerate(placed)}
    at = np.array([known.get(name, -1) for name in names])
    whole = np.where((at[:, None] >= 0) & (at >= 0), overlaps[at[:, None], at], float(np.median(best.max(1))))
    return chances(whole, usable)
