"""Where a flight left ground that less than two images see, and the lines that would close it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from overfly.geodesy import Origin, geodetic_from_enu
from overfly.geometry import Array
from overfly.preflight.coverage import Coverage, across_of, parallel

ASKED_SIDE_OVERLAP = 0.6
"""Overlap between lines that extra lines shall bring."""

LEAST_SIDE_OVERLAP = 0.5
"""Neighbouring lines that share less get lines between them even where single images overlap along the line."""

LEAST_FORWARD_OVERLAP = 0.5
"""Where images of a line share less, ground is lost along the lines and not between them."""

SLACK = 0.15
"""Spacings by which an extra line would be saved: a few percent less overlap are no reason to fly one more."""

SMALLEST = 0.004
"""Share of the flown area under which a gap is not worth a line."""


@dataclass(frozen=True, eq=False)
class Gap:
    """Ground inside the flight that less than two images see, or lines too far apart, and what closes it.

    Attributes:
        area: of the cells that less than two images see, square metres; 0 where lines are only too far apart.
        centre: x, y.
        count: lines to be flown.
        spacing: between lines, old or new, metres.
        heading: of the new lines, degrees clockwise from north, 0..180.
        apart: distance of the lines on both sides, metres; 0 without.
        between: numbers of the flown lines on both sides, from 1 at the side that was flown first; None where lines
            do not enclose it.
        again: whether a line was flown there and only lacks images.
        starts, ends: of the new lines, x, y [count, 2].
    """

    area: float
    centre: Array
    count: int
    spacing: float
    heading: float
    apart: float
    between: tuple[int, int] | None
    again: bool
    starts: Array
    ends: Array

    def to_dict(self, origin: Origin | None) -> dict[str, Any]:
        """For programs; with an origin also latitude and longitude of the lines."""
        result: dict[str, Any] = {
            "area_m2": round(self.area, 1),
            "centre": self.centre.round(2).tolist(),
            "lines": self.count,
            "spacing_m": round(self.spacing, 2),
            "heading_deg": round(self.heading, 1),
            "between_lines": self.between,
            "again": self.again,
            "starts": self.starts.round(2).tolist(),
            "ends": self.ends.round(2).tolist(),
        }
        if origin is not None:
            for name, points in (("starts", self.starts), ("ends", self.ends)):
                there = geodetic_from_enu(np.column_stack([points, np.zeros(len(points))]), origin)
                result[f"{name}_latitude_longitude"] = there[:, :2].round(7).tolist()
        return result


def gaps_of(seen: Coverage, xy: Array) -> list[Gap]:
    """The gaps of a flight whose cameras stood at ``xy`` [n, 2], largest first.

    Ground between two neighbouring lines is one gap, however many pieces it falls into.
    """
    from scipy.ndimage import label

    weak = seen.flown & (seen.views < 2)
    pieces, number = label(weak, np.ones((3, 3)))
    smallest = max(SMALLEST * np.count_nonzero(seen.flown), 4)
    centres = seen.grid.centres()
    sizes = np.bincount(pieces.ravel(), minlength=number + 1)
    kept = [k for k in range(1, number + 1) if sizes[k] >= smallest]
    if len(seen.forward) and np.median(seen.forward) < LEAST_FORWARD_OVERLAP:
        kept = []  # no line between the lines helps where the images of each are too far apart
    lines = [] if seen.direction is None else _merged(xy, parallel(xy, seen.lines, seen.direction), seen)
    cells: dict[tuple[int, int] | int, list[Array]] = {}
    for k in kept:
        points = centres[pieces == k]
        if len(lines) < 2 or seen.direction is None:
            cells[-k] = [points]
            continue
        between = np.searchsorted(lines, across_of(points, seen.direction)[1])
        for j in np.unique(between):
            part = points[between == j]
            outside = not 0 < j < len(lines)
            if outside and np.ptp(across_of(part, seen.direction)[1]) < 0.2 * seen.footprint_across:
                continue
            if len(part) >= smallest:
                key = (int(j), int(j) + 1) if not outside else (0, int(j))
                cells.setdefault(key, []).append(part)
    if seen.direction is not None:
        for k, (low, high) in enumerate(pairwise(lines), start=1):
            if high - low > (1 - LEAST_SIDE_OVERLAP) * seen.footprint_across:
                cells.setdefault((k, k + 1), [])
    reach = across_of(xy[np.concatenate(seen.lines)], seen.direction or 0.0)[0] if seen.lines else np.zeros(1)
    ends = float(reach.min()), float(reach.max())
    backwards = _from_the_other_side(xy, seen, lines)
    found = [
        _gap(seen, np.concatenate([np.zeros((0, 2)), *parts]), key, lines, ends, backwards)
        for key, parts in cells.items()
    ]
    return sorted(found, key=lambda gap: -gap.area)


def _from_the_other_side(xy: Array, seen: Coverage, lines: list[float]) -> bool:
    """Whether the line that was flown first lies at the end of ``lines``."""
    if seen.direction is None or not lines:
        return False
    first = min(parallel(xy, seen.lines, seen.direction), key=lambda line: int(line[0]))
    return bool(np.median(across_of(xy[first], seen.direction)[1]) > (lines[0] + lines[-1]) / 2)


def _merged(xy: Array, lines: list[NDArray[np.int64]], seen: Coverage) -> list[float]:
    """Positions across of the lines; those flown twice or in pieces count once."""
    assert seen.direction is not None
    kept: list[float] = []
    for line in lines:
        across = float(np.median(across_of(xy[line], seen.direction)[1]))
        if not kept or across - kept[-1] > 0.1 * seen.footprint_across:
            kept.append(across)
    return kept


def _gap(
    seen: Coverage,
    points: Array,
    key: tuple[int, int] | int,
    lines: list[float],
    reach: tuple[float, float],
    backwards: bool,
) -> Gap:
    width = seen.footprint_across
    wanted = (1 - ASKED_SIDE_OVERLAP) * width
    between, again, apart = None, False, 0.0
    if isinstance(key, tuple):
        assert seen.direction is not None
        heading = seen.direction
        along, across = across_of(points, heading)
        if key[0] > 0:
            low, high = lines[key[0] - 1], lines[key[1] - 1]
            between, apart = key, high - low
            if backwards:
                between = len(lines) - key[0], len(lines) + 1 - key[0]
        else:
            low, high = float(across.min()), float(across.max())
        count = max(1, math.ceil((high - low) / wanted - SLACK) - 1)
        again = key[0] > 0 and high - low <= wanted * 1.05
    else:
        spread = np.linalg.svd(points - points.mean(0), full_matrices=False)[2][0]
        heading = float(np.degrees(np.arctan2(spread[0], spread[1])) % 180)
        along, across = across_of(points, heading)
        low, high = float(across.min()), float(across.max())
        count = max(1, math.ceil((high - low) / wanted))
    spacing = (high - low) / (count + 1)
    angle = np.radians(heading)
    ahead, right = np.array([np.sin(angle), np.cos(angle)]), np.array([np.cos(angle), -np.sin(angle)])
    places = low + spacing * np.arange(1, count + 1)
    first, last = (float(along.min()), float(along.max())) if len(along) else reach
    starts, ends = first * ahead + places[:, None] * right, last * ahead + places[:, None] * right
    middle = np.concatenate([starts, ends]).mean(0)
    return Gap(len(points) * seen.grid.cell**2, middle, count, spacing, heading, apart, between, again, starts, ends)
