"""Plan the flight that an area needs, and say how accurate its map can be; the body of `overfly plan`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import shapely

from overfly.errors import InputError, unknown
from overfly.flights import find_preset, plan_flight
from overfly.flights.footprint import footprints, polygons
from overfly.flights.plan import ALTITUDE_RANGE, Plan
from overfly.geodesy import geodetic_from_enu
from overfly.geometry import Array
from overfly.mapping.needs import core_seconds, memory_gb
from overfly.mapping.report import area_text, duration, length_text
from overfly.preflight.accuracy import SIGMA_OF
from overfly.preflight.area import AskedArea, read_area
from overfly.preflight.coverage import Coverage, cover
from overfly.preflight.ground import Placement
from overfly.preflight.waypoints import waypoints, write_kml, write_litchi

if TYPE_CHECKING:
    from rich.table import Table

FLYABLE = ("grid", "double_grid", "circular")

OVERLAP, SIDE_OVERLAP = 80.0, 60.0
"""Percent. Along: a rendered suburb reaches an F-score of 0.96 at 1 m with 80 x 80 % and 0.91 with 50 x 50 %. Between
lines: Brighton Beach, flown at 64 / 60 %, reaches 0.99 on open land (both in docs/accuracy.md)."""

FASTEST, SECONDS_PER_PHOTO, SECONDS_PER_TURN = 8.0, 2.0, 4.0
"""Metres a second that mapping apps fly at most; what a camera needs to store an image; what a turn costs."""

BYTES_PER_PIXEL = 0.4
"""Of JPEG files of drones: about 8 MB for 20 megapixels."""

LOOKED_AT = 600
"""Images of the plan whose views and bases are counted."""

LEGAL_ALTITUDE = 120.0


@dataclass(frozen=True, eq=False)
class FlightPlan:
    """A plan over its area.

    Attributes:
        plan: its cameras world_from_camera [n, 4, 4] stand in local metres around the middle of the area, ground at 0.
        area: what was asked.
        speed: metres a second.
        camera_name: of the preset.
        seen: what the first :data:`LOOKED_AT` images see.
    """

    plan: Plan
    area: AskedArea
    speed: float
    camera_name: str
    seen: Coverage

    @property
    def length_m(self) -> float:
        """Of the way from the first image to the last."""
        return float(np.linalg.norm(np.diff(self.plan.world_from_camera[:, :3, 3], axis=0), axis=1).sum())

    @property
    def lines(self) -> int:
        return len(np.unique(self.plan.strip))

    @property
    def seconds(self) -> float:
        return self.length_m / self.speed + SECONDS_PER_TURN * (self.lines - 1)

    @property
    def shares(self) -> tuple[float, float, float] | None:
        """Of the asked area, seen by less than 2, by 2 and by 3 or more images; None where not all were looked at."""
        if len(self.plan) > LOOKED_AT:
            return None
        centres = self.seen.grid.centres()
        inside = shapely.contains_xy(self.area.polygon, centres[..., 0], centres[..., 1])
        views = self.seen.views[inside]
        # Cells that no footprint reaches lie beside the raster.
        beside = 1 - min(1.0, views.size * self.seen.grid.cell**2 / self.area.polygon.area)
        total = max(views.size, 1) / (1 - beside) if beside < 1 else 1
        two, more = np.count_nonzero(views == 2) / total, np.count_nonzero(views > 2) / total
        return max(0.0, 1 - two - more), two, more

    def table(self) -> Table:
        """The figures for the terminal, to be printed by rich."""
        from rich.table import Table

        plan, camera = self.plan, self.plan.camera
        told = self.shares
        shares = f"not counted beyond {LOOKED_AT} photographs" if told is None else " / ".join(f"{s:.0%}" for s in told)
        table = Table(title=f"{plan.flight_path} over {area_text(self.area.polygon.area)}", title_justify="left")
        table.add_column("what")
        table.add_column("value", justify="right")
        sizes = [(camera.width, camera.height)] * len(plan)
        noun = "orbits" if plan.flight_path == "circular" else "lines"
        rows = [
            ("camera", f"{self.camera_name}, {camera.width} x {camera.height}"),
            ("height over ground", f"{plan.altitude:.1f} m"),
            ("ground per pixel", length_text(plan.gsd_m)),
            ("overlap along / between lines", f"{plan.overlap:g} % / {plan.side_overlap:g} %"),
            ("camera off straight down", f"{plan.tilt_deg:g} degrees"),
            (f"{noun} / photographs", f"{self.lines} / {len(plan)}"),
        ]
        if plan.step_m is not None:
            rows.append(("a photograph every", f"{plan.step_m:.1f} m"))
        if plan.line_spacing_m is not None:
            rows.append((f"{noun} apart", f"{plan.line_spacing_m:.1f} m"))
        rows += [
            ("length of the flight", f"{self.length_m / 1000:.2f} km"),
            (f"time at {self.speed:.1f} m/s, turns included", duration(self.seconds)),
            ("storage", f"{len(plan) * camera.width * camera.height * BYTES_PER_PIXEL / 1e9:.1f} GB"),
            ("area seen by 0-1 / 2 / 3+ images", shares),
            ("expected sigma in height", length_text(self.seen.sigma_z_m)),
            ("expected sigma in plan", length_text(self.seen.sigma_xy_m)),
            ("overfly map, one core / memory", f"{duration(core_seconds(sizes))} / {memory_gb(sizes):.1f} GB"),
        ]
        for label, value in rows:
            table.add_row(label, value)
        table.caption = (
            f"Over level ground. Sigma of {SIGMA_OF}, without plants and the error of GPS (metres without RTK or "
            "control points)."
        )
        table.caption_justify = "left"
        return table

    def remarks(self) -> list[str]:
        """What to know before flying."""
        said = []
        if self.plan.altitude > LEGAL_ALTITUDE:
            said.append(
                f"{self.plan.altitude:.0f} m are above the {LEGAL_ALTITUDE:.0f} m of the open category in Europe:"
                " ask for permission, or give a smaller --gsd."
            )
        if self.plan.flight_path != "circular" and self.lines < 2:
            said.append("A single line has weak heights across it: give a larger area or more --side-overlap.")
        return said

    def write(self, kml: Path | None, litchi: Path | None) -> list[Path]:
        """Write the files for ground stations; returns those written.

        Raises:
            InputError: the place on the Earth is not known, or a file's ending is wrong.
        """
        for option, path, suffix in (("--kml", kml, ".kml"), ("--litchi", litchi, ".csv")):
            if path is not None and path.suffix.lower() != suffix:
                raise InputError(f"{option} {path} has the wrong ending: give a name that ends in {suffix}.")
        if kml is None and litchi is None:
            return []
        if self.area.origin is None:
            raise InputError("Waypoints need a place on the Earth: give --at LATITUDE,LONGITUDE of the area's middle.")
        points = waypoints(self.plan.world_from_camera, self.plan.strip.tolist(), self.area.origin)
        written = []
        if kml is not None:
            flat = np.column_stack([self.area.outline, np.zeros(len(self.area.outline))])
            outline = geodetic_from_enu(flat, self.area.origin)[:, :2]
            write_kml(kml, points, f"{self.plan.flight_path} at {self.plan.altitude:.0f} m", outline)
            written.append(kml)
        if litchi is not None:
            written += write_litchi(litchi, points, speed=self.speed, step_m=self.plan.step_m)
        return written


def plan_area(
    area: str,
    *,
    camera: str,
    gsd_cm: float | None = None,
    altitude: float | None = None,
    path: str = "grid",
    overlap: float = OVERLAP,
    side_overlap: float = SIDE_OVERLAP,
    speed: float | None = None,
    at: str | None = None,
) -> FlightPlan:
    """Plan a flight over level ground.

    Args:
        area: see :func:`overfly.preflight.area.read_area`.
        camera: a preset's name.
        gsd_cm: centimetres per pixel on the ground; or
        altitude: metres over ground.
        path: one of :data:`FLYABLE`. Lines run along the area's longer side.
        overlap, side_overlap: percent, along and between lines.
        speed: metres a second; None takes what the camera can store, at most :data:`FASTEST`.
        at: latitude and longitude of the middle.

    Raises:
        InputError: a value that is not possible.
    """
    if path not in FLYABLE:
        raise unknown("The flight path", path, FLYABLE)
    if (gsd_cm is None) == (altitude is None):
        raise InputError(
            "Give either --gsd (centimetres per pixel) or --altitude (metres over ground), one of the two."
        )
    asked = read_area(area, at)
    pinhole = find_preset(camera).camera()
    if gsd_cm is not None:
        altitude = gsd_cm / 100 * pinhole.fx
        low, high = (100 * limit / pinhole.fx for limit in ALTITUDE_RANGE)
        if not low <= gsd_cm <= high:
            raise InputError(
                f"--gsd {gsd_cm:g} needs {altitude:.0f} m over ground with {camera}: give {low:.2f} to {high:.1f} cm."
            )
    if speed is not None and not 0.5 <= speed <= 30:
        raise InputError(f"--speed {speed:g} is not allowed: give metres a second from 0.5 to 30.")
    assert altitude is not None
    turn, size = _longest_side(asked)
    if path != "circular":
        # The first and last line, and the ends of all, shall lie on the border, or it would be seen once only.
        size = size[0] + altitude * pinhole.width / pinhole.fx, size[1] + altitude * pinhole.height / pinhole.fy
    planned = plan_flight(
        path,
        (-size[0] / 2, -size[1] / 2, size[0] / 2, size[1] / 2),
        altitude=altitude,
        overlap=overlap,
        side_overlap=side_overlap,
        camera=pinhole,
        ground=lambda xy: np.zeros(len(xy)),
        rng=np.random.default_rng(0),
    )
    planned = _over(planned, turn, asked)
    if speed is None:
        steps = np.linalg.norm(np.diff(planned.world_from_camera[:, :3, 3], axis=0), axis=1)
        speed = float(np.clip(np.median(steps) / SECONDS_PER_PHOTO, 0.5, FASTEST))
    some = planned.world_from_camera[:LOOKED_AT]
    seen = cover(Placement([], [pinhole] * len(some), some, 0.0, asked.origin, True, ""))
    assert seen is not None
    return FlightPlan(planned, asked, speed, camera, seen)


def _longest_side(asked: AskedArea) -> tuple[Array, tuple[float, float]]:
    """The smallest rectangle round the area as a transform [4, 4] from a frame whose y runs along its longer side, and
    its width and length there."""
    corners = np.array(shapely.minimum_rotated_rectangle(asked.polygon).exterior.coords)[:4]
    sides = np.diff(corners[[0, 1, 2]], axis=0)
    lengths = np.linalg.norm(sides, axis=1)
    # Of equal sides the one that runs more to the north, so that squares are flown north and south.
    order = max((0, 1), key=lambda k: (round(lengths[k], 3), abs(sides[k, 1])))
    along = sides[order] / lengths[order]
    along = along if along[1] > 0 or (along[1] == 0 and along[0] > 0) else -along
    frame = np.eye(4)
    frame[:2, 0], frame[:2, 1] = [along[1], -along[0]], along
    frame[:2, 3] = corners.mean(0)
    return frame, (float(lengths[1 - order]), float(lengths[order]))


def _over(plan: Plan, frame: Array, asked: AskedArea) -> Plan:
    """The plan turned into the area's frame, without images that see nothing of it."""
    poses = frame @ plan.world_from_camera
    if plan.flight_path == "circular":
        return replace(plan, world_from_camera=poses)
    outlines = footprints(plan.camera, poses, lambda xy: np.zeros(len(xy)), (0.0, 0.0))
    kept = np.flatnonzero(shapely.intersects(polygons(outlines), asked.polygon))
    return replace(plan, world_from_camera=poses[kept], strip=plan.strip[kept])
