"""Check a flight before anything is computed: what its map will lack, why, and what to do about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from overfly.errors import InputError
from overfly.flights import Flight, read_flight
from overfly.geometry import Array
from overfly.mapping.needs import core_seconds, memory_gb
from overfly.mapping.report import duration, length_text
from overfly.preflight.accuracy import SIGMA_OF
from overfly.preflight.coverage import Coverage, cover
from overfly.preflight.findings import Finding, count, ranked
from overfly.preflight.gaps import Gap, gaps_of
from overfly.preflight.ground import Placement, place
from overfly.preflight.images import Look, look_at_all
from overfly.preflight.overlap import overlap_findings
from overfly.preflight.positions import position_findings
from overfly.preflight.quality import camera_findings, image_findings, relative_sharpness
from overfly.preflight.registration import facing, placed_chances, usable_shares

if TYPE_CHECKING:
    from rich.table import Table

ALTITUDES = (2.0, 10_000.0)


@dataclass(frozen=True, eq=False)
class Check:
    """What was found.

    Attributes:
        flight, looks: the images and the look at each.
        placed: cameras over the ground; None where positions or height are not known.
        seen: what they see; None where nothing is placed or no camera sees the ground.
        gaps: ground that needs more lines.
        findings: worst first.
        motion_px: way of the drone during an exposure, pixels on the ground.
        chances: of each image to be placed with the others [n], see :mod:`overfly.preflight.registration`.
    """

    flight: Flight
    looks: list[Look]
    placed: Placement | None
    seen: Coverage | None
    gaps: list[Gap]
    findings: list[Finding]
    motion_px: float | None
    chances: Array

    @property
    def mappable(self) -> bool:
        """Whether a map can come out at all, as far as can be told before matching."""
        return all(finding.level != "stop" for finding in self.findings)

    @property
    def verdict(self) -> str:
        """One sentence."""
        worst = self.findings[0].level if self.findings else "note"
        return {
            "stop": "This flight cannot give a map.",
            "bad": "This flight can be mapped, but a part of the map will be missing or wrong.",
            "warn": "This flight can be mapped; mind the warnings.",
            "note": "This flight can be mapped.",
        }[worst]

    def to_dict(self) -> dict[str, Any]:
        """For programs: metres, seconds, shares 0..1; null where unknown."""
        sizes = [(f.width, f.height) for f in self.flight.frames]
        sharp = relative_sharpness(self.flight, self.looks)
        result: dict[str, Any] = {
            "mappable": self.mappable,
            "verdict": self.verdict,
            "images": len(self.flight),
            "assumed": None if self.placed is None else self.placed.assumed,
            "overlap": None if self.placed is None or self.seen is None else _overlap(self.placed, self.seen),
            "gaps": [gap.to_dict(self.placed.origin if self.placed is not None else None) for gap in self.gaps],
            "motion_px": _round(self.motion_px),
            "expected_placed": _round(float(self.chances.mean())),
            "estimate": {"core_seconds": round(core_seconds(sizes)), "memory_gb": round(memory_gb(sizes), 2)},
            "findings": [finding.to_dict() for finding in self.findings],
        }
        result["files"] = [
            {
                "name": frame.name,
                "sharpness": _round(sharpness),
                "expected_placed": _round(chance),
                "brightness": _round(look.brightness),
                "dark": _round(look.dark),
                "bright": _round(look.bright),
                "flat": _round(look.flat),
            }
            for frame, look, sharpness, chance in zip(self.flight.frames, self.looks, sharp, self.chances, strict=True)
        ]
        return result

    def table(self) -> Table:
        """The figures for the terminal, to be printed by rich."""
        from rich.table import Table

        table = Table(title=f"{self.flight.root.name}: {count(len(self.flight), 'image')}", title_justify="left")
        table.add_column("what")
        table.add_column("value", justify="right")
        for label, value in self._rows():
            table.add_row(label, value)
        assumed = "Without positions overlap cannot be told." if self.placed is None else self.placed.assumed
        if self.seen is not None:
            assumed += f" Sigma of {SIGMA_OF}: plants and the error of GPS are not in it."
        table.caption = (
            f"{assumed} Time at the measured rate of maps with estimated cameras, memory by the map's own estimate."
        )
        table.caption_justify = "left"
        return table

    def _rows(self) -> list[tuple[str, str]]:
        rows = []
        if self.placed is not None and self.seen is not None:
            unit = " m" if self.placed.metric else " units"
            rows += [
                ("camera over ground", f"{np.median(self.placed.heights):.1f}{unit}"),
                ("ground per pixel", _length(float(np.median(self.seen.gsd_m)), self.placed.metric)),
                ("overlap along the lines (median)", _percent(self.seen.forward)),
                ("overlap between lines (median)", _percent(self.seen.side)),
                ("inside, seen by 0 / 1 / 2 / 3+ images", " / ".join(f"{s:.0%}" for s in self.seen.shares)),
                ("images per place inside (median)", f"{_median_views(self.seen):.0f}"),
                ("expected sigma in height", _length(self.seen.sigma_z_m, self.placed.metric)),
                ("expected sigma in plan", _length(self.seen.sigma_xy_m, self.placed.metric)),
            ]
        known = "expected" if self.seen is not None else "expected, if they overlap"
        rows.append((f"images that will be placed ({known})", f"{self.chances.sum():.0f} of {len(self.flight)}"))
        if self.motion_px is not None:
            rows.append(("motion during an exposure", f"{self.motion_px:.1f} px"))
        sharp = relative_sharpness(self.flight, self.looks)
        if np.isfinite(sharp).any():
            rows.append(("least sharp image, against the median", f"{np.nanmin(sharp):.2f}"))
        sizes = [(f.width, f.height) for f in self.flight.frames]
        rows.append(("overfly map, one core", duration(core_seconds(sizes))))
        rows.append(("overfly map, memory", f"{memory_gb(sizes):.1f} GB"))
        return rows

    def picture(self) -> bytes:
        """The overlap map as the bytes of a PNG file.

        Raises:
            InputError: the overlap is not known.
        """
        from overfly.mapping.pictures import png, views_map

        if self.placed is not None and self.seen is None:
            raise InputError("There is no overlap map, because no camera sees the ground: leave --picture out.")
        if self.placed is None or self.seen is None:
            raise InputError(
                "There is no overlap map without positions: give GPS in the images, a geo.txt or cameras, and "
                "--altitude where no height over ground is known; or leave --picture out."
            )
        wanted = [np.stack([a, b]) for gap in self.gaps for a, b in zip(gap.starts, gap.ends)]
        return png(
            views_map(
                self.seen.grid,
                self.seen.views,
                unit="m" if self.placed.metric else "units",
                width_in=7.0,
                track=self.placed.poses[:, :2, 3],
                wanted=wanted,
            )
        )


def check_flight(
    folder: Path | str,
    *,
    altitude: float | None = None,
    processes: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Check:
    """Check a flight folder, or a plain folder of images; no two images are matched.

    Args:
        folder: of the flight.
        altitude: metres over ground, where the images do not tell it or tell it wrongly.
        processes: that look at images side by side.
        progress: told how many images of how many are looked at.

    Raises:
        InputError: no such flight, or a value outside its range.
    """
    if altitude is not None and not ALTITUDES[0] <= altitude <= ALTITUDES[1]:
        raise InputError(
            f"--altitude {altitude:g} is not allowed: give {ALTITUDES[0]:g} to {ALTITUDES[1]:g} metres over ground."
        )
    if processes < 1:
        raise InputError(f"--processes {processes} is not allowed: give a whole number, at least 1.")
    flight = read_flight(folder)
    looks = look_at_all([f.path for f in flight.frames], processes=processes, progress=progress)
    placed = place(flight, looks, altitude)
    seen = cover(placed) if placed is not None else None
    gaps = gaps_of(seen, placed.poses[:, :2, 3]) if placed is not None and seen is not None else []
    motion = _motion(flight, looks, placed, seen)
    findings = [*position_findings(flight, placed, looks)]
    if placed is not None and seen is not None:
        findings += overlap_findings(placed, seen, gaps)
    elif placed is not None:
        findings.append(
            Finding(
                "warn",
                "overlap",
                "No camera sees the ground, so overlap on level ground cannot be told",
                "a map needs views from above; if the images are such, their gimbal angles or heights are wrong",
            )
        )
    elif flight.cameras_from is not None or any(f.gps is not None for f in flight.frames):
        findings.append(
            Finding(
                "warn",
                "altitude",
                "The height over ground is neither told by the images nor seen from their shifts",
                "give --altitude, so that overlap and accuracy can be told",
            )
        )
    findings += [*image_findings(flight, looks, motion), *camera_findings(flight), *_told(flight)]
    usable = usable_shares(looks, relative_sharpness(flight, looks))
    names, where, shared = [f.name for f in flight.frames], [], None
    if placed is not None and seen is not None:
        where, shared = [f.name for f in placed.frames], seen.overlaps * facing(placed.poses[:, :3, 2])
    chances = placed_chances(names, usable, where, shared)
    return Check(flight, looks, placed, seen, gaps, ranked(findings), motion, chances)


def _told(flight: Flight) -> list[Finding]:
    """What the readers of the folder said and nothing above covers."""
    covered = ("are skipped", "Orientation tag", "no GPS position", "below sea level")
    told = [text.rstrip(".") for text in flight.warnings if not any(words in text for words in covered)]
    return [Finding("note", "files", text, "look at it before you map") for text in told]


def _motion(flight: Flight, looks: list[Look], placed: Placement | None, seen: Coverage | None) -> float | None:
    """Median speed within the lines x exposure / ground per pixel."""
    if placed is None or seen is None or not placed.metric:
        return None
    exposure = {f.name: look.exposure_s for f, look in zip(flight.frames, looks, strict=True)}
    moved = []
    for line in seen.lines:
        for i, j in pairwise(line):
            a, b = placed.frames[i], placed.frames[j]
            seconds = (b.time - a.time).total_seconds() if a.time is not None and b.time is not None else 0.0
            shutter = exposure[a.name]
            if seconds > 0 and shutter is not None:
                distance = float(np.linalg.norm(placed.poses[j, :2, 3] - placed.poses[i, :2, 3]))
                moved.append(distance / seconds * shutter / seen.gsd_m[i])
    return float(np.median(moved)) if len(moved) >= 3 else None


def _overlap(placed: Placement, seen: Coverage) -> dict[str, Any]:
    zero, one, two, more = seen.shares
    return {
        "metric": placed.metric,
        "height_over_ground": _round(float(np.median(placed.heights))),
        "measured_altitude_m": _round(placed.measured_altitude),
        "gsd": _round(float(np.median(seen.gsd_m)), 5),
        "forward": _round(float(np.median(seen.forward)) if len(seen.forward) else None),
        "side": _round(float(np.median(seen.side)) if len(seen.side) else None),
        "lines": len(seen.lines),
        "flown_area": _round(float(np.count_nonzero(seen.flown)) * seen.grid.cell**2, 1),
        "seen_by": {"0": _round(zero), "1": _round(one), "2": _round(two), "3+": _round(more)},
        "views_median": _median_views(seen),
        "base_to_height": _round(float(np.nanmedian(seen.base_to_height)) if np.isfinite(seen.sigma_z_m) else None),
        "sigma_z": _round(seen.sigma_z_m, 5),
        "sigma_xy": _round(seen.sigma_xy_m, 5),
        "blocks": np.bincount(seen.blocks).tolist(),
    }


def _median_views(seen: Coverage) -> float:
    inside = seen.views[seen.flown]
    return float(np.median(inside)) if inside.size else 0.0


def _round(value: float | None, digits: int = 4) -> float | None:
    return None if value is None or not np.isfinite(value) else round(float(value), digits)


def _percent(shares: np.ndarray) -> str:
    return f"{np.median(shares):.0%}" if len(shares) else "–"


def _length(value: float, metric: bool) -> str:
    if not np.isfinite(value):
        return "unknown"
    return length_text(value) if metric else f"{value:.4g} units"
