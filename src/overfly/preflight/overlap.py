"""What the overlap of a flight says about its map: what will be missing, what will be weak, what to fly instead."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from overfly.geodesy import geodetic_from_enu
from overfly.mapping.report import area_text
from overfly.preflight.coverage import CONNECTED, Coverage
from overfly.preflight.findings import Finding, count, some
from overfly.preflight.gaps import LEAST_SIDE_OVERLAP, Gap
from overfly.preflight.ground import Placement

LEAST_FORWARD, GOOD_FORWARD = 0.3, 0.57
"""Below the first little can be matched; below the second (60 % but for the noise of GPS) much is seen only twice."""

ASKED_FORWARD = 0.8
ONCE = 0.02
"""Share of the flown area seen by less than two images that is worth a word."""

WEAK_BASE = 0.12
OBLIQUE_DEG = 45.0


def overlap_findings(placed: Placement, seen: Coverage, gaps: Sequence[Gap]) -> Iterator[Finding]:
    """Findings about how the cameras cover the ground; nothing here has looked at pixels."""
    names = [f.name for f in placed.frames]
    unit = "m" if placed.metric else "units"
    best = np.where(np.eye(len(names), dtype=bool), 0, np.minimum(seen.overlaps, seen.overlaps.T)).max(1)
    alone = tuple(name for name, share in zip(names, best) if share < CONNECTED)
    sizes = np.bincount(seen.blocks)
    if sizes[0] < 2:
        yield Finding(
            "stop",
            "overlap",
            f"No two images share {CONNECTED:.0%} of their ground",
            f"no map can be made; photograph every {_step(placed, seen):.0f} {unit} for {ASKED_FORWARD:.0%} overlap",
        )
        return
    once = sum(seen.shares[:2])
    yield from _forward(placed, seen, unit)
    if once > ONCE or gaps:
        yield from _gaps(placed, seen, gaps, unit)
    blocks = sizes[sizes > 1]
    if len(blocks) > 1:
        yield Finding(
            "bad",
            "overlap",
            f"The flight falls into {len(blocks)} blocks of {', '.join(map(str, blocks[:5]))} images that share less"
            f" than {CONNECTED:.0%} of their ground",
            "their heights and scales will not agree and the smaller ones may be lost; fly a line that joins them",
            tuple(name for name, block in zip(names, seen.blocks) if block > 0),
        )
    if alone:
        text = f"{count(len(alone), 'image')} shares less than {CONNECTED:.0%} of its ground with any other"
        if len(alone) > 1:
            text = f"{count(len(alone), 'image')} share less than {CONNECTED:.0%} of their ground with any other"
        remedy = "they will not be placed; remove them or photograph the way between"
        yield Finding("warn", "overlap", f"{text} ({some(alone)})", remedy, alone)
    weak = np.nanmedian(seen.base_to_height) if np.isfinite(seen.base_to_height).any() else np.inf
    if weak < WEAK_BASE:
        yield Finding(
            "warn",
            "base",
            f"The images stand close together: base to height is {weak:.2f}",
            "heights are weak along a single line; fly a second line beside it or use every other image",
        )
    tilts = np.degrees(np.arccos(np.clip(-placed.poses[:, 2, 2], -1, 1)))
    if np.median(tilts) > OBLIQUE_DEG:
        yield Finding(
            "note",
            "tilt",
            f"The cameras look {np.median(tilts):.0f} degrees off straight down",
            "overlaps on level ground say little about such views; add a nadir grid for a height raster",
        )


def _step(placed: Placement, seen: Coverage) -> float:
    """Distance between images of a line at which they share :data:`ASKED_FORWARD`."""
    known = seen.outlines[np.isfinite(seen.outlines).all((1, 2))]
    if seen.lines and len(seen.forward) and 0.02 < (share := float(np.median(seen.forward))) < 0.98:
        xy = placed.poses[:, :2, 3]
        moved = float(np.median([np.linalg.norm(xy[b] - xy[a]) for line in seen.lines for a, b in pairwise(line)]))
        return moved / (1 - share) * (1 - ASKED_FORWARD)
    sides = np.linalg.norm(known - np.roll(known, 1, axis=1), axis=2)
    return float(np.median(sides.min(1))) * (1 - ASKED_FORWARD)


def _forward(placed: Placement, seen: Coverage, unit: str) -> Iterator[Finding]:
    if not len(seen.forward) or (share := float(np.median(seen.forward))) >= GOOD_FORWARD:
        return
    yield Finding(
        "bad" if share < LEAST_FORWARD else "warn",
        "overlap",
        f"Images of a line overlap by {share:.0%}",
        f"photograph every {_step(placed, seen):.0f} {unit} along the lines for {ASKED_FORWARD:.0%}",
    )


def _gaps(placed: Placement, seen: Coverage, gaps: Sequence[Gap], unit: str) -> Iterator[Finding]:
    once = sum(seen.shares[:2])
    flown = float(np.count_nonzero(seen.flown)) * seen.grid.cell**2
    where = f" ({area_text(once * flown)})" if placed.metric else ""
    level = "bad" if once > 0.05 else "warn"
    lines = [gap for gap in gaps if not gap.again]
    if once > ONCE:
        cause = f"{once:.0%} of the ground inside the flight{where} is seen by less than two images"
    elif lines:
        wide = max(gap.apart for gap in lines)
        cause = f"Lines up to {wide:.0f} {unit} apart share less than {LEAST_SIDE_OVERLAP:.0%} of their width"
    else:
        return
    if lines:
        number = sum(gap.count for gap in lines)
        apart = sorted({round(gap.spacing) for gap in lines})
        spacing = f"{apart[0]}" if len(apart) == 1 else f"{apart[0]} to {apart[-1]}"
        beside = [f"{gap.between[0]} and {gap.between[1]}" for gap in lines if gap.between]
        places = f" between lines {some(beside)}" if beside else ""
        remedy = f"fly {number} more line{'s' if number > 1 else ''}{places}, {spacing} {unit} apart"
        remedy += f", heading {lines[0].heading:.0f} degrees{_from(placed, lines[0])}"
    elif gaps:
        remedy = f"photograph line{_line(gaps[0])} again{_from(placed, gaps[0])}, images are missing there"
    else:
        remedy = f"photograph every {_step(placed, seen):.0f} {unit} along the lines"
    yield Finding(level, "gaps", cause, remedy)


def _line(gap: Gap) -> str:
    return f"s {gap.between[0]} and {gap.between[1]}" if gap.between else ""


def _from(placed: Placement, gap: Gap) -> str:
    """Where the first of the new lines lies, if the place on the Earth is known."""
    if placed.origin is None:
        return ""
    ends = np.column_stack([np.stack([gap.starts[0], gap.ends[0]]), np.zeros(2)])
    (a, b, _), (c, d, _) = geodetic_from_enu(ends, placed.origin)
    return f", from {a:.6f}, {b:.6f} to {c:.6f}, {d:.6f}" + (" first" if gap.count > 1 else "")
