"""Ties: points in three images, which hand the length of one base on to the next.

Two images that share points tell their base only against the ground below. Along a line with 50 % overlap hardly any
point is in three images, and the one or two that seem to be are as likely wrong as right: nothing checks them, and yet
they outweigh GPS. Four can check each other.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from overfly.geometry import Array
from overfly.mapping.bundle import Bundle, Index

FEWEST = 4
"""Points that three images must have in common."""

SHARE = 0.02
"""Or this share of what two of them have: of verified matches about a hundredth is wrong."""

LONGEST = 8
"""Tracks through more images are not questioned: these overlap many times."""


def unchecked_ties(bundle: Bundle, placed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The rays [k] to leave out so that no base hangs on points that nothing checks.

    Args:
        bundle: adjusted, without rays that miss their point.
        placed: images [n] whose GPS position is known. Tracks through others stay whole: nothing else holds these.

    Returns:
        Of tracks through three images and more the rays of images that are in no firm triple of it. Of a track without
        any the two images with most points in common keep theirs.
    """
    out = np.zeros(len(bundle.image), bool)
    tracks = _tracks(bundle, placed)
    if not tracks:
        return out
    n = len(bundle)
    codes = [_code(bundle.image[rays], three, n) for rays in tracks for three in _choices(rays, 3)]
    triples, counts = np.unique(np.concatenate(codes), return_counts=True)
    links = bundle.links()
    pairs = np.array([i * n + j for i, j in links] or [-1])
    common = np.array(list(links.values()) or [0])
    firm = (counts >= FEWEST) | (counts >= SHARE * _most(triples, n, pairs, common))
    for rays in tracks:
        images = bundle.image[rays]
        good = np.zeros(rays.shape, bool)
        for three in _choices(rays, 3):
            good[:, three] |= firm[np.searchsorted(triples, _code(images, three, n))][:, None]
        twos = _choices(rays, 2)
        most = np.argmax([common[np.searchsorted(pairs, _code(images, two, n))] for two in twos], axis=0)
        loose = ~good.any(1)
        good[np.flatnonzero(loose)[:, None], np.array(twos)[most[loose]]] = True
        out[rays[~good]] = True
    return out


def hung_on_gps(bundle: Bundle) -> NDArray[np.bool_]:
    """Images [n] that share points with others, but none in three images: GPS alone tells their bases."""
    views = np.bincount(bundle.point, minlength=len(bundle.points))[bundle.point]
    tied = np.bincount(bundle.image[views >= 3], minlength=len(bundle)) > 0
    return np.asarray(~tied & (np.bincount(bundle.image, minlength=len(bundle)) > 0))


def _tracks(bundle: Bundle, placed: NDArray[np.bool_]) -> list[Index]:
    """Rays [t, s] of the tracks in question, images ascending, a table for each length s."""
    order = np.lexsort((bundle.image, bundle.point))
    length = np.bincount(bundle.point, minlength=len(bundle.points))
    known = np.bincount(bundle.point[~placed[bundle.image]], minlength=len(bundle.points)) == 0
    start = np.cumsum(length) - length
    found = []
    for size in range(3, LONGEST + 1):
        first = start[known & (length == size)]
        if len(first):
            found.append(order[first[:, None] + np.arange(size)])
    return found


def _choices(rays: Index, count: int) -> list[list[int]]:
    return [list(chosen) for chosen in combinations(range(rays.shape[1]), count)]


def _code(images: Index, chosen: list[int], n: int) -> Index:
    """One number for the chosen columns of images [t, s]."""
    code = np.zeros(len(images), np.intp)
    for column in chosen:
        code = code * n + images[:, column]
    return code


def _most(triples: Index, n: int, pairs: Index, common: Index) -> Array:
    """The largest number of points that two images of each triple have in common."""
    i, j, k = triples // (n * n), triples // n % n, triples % n
    counts = [common[np.searchsorted(pairs, a * n + b)] for a, b in ((i, j), (j, k), (i, k))]
    return np.asarray(np.max(counts, axis=0), float)
