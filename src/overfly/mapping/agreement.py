"""Verified matches held against GPS and gimbals: pairs that contradict them are dropped, pairs that agree are added.

Free two-view geometry verifies a dozen wrong matches of two frames that see nothing in common, and one such pair bends
a flight whose frames overlap little; of pairs with few right matches among many wrong ones it verifies none. Near the
priors (:mod:`overfly.mapping.relative`) both are told apart.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from overfly.mapping.database import read_matches, read_pixels, read_verified, rewrite_matches
from overfly.mapping.model import FEWEST_MATCHES
from overfly.mapping.overlays import Prior
from overfly.mapping.relative import agreeing, comparable

STRONG, STRONG_SHARE = 50, 0.5
"""Verified matches, and their share of all, of pairs that are right beyond doubt: they judge the priors."""

SUPPORTED = 0.5
"""Share of a pair's verified matches that must agree with the priors."""

BELIEVED = 0.7
"""Share of a frame's strong pairs, and of the flight's, that must be supported, or no match is held against priors."""

Matches = dict[tuple[int, int], NDArray[np.uint32]]


class Agreement(NamedTuple):
    """What agrees with the priors of a flight.

    Attributes:
        verified: rows of key points of each pair: those that agree with the priors, of frames whose priors are
            believed; as they were verified of the others.
        dropped: pairs that were verified and contradict the priors; few of their matches may still agree.
        added: pairs that were not, and of which enough matches agree.
        believed: [n] the frames whose priors matches are held against.
    """

    verified: Matches
    dropped: list[tuple[int, int]]
    added: list[tuple[int, int]]
    believed: NDArray[np.bool_]

    def sure(self) -> dict[tuple[int, int], int]:
        """How many matches agree, of pairs of believed frames with enough of them: what right models keep."""
        return {
            pair: len(rows)
            for pair, rows in self.verified.items()
            if len(rows) >= FEWEST_MATCHES and self.believed[list(pair)].all()
        }


def agreement(
    database: Path,
    names: Sequence[str],
    priors: Sequence[Prior | None],
    seed: int,
    progress: Callable[[int, int], None] | None = None,
) -> Agreement:
    """Hold the matches of a database against the priors.

    A frame's prior is believed if matches of some pair agree with it, and its strong pairs do not contradict it: GPS,
    compass or gimbal of single frames and of whole lines may be wrong. None is if most strong pairs contradict.

    Args:
        database: of matches, verified or not.
        names: of the flight's frames.
        priors: where each was roughly taken from.
        seed: of the draws.
        progress: called with (pairs, in all).
    """
    verified = {pair: rows for pair, rows in read_verified(database, names).items() if len(rows)}
    pixels, raw = read_pixels(database, names), read_matches(database, names)
    agree = Matches()
    for done, ((i, j), rows) in enumerate(raw.items()):
        first, second = priors[i], priors[j]
        if first is not None and second is not None and len(rows) and comparable(first, second):
            agree[i, j] = rows[agreeing(first, second, (pixels[i][rows[:, 0]], pixels[j][rows[:, 1]]), seed)]
        if progress:
            progress(done + 1, len(raw))
    supported = {pair: _share(verified[pair], rows) >= SUPPORTED for pair, rows in agree.items() if pair in verified}
    strong = {p: good for p, good in supported.items() if len(verified[p]) >= max(STRONG, STRONG_SHARE * len(raw[p]))}
    believed = _believed([pair for pair, rows in agree.items() if len(rows)], strong, len(names))
    result = dict(verified)
    dropped, added = [], []
    for (i, j), rows in agree.items():
        if not (believed[i] and believed[j]):
            continue
        if (i, j) not in verified:
            if len(rows) >= FEWEST_MATCHES:
                added.append((i, j))
        elif not supported[i, j]:
            dropped.append((i, j))
        if len(rows):
            result[i, j] = rows
        elif (i, j) in verified:
            del result[i, j]
    return Agreement(result, dropped, added, believed)


def _believed(agreed: Sequence[tuple[int, int]], strong: dict[tuple[int, int], bool], frames: int) -> NDArray[np.bool_]:
    """Which frames [n] have priors that some pair agrees with and their strong pairs support.

    A frame that is not believed judges no other.
    """
    believed = np.zeros(frames, bool)
    if sum(strong.values()) < BELIEVED * len(strong):
        return believed
    believed[np.unique(np.array(agreed, int).reshape(-1))] = True
    ends, good = np.array(list(strong), int).reshape(-1, 2), np.array(list(strong.values()), bool)
    while True:
        counted = believed[ends].all(1)
        pairs, right = (np.bincount(ends[c].reshape(-1), minlength=frames) for c in (counted, counted & good))
        share = np.where(believed & (pairs > 0), right / np.maximum(pairs, 1), 1.0)
        if (share >= BELIEVED).all():
            return believed
        believed[share.argmin()] = False


def rewritten(database: Path, names: Sequence[str], found: Agreement, seed: int) -> Path:
    """A copy of the database without the pairs that contradict the priors, and with those that agree."""
    copy = database.with_name(f"{database.stem}_agreeing.db")
    for stale in ("", "-wal", "-shm"):  # of a run that was killed: its changes would be made to the new copy, too
        copy.with_name(copy.name + stale).unlink(missing_ok=True)
    with closing(sqlite3.connect(database)) as source, closing(sqlite3.connect(copy)) as target:
        source.backup(target)
    changed = [*found.dropped, *found.added]
    rewrite_matches(copy, names, {pair: found.verified.get(pair) for pair in changed}, seed=seed)
    return copy


def _share(rows: NDArray[np.uint32], others: NDArray[np.uint32]) -> float:
    """Share of rows [m, 2] that are among others [k, 2]."""
    own, other = (r[:, 0].astype(np.int64) << 32 | r[:, 1] for r in (rows, others))  # one number for each row
    return float(np.isin(own, other).mean())
