"""One photograph for each face of a mesh, alike over large connected parts: charts of the texture, with few seams."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from overfly.mapping.face_views import CANDIDATES, Candidates

SPREAD = 16
"""Rounds in which worth is averaged over neighbours: the scale, in faces, of what may have a chart of its own."""

ROUNDS = 24
"""Rounds in which faces choose anew."""

TOGETHER = 0.5
"""What agreement with all three neighbours is worth, where the best photograph is worth 1."""

FEWEST = 40
"""Faces of a chart that may stay; smaller ones join their neighbours where these see them."""

ENOUGH = 0.25
"""Worth, as a share of the best photograph's, below which no face joins its neighbours."""


def choose(candidates: Candidates, neighbours: NDArray[np.int32]) -> NDArray[np.int32]:
    """The photograph of each face [F], -1 where none sees it.

    Args:
        candidates: of the F faces.
        neighbours: [F, 3], -1 where there is none.
    """
    photo, worth = candidates
    best = worth.max(1)
    share = worth / np.maximum(best, 1e-30)[:, None]
    good = share >= ENOUGH
    value = _spread(photo, share, neighbours)
    label = _picked(photo, value, good)
    turn = np.random.default_rng(0)
    for _ in range(ROUNDS):
        # Faces that all choose at once could change places forever: half of them do.
        asked = turn.random(len(photo)) < 0.5
        agree = _agreement(photo, label, neighbours)
        label = np.where(asked, _picked(photo, value + TOGETHER * agree, good), label)
    for _ in range(ROUNDS):
        small = _small(label, neighbours)
        if not small.any():
            break
        agree = _agreement(photo, np.where(small, -2, label), neighbours)
        joins = small & ((agree > 0) & good).any(1)
        if not joins.any():
            break
        label = np.where(joins, _picked(photo, agree + 1e-3 * share, good & (agree > 0)), label)
    return label


def charts(label: NDArray[np.int32], neighbours: NDArray[np.int32]) -> NDArray[np.int32]:
    """The chart of each face [F], counted from 0: connected faces with one label."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    face, side = np.nonzero((neighbours >= 0) & (label[neighbours] == label[:, None]))
    joined = coo_array((np.ones(len(face), bool), (face, neighbours[face, side])), shape=(len(label), len(label)))
    return np.asarray(connected_components(joined, directed=False)[1], np.int32)


def _spread(photo: NDArray, share: NDArray, neighbours: NDArray) -> NDArray[np.float32]:
    """Worth averaged over neighbours; one that the photograph does not see counts as 0."""
    value: NDArray[np.float32] = share.astype(np.float32)
    known = neighbours >= 0
    count = 1 + known.sum(1, keepdims=True, dtype=np.float32)
    # The place of a candidate among the neighbour's, the same in every round; the spare last one holds 0.
    place = np.full((len(photo), 3, CANDIDATES), CANDIDATES, np.int32)
    for k in range(CANDIDATES):
        same = (photo[neighbours] == photo[:, None, k, None]) & known[..., None] & (photo[:, k] >= 0)[:, None, None]
        place[:, :, k] = np.where(same.any(2), same.argmax(2), CANDIDATES)
    place += np.maximum(neighbours, 0)[..., None] * np.int32(CANDIDATES + 1)
    for _ in range(SPREAD):
        padded = np.pad(value, ((0, 0), (0, 1))).ravel()
        for side in range(3):
            value += padded[place[:, side]]
        value /= count
    return value


def _agreement(photo: NDArray, label: NDArray, neighbours: NDArray) -> NDArray[np.float32]:
    """Share of the three neighbours that have each candidate as their label [F, CANDIDATES]."""
    around = np.where(neighbours >= 0, label[neighbours], -2)
    agree = np.zeros(photo.shape, np.float32)
    for side in range(3):
        agree += (photo == around[:, side, None]) & (photo >= 0)
    return agree / np.float32(3)


def _picked(photo: NDArray, value: NDArray, allowed: NDArray) -> NDArray[np.int32]:
    """The candidate with the largest value [F]; the first of equal ones."""
    at = np.where(allowed & (photo >= 0), value, -1).argmax(1)
    return np.asarray(photo[np.arange(len(photo)), at])


def _small(label: NDArray, neighbours: NDArray) -> NDArray[np.bool_]:
    """Faces of charts that are too small to stay [F]."""
    chart = charts(label, neighbours)
    return np.asarray((np.bincount(chart) < FEWEST)[chart] & (label >= 0))
