"""Where a flight goes and which of its positions do not belong to it, from the positions alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from overfly.geometry import Array

OFF_TRACK = 8.0
"""Metres: less than this off the track is within what receivers without RTK do."""

TIMES_USUAL = 6.0
"""An outlier is this many times further off than the flight's images usually are."""

ALONG_DEG, ACROSS_DEG = 20.0, 30.0
"""Steps nearer to the direction of the lines than the first go along a line, further off than the second turn."""

LEAST_ALONG, LEAST_BOTH = 0.4, 0.6
"""Share of steps along one direction, and along two that cross, from which a flight consists of lines."""

LEAST_SECOND = 0.2
"""Share of steps on lines across the others from which they are lines of their own."""

NEAR = 6
"""Steps around a position that tell to which lines it belongs."""

SPACINGS_DIFFER = 0.15
"""By how much of itself a turn differs from those of lines in another direction."""

MORE_THAN_ELSEWHERE = 1.5
"""Where a flight has no lines, its ends may turn so many times more than it does elsewhere."""


def off_track(xy: Array, seconds: Array | None = None) -> Array:
    """How far each of n positions [n, 2] is from where its neighbours in the flight expect it, metres [n].

    The least of three answers counts: between both neighbours, and onwards from the two before and from the two after;
    so corners of the track are no faults. With times [n] the neighbours' speed is used. Infinite below three positions.
    """
    return np.asarray(_answers(xy, seconds).min(0))


def _answers(xy: Array, seconds: Array | None = None) -> Array:
    """The three answers of :func:`off_track` [3, n]: between, from before, from after; inf where there is none."""
    t = np.arange(len(xy), dtype=float) if seconds is None else seconds
    away = np.full((3, len(xy)), np.inf)
    index = np.arange(len(xy))
    for row, (before, after) in enumerate(((-1, 1), (-2, -1), (1, 2))):
        i = index[(index + before >= 0) & (index + after < len(xy))]
        a, b = i + before, i + after
        share = (t[i] - t[a]) / (t[b] - t[a])
        expected = xy[a] + (xy[b] - xy[a]) * share[:, None]
        away[row, i] = np.linalg.norm(xy[i] - expected, axis=1)
    return away


@dataclass(frozen=True, eq=False)
class Layout:
    """A flight of n positions as parallel lines.

    Attributes:
        places: along and across the lines [n, 2], metres.
        ahead: direction of the lines, east and north [2].
        step: usual distance along a line.
        lines: whether the step from each position to the next goes along a line [n - 1].
        turns: whether the step from each position to the next leads to another line [n - 1].
    """

    places: Array
    ahead: Array
    step: float
    lines: NDArray[np.bool_]
    turns: NDArray[np.bool_]

    @property
    def moved(self) -> Array:
        """How far each step goes along and across the lines, without sign [n - 1, 2]."""
        return np.abs(np.diff(self.places, axis=0))

    @property
    def back(self) -> NDArray[np.bool_]:
        """Positions [n] to another line and straight back again: errors, not turns."""
        found = np.zeros(len(self.places), bool)
        across = self.moved[:, 1]
        found[1:-1] = np.abs(self.places[2:, 1] - self.places[:-2, 1]) < np.minimum(across[1:], across[:-1]) / 2
        found[1:-1] &= self.turns[1:] & self.turns[:-1]
        return found

    @property
    def known(self) -> NDArray[np.bool_]:
        """Turns that others may follow as a precedent [n - 1]."""
        return np.asarray(self.turns & ~self.back[1:] & ~self.back[:-1])

    @property
    def beside(self) -> NDArray[np.bool_]:
        """Steps before or after one along a line [n - 1]."""
        padded = np.pad(self.lines, 1)
        return np.asarray(padded[:-2] | padded[2:])

    def reversed(self) -> Layout:
        """The same flown from its end to its start."""
        return replace(self, places=self.places[::-1], lines=self.lines[::-1], turns=self.turns[::-1])


