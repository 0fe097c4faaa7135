"""Positions held against what the pictures tell: which of them the pictures excuse, and which they accuse."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from itertools import pairwise

import numpy as np

from overfly.geometry import Array
from overfly.preflight.track import OFF_TRACK

LEAST_PAIRS = 3
"""Pairs of neighbours that must agree on the scale before the pictures say anything."""

AGREE, CONTRADICT = 0.2, 0.35
"""Difference of both displacements, relative to that of the positions: up to the first slopes, trees and houses make
it, from the second on they do not."""

TIMES_CONTRADICT = 1.5
"""Contradictions are at least so many times :data:`OFF_TRACK`, as two positions err."""

LONGEST = 5
"""Images in a row that are off by the same, at most; a longer run may be the true one."""

RELIABLE = 1 / 3
"""Share of neighbours that must agree before pictures accuse: where fewer overlap, chance matches are as many."""

Displacement = Callable[[int, int], Array | None]


class Evidence:
    """The positions of n images against the displacements that their pictures tell.

    Pictures tell displacements as multiples of the height over ground, which is known badly: the scale is taken from
    all pairs of neighbours, of which most must be right.
    """

    def __init__(self, xy: Array, displacement: Displacement) -> None:
        """Take positions.

        Args:
            xy: in the order of the flight [n, 2], metres.
            displacement: from image i to image j [2] by their pictures; None where these do not tell.
        """
        self.xy, self._displacement = xy, displacement
        self._seen: dict[tuple[int, int], Array | None] = {}
        self.scale = self._scale()

    def _pictures(self, i: int, j: int) -> Array | None:
        if (i, j) not in self._seen:
            self._seen[i, j] = self._displacement(i, j)
        return self._seen[i, j]

    def _scale(self) -> float | None:
        ratios = []
        for i, j in pairwise(range(len(self.xy))):
            told, seen = self.xy[j] - self.xy[i], self._pictures(i, j)
            if seen is not None and (long := float(seen @ seen)) > 0:
                ratios.append(float(told @ seen) / long)
        if len(ratios) < LEAST_PAIRS or (middle := float(np.median(ratios))) <= 0:
            return None
        agreeing = np.abs(np.array(ratios) / middle - 1) < AGREE
        return middle if agreeing.sum() >= max(LEAST_PAIRS, len(ratios) / 2) else None

    def difference(self, i: int, j: int) -> Array | None:
        """Displacement by the positions less that by the pictures [2], metres; None where these tell nothing."""
        if self.scale is None or not 0 <= i < j < len(self.xy):
            return None
        seen = self._pictures(i, j)
        return None if seen is None else np.asarray(self.xy[j] - self.xy[i] - self.scale * seen)

    def agree(self, i: int, j: int) -> bool:
        """Whether the pictures tell the same displacement as the positions."""
        off = self.difference(i, j)
        return off is not None and float(np.linalg.norm(off)) <= max(OFF_TRACK, AGREE * self._apart(i, j))

    def contradict(self, i: int, j: int) -> bool:
        """Whether the pictures clearly tell another displacement than the positions."""
        off = self.difference(i, j)
        if off is None:
            return False
        return float(np.linalg.norm(off)) > max(TIMES_CONTRADICT * OFF_TRACK, CONTRADICT * self._apart(i, j))

    def _apart(self, i: int, j: int) -> float:
        """The longer of both displacements, so that a wrong position does not shrink what is allowed."""
        seen = self._pictures(i, j)
        by_pictures = 0.0 if seen is None or self.scale is None else self.scale * float(np.linalg.norm(seen))
        return max(float(np.linalg.norm(self.xy[j] - self.xy[i])), by_pictures)

    def excused(self, suspects: Sequence[tuple[int, float]], wrong: Collection[int] = ()) -> set[int]:
        """Which suspects (image, metres off) the pictures join to an image that is beyond suspicion.

        Args:
            suspects: whose positions the track does not explain.
            wrong: further images that give no excuse.
        """
        off = {k: away for k, away in suspects if k not in wrong}
        excused: set[int] = set()
        waiting = True
        while waiting:
            waiting = False
            for k in off.keys() - excused:
                beside = [j for j in (k - 2, k - 1, k + 1, k + 2) if j not in wrong and (j not in off or j in excused)]
                pairs = [(min(j, k), max(j, k)) for j in beside]
                # A picture that agrees no better than the track does excuses nothing.
                good = [pair for pair in pairs if self.agree(*pair) and self._miss(*pair) < off[k] / 2]
                if good and not any(self.contradict(*pair) for pair in pairs if pair[1] - pair[0] == 1):
                    excused.add(k)
                    waiting = True
        return excused

    def _miss(self, i: int, j: int) -> float:
        off = self.difference(i, j)
        return np.inf if off is None else float(np.linalg.norm(off))

    def accused(self) -> list[tuple[int, float]]:
        """Images that two pairs of pictures tell to be off alike while none contradicts it, and by how many metres.

        One pair of pictures may be matched wrongly; that two of them err by the same, one to and one from the image,
        is not seen to happen. At most a quarter of the images.
        """
        count = len(self.xy)
        if sum(self.agree(i, i + 1) for i in range(count - 1)) < RELIABLE * (count - 1):
            return []
        against = [i for i in range(count - 1) if self.contradict(i, i + 1)]
        found: dict[int, float] = {}
        for length in range(1, min(LONGEST, count // 4) + 1):
            for first in sorted({start for i in against for start in (i + 1, i - length + 1)}):
                run = range(first, first + length)
                if first < 0 or run[-1] >= count or found.keys() & set(run):
                    continue
                if (off := self._off(run)) is not None:
                    found |= dict.fromkeys(run, off)
        most = count // 4
        return sorted(found.items(), key=lambda entry: -entry[1])[:most]

    def _off(self, run: range) -> float | None:
        """How far a run of images is off by all pairs across its ends, metres; None where these do not tell alike.

        Within the run the pictures must agree with the positions.
        """
        before, after = run[0] - 1, run[-1] + 1
        pairs = {(before, run[0]): 1, (before - 1, run[0]): 1, (run[-1], after): -1, (run[-1], after + 1): -1}
        if len(run) > 1:
            pairs |= {(before, run[1]): 1, (run[-2], after): -1}
        if any(self.agree(*pair) for pair in pairs) or not all(self.agree(i, j) for i, j in pairwise(run)):
            return None
        offs = [sign * off for pair, sign in pairs.items()
                if self.contradict(*pair) and (off := self.difference(*pair)) is not None]  # fmt: skip
        if len(offs) < 2:
            return None
        middle = np.median(offs, axis=0)
        size = float(np.linalg.norm(middle))
        alike = [float(np.linalg.norm(off - middle)) <= max(OFF_TRACK, CONTRADICT * size) for off in offs]
        return size if all(alike) else None
