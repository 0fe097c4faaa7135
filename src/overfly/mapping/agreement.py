"""Verified matches held against GPS and gimbals: pairs that contradict them are dropped, pairs that agree are added.

Free two-view geometry verifies a dozen wrong matches of two frames that see nothing in common, and one such pair bends
a flight whose frames overlap little; of pairs with few right matches among many wrong ones it verifies none. Near the
priors (:mod:`overfly.mapping.relative`) both are told apart.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from overfly.mapping.database import read_matches, read_pixels, read_verified, rewrite_matches
from overfly.mapping.overlays import Prior
from overfly.mapping.relative import agreeing

STRONG, STRONG_SHARE = 50, 0.5
"""Verified matches, and their share of all, of pairs that are right beyond doubt: they judge the priors."""

SUPPORTED = 0.5
"""Share of a pair's verified matches that must agree with the priors."""

BELIEVED = 0.7
"""Share of a frame's strong pairs that must be supported, or nothing is held against its prior."""

ENOUGH = 15
"""Agreeing matches of a pair that COLMAP's verification takes, too."""

Matches = dict[tuple[int, int], NDArray[np.uint32]]


class Agreement(NamedTuple):
    """What agrees with the priors of a flight.

    Attributes:
        verified: rows of key points of each pair: those that agree with the priors, of frames whose priors are
            believed; as they were verified of the others.
        dropped: pairs that were verified and contradict the priors.
        added: pairs that were not, and of which enough matches agree.
    """

    verified: Matches
    dropped: list[tuple[int, int]]
    added: list[tuple[int, int]]


def agreement(database: Path, names: Sequence[str], priors: Sequence[Prior | None], seed: int) -> Agreement:
    """Hold the matches of a database against the priors.

    A frame's prior is believed unless its strong pairs with others contradict it: GPS, compass or gimbal of single
    frames and of whole lines may be wrong.

    Args:
        database: of matches, verified or not.
        names: of the flight's frames.
        priors: where each was roughly taken from.
        seed: of the draws.
    """
    verified = {pair: rows for pair, rows in read_verified(database, names).items() if len(rows)}
    known = [i for i, prior in enumerate(priors) if prior is not None]
    if len(known) < 2:
        return Agreement(verified, [], [])
    pixels = read_pixels(database, names)
    raw, agree = read_matches(database, names), Matches()
    for (i, j), rows in raw.items():
        first, second = priors[i], priors[j]
        if first is not None and second is not None and len(rows):
            agree[i, j] = rows[agreeing(first, second, (pixels[i][rows[:, 0]], pixels[j][rows[:, 1]]), seed)]
    supported = {pair: _share(verified[pair], rows) >= SUPPORTED for pair, rows in agree.items() if pair in verified}
    strong = {p: good for p, good in supported.items() if len(verified[p]) >= max(STRONG, STRONG_SHARE * len(raw[p]))}
    believed = _believed(strong, len(names))
    result = dict(verified)
    dropped, added = [], []
    for (i, j), rows in agree.items():
        if not (believed[i] and believed[j]):
            continue
        if (i, j) not in verified:
            if len(rows) >= ENOUGH:
                added.append((i, j))
        elif not supported[i, j]:
            dropped.append((i, j))
        if len(rows):
            result[i, j] = rows
        elif (i, j) in verified:
            del result[i, j]
    return Agreement(result, dropped, added)


def _believed(strong: dict[tuple[int, int], bool], frames: int) -> NDArray[np.bool_]:
    """Which frames have priors that their strong pairs support; a frame that is not believed judges no other."""
    believed = np.ones(frames, bool)
    while True:
        pairs, right = np.zeros(frames), np.zeros(frames)
        for pair, good in strong.items():
            if believed[list(pair)].all():
                pairs[list(pair)] += 1
                right[list(pair)] += good
        share = np.where(pairs > 0, right / np.maximum(pairs, 1), 1.0)
        if (share >= BELIEVED).all():
            return believed
        believed[share.argmin()] = False


def rewritten(database: Path, names: Sequence[str], found: Agreement, seed: int) -> Path:
    """A copy of the database, in which pairs that contradict the priors hold what agrees, and pairs that agree are."""
    copy = database.with_name(f"{database.stem}_agreeing.db")
    shutil.copyfile(database, copy)
    changed = [*found.dropped, *found.added]
    rewrite_matches(copy, names, {pair: found.verified.get(pair) for pair in changed}, seed=seed)
    return copy


def _share(rows: NDArray[np.uint32], others: NDArray[np.uint32]) -> float:
    """Share of rows [m, 2] that are among others [k, 2]."""
    own, other = (r[:, 0].astype(np.int64) << 32 | r[:, 1] for r in (rows, others))
    return float(np.isin(own, other).mean())
