"""Faults of the positions that the images tell: missing, stuck, off the track, jumping in height."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from overfly.flights import Flight, Frame
from overfly.geometry import Array
from overfly.mapping.control import FEWEST
from overfly.preflight.displacements import Displacements
from overfly.preflight.evidence import Evidence
from overfly.preflight.findings import Finding, count, some
from overfly.preflight.ground import Placement, positions
from overfly.preflight.images import Look
from overfly.preflight.track import TIMES_USUAL, strays

HEIGHT_JUMP = 12.0
"""Metres between an image and its neighbours in the flight; receivers without RTK wander by less."""

DISAGREE = 0.25
"""Relative difference of two altitudes above ground that is no longer slope and noise."""


def position_findings(
    flight: Flight, placed: Placement | None, looks: Sequence[Look] | None = None
) -> Iterator[Finding]:
    """What is wrong with the positions; cameras that the folder gives are taken as right.

    Args:
        flight: its frames.
        placed: over the ground; None where this is not known.
        looks: at the images, in parallel with the frames, to hold their pictures against their positions.
    """
    yield from _missing(flight)
    if flight.cameras_from is None:
        frames = [f for f in flight.frames if f.gps is not None]
        origin = flight.gps_origin()
        if len(frames) >= 2 and origin is not None:
            xy = positions(frames, origin)
            yield from _stuck(frames, xy)
            yield from _off_track(frames, xy, _evidence(flight, xy, placed, looks))
        yield from _heights(flight.frames)
    if placed is not None:
        yield from _altitude(placed)


def _evidence(flight: Flight, xy: Array, placed: Placement | None, looks: Sequence[Look] | None) -> Evidence | None:
    if placed is None or looks is None:
        return None
    known = [look for frame, look in zip(flight.frames, looks, strict=True) if frame.gps is not None]
    return Evidence(xy, Displacements(placed, known).between) if len(known) == len(placed.frames) else None


def _missing(flight: Flight) -> Iterator[Finding]:
    without = [f.name for f in flight.frames if f.gps is None]
    total, held = len(flight.frames), len(flight.gcps) >= FEWEST
    if len(without) == total and flight.cameras_from is None:
        yield Finding(
            "warn" if held else "bad",
            "gps",
            f"None of the {total} images has a GPS position, so overlap cannot be told beforehand"
            + (
                ", and ground control alone gives the map its scale"
                if held
                else " and the map will have no metric scale"
            ),
            "switch on geotagging, or put a geo.txt with the positions beside the images",
        )
    elif without and flight.cameras_from is None:
        yield Finding(
            "warn",
            "gps",
            f"{count(len(without), 'image')} of {total} without GPS position ({some(without)})",
            "they are left out of the overlap below and are placed by matching alone; give a geo.txt to include them",
            tuple(without),
        )


def _stuck(frames: Sequence[Frame], xy: Array) -> Iterator[Finding]:
    if np.ptp(xy, axis=0).max() < 1.0:
        yield Finding(
            "stop",
            "gps",
            f"All {len(frames)} GPS positions lie within one metre of each other",
            "photographs from one place give no depth; fly along lines, or give the true positions in a geo.txt",
        )
        return
    moved = np.linalg.norm(np.diff(xy, axis=0), axis=1)
    stuck = [i + 1 for i in np.flatnonzero(moved < 0.05).tolist() if _apart(frames[i], frames[i + 1])]
    if stuck:
        names = [frames[i].name for i in stuck]
        yield Finding(
            "warn",
            "gps",
            f"{count(len(stuck), 'image')} with exactly the position of the one before, taken at another time "
            f"({some(names)})",
            "the receiver hung or the drone hovered; correct the positions in a geo.txt or remove the images",
            tuple(names),
        )


def _apart(a: Frame, b: Frame) -> bool:
    return a.time is not None and b.time is not None and abs((b.time - a.time).total_seconds()) >= 1.0


def _seconds(frames: Sequence[Frame]) -> Array | None:
    times = [f.time for f in frames]
    if any(t is None for t in times):
        return None
    seconds = np.array([(t - times[0]).total_seconds() for t in times if t is not None and times[0] is not None])
    return seconds if np.all(np.diff(seconds) > 0) else None


def _off_track(frames: Sequence[Frame], xy: Array, evidence: Evidence | None) -> Iterator[Finding]:
    found = strays(xy, _seconds(frames)) if len(frames) >= 6 else []
    accused: dict[int, float] = {}
    if evidence is not None:
        accused = dict(evidence.accused())
        excused = evidence.excused(found, accused)
        found = [(i, off) for i, off in found if i not in excused and i not in accused]
    if not found and not accused:
        return
    found = sorted([*found, *accused.items()], key=lambda entry: -entry[1])
    names = [frames[i].name for i, _ in found]
    which = count(len(found), "GPS position")
    where = "off where the pictures show them" if accused else "off the track of the neighbours"
    yield Finding(
        "warn",
        "gps",
        f"{which} up to {found[0][1]:.0f} m {where} ({some(names)})",
        "correct or remove these positions (geo.txt, or images without GPS tags are placed by matching)",
        tuple(names),
    )


def _heights(frames: Sequence[Frame]) -> Iterator[Finding]:
    for what, values in (
        ("relative altitude", [f.relative_altitude for f in frames]),
        ("GPS altitude", [f.gps.altitude if f.gps is not None else None for f in frames]),
    ):
        height = np.array([np.nan if v is None else v for v in values], float)
        if np.isfinite(height).sum() < 6:
            continue
        jumps = _jumps(height)
        if len(jumps):
            names = [frames[i].name for i in jumps]
            worst = max(jumps.values())
            yield Finding(
                "warn",
                "altitude",
                f"The {what} of {count(len(jumps), 'image')} jumps by up to {worst:.0f} m ({some(names)})",
                "a wrong reading, unless the drone climbed there; correct it in a geo.txt or remove the image",
                tuple(names),
            )
        below = int(np.sum(height < 0))
        if what == "GPS altitude" and below:
            yield Finding(
                "note",
                "altitude",
                f"The GPS altitude of {count(below, 'image')} is below sea level (down to {np.nanmin(height):.0f} m)",
                "absolute heights will be wrong by tens of metres; use ground control if they matter",
            )


def _jumps(height: Array) -> dict[int, float]:
    """Images whose height differs from the two before and the two after, all of them alike, and by how much."""
    away = np.zeros(len(height))
    for i in range(len(height)):
        around = np.concatenate([height[max(0, i - 2) : i], height[i + 1 : i + 3]])
        around = around[np.isfinite(around)]
        if len(around) >= 2 and np.isfinite(height[i]) and np.ptp(around) < HEIGHT_JUMP:
            away[i] = abs(height[i] - np.median(around))
    usual = float(np.median(away))
    return {i: float(away[i]) for i in np.flatnonzero(away > max(HEIGHT_JUMP, TIMES_USUAL * usual)).tolist()}


def _altitude(placed: Placement) -> Iterator[Finding]:
    measured, told = placed.measured_altitude, placed.told_altitude
    if measured is None or told is None or abs(measured / told - 1) <= DISAGREE:
        return
    yield Finding(
        "warn",
        "altitude",
        f"The pictures shift as if the ground were {measured:.0f} m below, the drone tells {told:.0f} m above take-off",
        "normal over a slope or a take-off from a roof; else the altitude, the focal length or the GPS is wrong: give "
        "--altitude",
    )
