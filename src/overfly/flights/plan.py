"""A flight plan: where the frames of a flight are taken so that they overlap as asked, measured on the terrain."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from overfly.errors import InputError, unknown
from overfly.flights.footprint import Ground, pair_overlap
from overfly.flights.orbit import circular
from overfly.flights.paths import double_grid, grid
from overfly.flights.site import Area, Site
from overfly.flights.walk import random_walk
from overfly.geometry import Array, Camera

PATHS = ("circular", "grid", "double_grid", "random")
DEFAULT_TILT_DEG = {"circular": 35.0, "grid": 0.0, "double_grid": 20.0, "random": 5.0}
"""Off nadir. A random flight tilts each frame by up to this."""

ALTITUDE_RANGE = (20.0, 500.0)
OVERLAP_RANGE = (0.0, 95.0)
MAX_VIEW_DEG = 80.0
ACCURACY_PERCENT = 0.5


@dataclass(frozen=True, eq=False)
class Plan:
    """The frames of a flight in the order of flight.

    Attributes:
        world_from_camera: [n, 4, 4], local metres.
        strip: [n] number of the strip (grids) or orbit (circular) of each frame.
        altitude: metres over ``ground_height``, the mean z of the bare terrain in ``area``.
        overlap, side_overlap: asked, percent.
        measured_overlap: mean over consecutive frames of a strip of area(A and B) / area(A), percent.
        measured_side_overlap: the same across neighbouring strips or orbits; None where there is only one.
        step_m, step_deg, line_spacing_m, radius_m: the solved spacings; None where the path has no such thing.
    """

    flight_path: str
    camera: Camera
    area: Area
    altitude: float
    overlap: float
    side_overlap: float
    tilt_deg: float
    ground_height: float
    world_from_camera: Array
    strip: NDArray[np.int64]
    measured_overlap: float
    measured_side_overlap: float | None
    step_m: float | None
    step_deg: float | None
    line_spacing_m: float | None
    radius_m: float | None

    def __len__(self) -> int:
        return len(self.world_from_camera)

    @property
    def gsd_m(self) -> float:
        """Metres per pixel straight down at the mean ground."""
        return self.altitude / self.camera.fx

    def summary(self) -> str:
        """One line for people."""
        strips = int(self.strip.max()) + 1
        noun = "orbit" if self.flight_path == "circular" else "strip"
        where = "" if self.flight_path == "random" else f" in {strips} {noun}{'s' if strips > 1 else ''}"
        parts = [
            f"{self.flight_path}: {len(self)} frames{where}, {self.altitude:g} m over ground, "
            f"{100 * self.gsd_m:.1f} cm per pixel",
            f"overlap {self.measured_overlap:.1f} % (asked {self.overlap:g})",
        ]
        if self.measured_side_overlap is not None:
            parts.append(f"side overlap {self.measured_side_overlap:.1f} % (asked {self.side_overlap:g})")
        if self.step_deg is not None:
            parts.append(f"step {self.step_deg:.1f} deg at radius {self.radius_m:.0f} m")
        if self.step_m is not None:
            parts.append(f"step {self.step_m:.1f} m")
        if self.line_spacing_m is not None:
            parts.append(f"lines {self.line_spacing_m:.1f} m apart")
        return "; ".join(parts)


def check_number(name: str, value: object, low: float, high: float, unit: str) -> float:
    """``value`` as a float between ``low`` and ``high``.

    Raises:
        InputError: it is no number, NaN, or outside.
    """
    is_number = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    number = float(value) if is_number else math.nan  # type: ignore[arg-type]
    if not low <= number <= high:
        given = f"{name}={value!r}" if not is_number else f"{name}={number:g}"
        raise InputError(f"{given} is not allowed: give {name} as a number from {low:g} to {high:g} {unit}.")
    return number


def check_area(area: object) -> Area:
    """(x_min, y_min, x_max, y_max) as four finite floats in this order.

    Raises:
        InputError: anything else.
    """
    try:
        x0, y0, x1, y1 = (float(v) for v in area)  # type: ignore[attr-defined]
    except (TypeError, ValueError):
        x0 = y0 = x1 = y1 = math.nan
    if not (x0 < x1 < math.inf and y0 < y1 < math.inf and x0 > -math.inf and y0 > -math.inf):
        raise InputError(f"The area {area!r} is not allowed: give x_min, y_min, x_max, y_max in metres, min under max.")
    return x0, y0, x1, y1


def plan_flight(
    flight_path: str,
    area: Area,
    *,
    altitude: float,
    overlap: float,
    side_overlap: float,
    camera: Camera,
    ground: Ground,
    rng: np.random.Generator,
    tilt_deg: float | None = None,
    heading_deg: float = 0.0,
    frames: int | None = None,
    terrain_follow: bool = False,
) -> Plan:
    """Plan a flight whose overlaps, measured on the rendered footprints, are the asked ones.

    The overlap of two frames is area(A and B) / area(A) of their outlines on the bare terrain (lens included).

    Args:
        flight_path: one of :data:`PATHS`.
        area: the ground to cover, (x_min, y_min, x_max, y_max) in metres.
        altitude: metres over the mean ground of the area, 20 to 500; the flight keeps this absolute height.
        overlap: percent of a frame that the next one sees too, 0 to 95, mean over the strip.
        side_overlap: percent of a frame that its neighbour in the next strip sees too, 0 to 95.
        camera: of all frames.
        ground: bare terrain, x, y [N, 2] -> z [N].
        rng: decides random flights; the other paths do not use it.
        tilt_deg: camera off nadir (random: at most); None takes :data:`DEFAULT_TILT_DEG`.
        heading_deg: of the first strip, or of the orbit's first camera, clockwise from north.
        frames: at most so many frames.
        terrain_follow: keep ``altitude`` over the ground under each frame instead.

    Raises:
        InputError: a value outside its range, an overlap that cannot be flown, a flight through the ground, too many
            frames.
    """
    if flight_path not in PATHS:
        raise unknown("The flight path", flight_path, PATHS)
    altitude = check_number("altitude", altitude, *ALTITUDE_RANGE, "metres over ground")
    overlap = check_number("overlap", overlap, *OVERLAP_RANGE, "percent")
    side_overlap = check_number("side_overlap", side_overlap, *OVERLAP_RANGE, "percent")
    heading_deg = check_number("heading_deg", heading_deg, -360, 360, "degrees")
    tilt = DEFAULT_TILT_DEG[flight_path] if tilt_deg is None else tilt_deg
    tilt = check_number("tilt_deg", tilt, 0, 60, "degrees off nadir")
    half_fov = camera.fov_deg[1] / 2
    if tilt + half_fov > MAX_VIEW_DEG:
        raise InputError(
            f"tilt_deg={tilt:g} makes this camera (vertical field of view {2 * half_fov:.0f} degrees) look to the "
            f"horizon: give at most {MAX_VIEW_DEG - half_fov:.0f}."
        )
    if frames is not None and (isinstance(frames, bool) or not isinstance(frames, int | np.integer) or frames < 2):
        raise InputError(f"frames={frames!r} is not allowed: give a whole number, at least 2, or none.")
    site = Site(camera, ground, check_area(area), altitude, tilt, bool(terrain_follow))
    forward, side = overlap / 100, side_overlap / 100
    if flight_path == "random":
        layout = random_walk(site, forward, side, rng, frames)
    else:
        build = {"circular": circular, "grid": grid, "double_grid": double_grid}[flight_path]
        layout = build(site, forward, side, heading_deg, frames)
    plan = Plan(
        flight_path=flight_path,
        camera=camera,
        area=site.area,
        altitude=altitude,
        overlap=overlap,
        side_overlap=side_overlap,
        tilt_deg=tilt,
        ground_height=site.ground_height,
        world_from_camera=layout.poses,
        strip=layout.strip,
        measured_overlap=100 * site.overlap(layout.poses, layout.forward),
        measured_side_overlap=None if layout.side is None else 100 * float(pair_overlap(*layout.side).mean()),
        step_m=layout.step_m,
        step_deg=layout.step_deg,
        line_spacing_m=layout.line_spacing_m,
        radius_m=layout.radius_m,
    )
    _check_overlap("overlap", plan.measured_overlap, overlap)
    if plan.measured_side_overlap is not None:
        _check_overlap("side_overlap", plan.measured_side_overlap, side_overlap)
    return plan


def _check_overlap(name: str, measured: float, asked: float) -> None:
    if abs(measured - asked) > ACCURACY_PERCENT:
        raise InputError(
            f"{name}={asked:g} cannot be flown over this terrain (measured {measured:.1f} %): fly higher, give a "
            "larger area or another overlap."
        )
