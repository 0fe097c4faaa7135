"""Ties: points in three images and more, which hand the length of one base on to the next.

Two images that share points tell their base only against the ground below. Along a line with 50 % overlap hardly any
point is in three images, and the one or two that seem to be are as likely wrong as right: nothing checks them, and yet
they outweigh GPS. Where an image has many, they check each other.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from overfly.mapping.bundle import Bundle

FEWEST, SHARE = 4, 0.01
"""Ties that an image must have, and their share of its rays: of verified matches about a hundredth is wrong."""

LEFT = 8
"""Rays that an image must have besides, or it keeps its ties: they may be what places it."""


def unchecked_ties(bundle: Bundle, placed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The rays [k] to leave out so that no base hangs on points that nothing checks.

    Args:
        bundle: adjusted, without rays that miss their point.
        placed: images [n] whose GPS position is known. Tracks through others stay whole: nothing else holds these.

    Returns:
        Of tracks through three images and more, the rays of images that have too few such tracks, but :data:`LEFT` rays
        besides. Where fewer than two others would be left of a track, the two images with most points in common keep
        theirs.
    """
    n, m = len(bundle), len(bundle.points)
    length = np.bincount(bundle.point, minlength=m)
    rays = np.bincount(bundle.image, minlength=n)
    known = np.bincount(bundle.point[~placed[bundle.image]], minlength=m) == 0
    weak, before, left = np.zeros(n, bool), -1, length
    while before < weak.sum():  # what one image loses may have been a tie of another
        before = int(weak.sum())
        ties = np.bincount(bundle.image[(left >= 3)[bundle.point] & ~weak[bundle.image]], minlength=n)
        weak |= placed & (ties < np.maximum(FEWEST, SHARE * rays)) & (rays - ties >= LEFT)
        out = (length >= 3)[bundle.point] & weak[bundle.image] & known[bundle.point]
        left = length - np.bincount(bundle.point[out], minlength=m)
    links = bundle.links()
    start = np.cumsum(length) - length  # rays are ordered by point
    for point in np.flatnonzero((left < 2) & (length >= 3)).tolist():
        own = range(start[point], start[point] + length[point])
        image = bundle.image[own].tolist()
        common: dict[tuple[int, int], int] = {
            (a, b): links[min(i, j), max(i, j)] for a, i in zip(own, image) for b, j in zip(own, image) if a < b
        }
        out[own] = True
        out[list(max(common.items(), key=lambda item: item[1])[0])] = False
    return out


def untied(bundle: Bundle) -> NDArray[np.bool_]:
    """Images [n] that share points with others two at a time only: nothing but their positions tells their bases."""
    views = np.bincount(bundle.point, minlength=len(bundle.points))[bundle.point]
    tied = np.bincount(bundle.image[views >= 3], minlength=len(bundle)) > 0
    return np.asarray(~tied & (np.bincount(bundle.image, minlength=len(bundle)) > 0))


def placed_by_others(bundle: Bundle, sure: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Images [n] whose places images alone tell: the sure ones, and those tied to two of them, one after another.

    Points that an image shares with one other tell in which direction it stands, not how far away: whatever its GPS
    says, nothing contradicts it.
    """
    told, before = sure.copy(), -1
    while before < told.sum():
        before = int(told.sum())
        seen_by = np.bincount(bundle.point[told[bundle.image]], minlength=len(bundle.points))
        ties = np.bincount(bundle.image[(seen_by >= 2)[bundle.point]], minlength=len(bundle))
        told |= ties >= FEWEST
    return told