def layouts_of(xy: Array) -> list[Layout]:
    """The lines of positions [n, 2], one layout for each direction flown.

    Empty where less than :data:`LEAST_ALONG` of the steps share a direction, or :data:`LEAST_BOTH` two that cross.
    """
    steps = np.diff(xy, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    if (lengths > 0).sum() < 3:
        return []
    bearing = np.where(lengths > 0, np.arctan2(steps[:, 0], steps[:, 1]), np.nan)
    alike = np.abs((bearing[:, None] - bearing + np.pi / 2) % np.pi - np.pi / 2) < np.radians(ALONG_DEG)
    best = alike[int(alike.sum(1).argmax())]
    found = [_layout(xy, steps, lengths, best)]
    across = np.abs((bearing - np.arctan2(*found[0].ahead) + np.pi) % np.pi - np.pi / 2) < np.radians(ALONG_DEG)
    if (across[1:] & across[:-1]).sum() >= max(2, LEAST_SECOND * len(steps)):  # turns follow one by one on lines
        found.append(_layout(xy, steps, lengths, across))
    least = LEAST_ALONG if len(found) == 1 else LEAST_BOTH
    return found if np.mean([one.lines for one in found]) * len(found) >= least else []


def _layout(xy: Array, steps: Array, lengths: Array, along_line: NDArray[np.bool_]) -> Layout:
    bearing = np.arctan2(steps[along_line, 0], steps[along_line, 1])
    # Directions that differ by half a turn are one: the mean is that of doubled angles.
    angle = float(np.angle(np.exp(2j * bearing).mean()) / 2)
    axes = np.array([[np.sin(angle), np.cos(angle)], [np.cos(angle), -np.sin(angle)]])
    along, across = np.abs(steps @ axes.T).T
    turns = (across > np.tan(np.radians(ACROSS_DEG)) * along) & (across > OFF_TRACK)
    return Layout(xy @ axes.T, axes[0], float(np.median(lengths[along_line])), along_line, turns)


def by_layouts(layouts: Sequence[Layout]) -> Array:
    """How far each of n positions is from where the layout lets its neighbours go, metres [n]; inf without an answer.

    Lines of one or two images, which pictures left out or the border of the ground make, have no track of their own. A
    position may lie beside its neighbour as far as other lines of the flight do, and may continue such a short line.

    Args:
        layouts: of the same positions, at least one; each position belongs to the lines that are flown around it.
    """
    count = len(layouts[0].places)
    near = np.array([np.convolve(one.lines, np.ones(NEAR), "full")[NEAR // 2 - 1 :][:count] for one in layouts])
    found = np.full((len(layouts), count), np.inf)
    for row, one in zip(found, layouts, strict=True):
        elsewhere = [
            np.zeros((0, 2)),
            *(other.moved[other.known & other.beside] for other in layouts if other is not one),
        ]
        forward = _onwards(one, np.concatenate(elsewhere))
        backward = _onwards(one.reversed(), np.concatenate(elsewhere))
        row[:] = np.minimum(forward, backward[::-1])
    return np.asarray(np.where(near == near.max(0), found, np.inf).min(0))


def _onwards(layout: Layout, elsewhere: Array) -> Array:
    """Off what a turn from the position before, or the first step after such a turn, leads to, metres [n].

    Args:
        layout: of n positions.
        elsewhere: turns along and across other lines [k, 2].
    """
    turns, moved, step, known, back = layout.turns, layout.moved, layout.step, layout.known, layout.back
    away, turned = np.full((2, len(layout.places)), np.inf)
    for i in range(1, len(away)):
        along, across = moved[i - 1]
        own = known.copy()
        own[max(0, i - 1) : i + 1] = False  # no step is its own precedent
        others = np.concatenate([moved[own], elsewhere])
        if turns[i - 1] and not back[i] and len(others):
            # A turn like it, or from the end of a line to any place of the next.
            off = np.linalg.norm(others - moved[i - 1], axis=1)
            off[own.sum() :] -= SPACINGS_DIFFER * float(np.hypot(along, across))
            turned[i] = max(0.0, off.min())
            goes_on = i + 1 == len(away) or (not turns[i] and abs(moved[i, 0] - step) < step / 2)
            if goes_on and (i == 1 or not turns[i - 2]):
                beside = float(np.abs(others[:, 1] - across).min())
                turned[i] = min(turned[i], float(np.hypot(beside, max(0.0, along - step))))
        if turns[i - 1] and i + 1 < len(away):
            # Where no other line tells how far away the next may be, an image onwards and parallel does.
            turned[i] = min(turned[i], float(np.hypot(moved[i, 1], moved[i, 0] - step)))
        if not back[i]:
            away[i] = turned[i]
        if i >= 2 and np.isfinite(turned[i - 1]):
            away[i] = min(away[i], max(turned[i - 1], float(np.hypot(across, along - step))))
    return away


def _by_neighbours(xy: Array, clocks: Sequence[Array]) -> Array:
    return np.asarray(np.minimum.reduce([off_track(xy, clock) for clock in clocks]))


def _away(xy: Array, clocks: Sequence[Array]) -> Array:
    """Off the track as its neighbours, by each clock, or the layout tell: the least counts, metres [n]."""
    away = _by_neighbours(xy, clocks)
    if len(xy) < 4:
        return away
    if layouts := layouts_of(xy):
        return np.minimum(away, by_layouts(layouts))
    # Without lines (orbits, free flights) every image may turn, but the ends have only one neighbour to tell it.
    for ends, row in ((slice(0, 2), 2), (slice(-2, None), 1)):
        others = np.delete(_answers(xy)[row], np.r_[np.arange(len(xy))[ends]])
        usual = MORE_THAN_ELSEWHERE * float(others[np.isfinite(others)].max(initial=0.0))
        away[ends] = np.where(away[ends] <= usual, 0.0, away[ends])
    return np.asarray(away)


def strays(xy: Array, seconds: Array | None) -> list[tuple[int, float]]:
    """Positions [n, 2] off the track and by how many metres, the worst first; at most a quarter of them.

    Near a wrong position right ones look wrong too: of it and its neighbours the one is meant without which the rest of
    the track is smoothest. An error towards the next line, as far as that lies, is a possible track and not told.

    Args:
        xy: in the order of the flight.
        seconds: when each was taken [n], increasing; None where unknown.
    """

    # The number of an image is a clock too: what is left out leaves a gap.
    clocks = [np.arange(len(xy), dtype=float), *([] if seconds is None else [seconds])]

    def away(kept: NDArray[np.int64]) -> Array:
        return _away(xy[kept], [clock[kept] for clock in clocks])

    kept = np.arange(len(xy))
    # What is usual is told without the layout's answers: a track that turns all the time has no outliers.
    limit = max(OFF_TRACK, TIMES_USUAL * float(np.median(_by_neighbours(xy, clocks))))
    found: list[tuple[int, float]] = []
    while len(kept) >= 6 and len(found) < len(xy) // 4:
        now = away(kept)
        worst = int(now.argmax())
        if now[worst] <= limit:
            break
        near = kept[max(0, worst - 40) : worst + 41]
        suspects = kept[max(0, worst - 2) : worst + 3].tolist()
        left = [float(np.minimum(away(near[near != k]), 2 * limit).sum()) for k in suspects]
        wrong = suspects[int(np.argmin(left))]
        found.append((wrong, max(float(now[kept == wrong][0]), float(now[worst]))))
        kept = kept[kept != wrong]
    return sorted(found, key=lambda entry: -entry[1])
