"""Where the cameras stood and how far the ground was below them, before anything is matched."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from overfly.flights import Flight, Frame
from overfly.geodesy import Origin, enu_from_geodetic
from overfly.geometry import Array, Camera, pose, rotation_from_gimbal
from overfly.mapping.database import focal_px
from overfly.preflight.images import Look
from overfly.preflight.shifts import Shifts, shifts_of

USABLE_ALTITUDE = 5.0
"""Metres: drones that write less than this above take-off wrote nothing, or stood on the ground."""

GUESSED_FOCAL = 1.2
"""Focal length in longest sides where no file tells it, as the mapping starts from it."""

TURN_DEG = 35.0
"""A track that turns by more ends a line."""


@dataclass(frozen=True, eq=False)
class Placement:
    """Cameras over a level ground.

    Attributes:
        frames, cameras: of n images in the order of the flight.
        poses: world_from_camera [n, 4, 4], local ENU metres (or units, where not ``metric``).
        ground: z of the ground plane.
        origin: of the local frame, None where unknown.
        metric: whether lengths are metres.
        assumed: one sentence on where the ground is and how sure this is.
        measured_altitude: metres over ground by the shift of neighbours, None where it could not be measured.
        told_altitude: median of the relative altitudes, None where none is usable.
        guessed: names of images whose focal length is not known.
    """

    frames: list[Frame]
    cameras: list[Camera]
    poses: Array
    ground: float
    origin: Origin | None
    metric: bool
    assumed: str
    measured_altitude: float | None = None
    told_altitude: float | None = None
    guessed: tuple[str, ...] = ()

    @property
    def heights(self) -> Array:
        """Of the cameras over the ground [n]."""
        return np.asarray(self.poses[:, 2, 3] - self.ground)


def place(flight: Flight, looks: Sequence[Look], altitude: float | None) -> Placement | None:
    """Put the cameras over the ground; None where neither cameras nor GPS positions are known.

    Given cameras in metres are taken first, then GPS, then given cameras of unknown scale that look down.

    Args:
        flight: its frames, in parallel with ``looks``.
        looks: at the images.
        altitude: metres over ground that the user states, or None.
    """
    given = _given(flight, altitude) if flight.cameras_from is not None else None
    if given is not None and given.metric:
        return given
    return _by_gps(flight, looks, altitude) or given


def _by_gps(flight: Flight, looks: Sequence[Look], altitude: float | None) -> Placement | None:
    known = [i for i, f in enumerate(flight.frames) if f.gps is not None]
    origin = flight.gps_origin()
    if len(known) < 2 or origin is None:
        return None
    frames = [flight.frames[i] for i in known]
    xy = positions(frames, origin)
    focals = [focal_px(f) for f in frames]
    cameras = [_camera(f, focal) for f, focal in zip(frames, focals)]
    shifts = shifts_of([looks[i] for i in known])
    measured = _measured(xy, cameras, shifts)
    told = np.array([f.relative_altitude if f.relative_altitude is not None else np.nan for f in frames], float)
    usable = told > USABLE_ALTITUDE
    median = float(np.median(told[usable])) if usable.sum() * 2 > len(told) else None
    if altitude is not None:
        level, assumed = altitude, f"Level ground {altitude:g} m below the cameras, as --altitude says."
    elif median is not None:
        level = median
        assumed = (
            f"Level ground at the height of the take-off, {median:.0f} m below the cameras by the drone's barometer: "
            "sure to a few metres over flat land, wrong by the slope elsewhere."
        )
    elif measured is not None:
        level = measured
        assumed = (
            f"Level ground {measured:.0f} m below the cameras, from GPS distances and the shift of reduced "
            "neighbouring images: sure to about 15 %; give --altitude if you know it."
        )
    else:
        return None
    heights = np.full(len(frames), level)
    if altitude is None and median is not None:
        heights = np.where(usable, told, level)
    elif all(f.gps is not None and f.gps.altitude is not None for f in frames):
        above = np.array([f.gps.altitude for f in frames if f.gps is not None], float)
        apart = above - np.median(above)
        heights = level + np.where(np.abs(apart) < 0.5 * level, apart, 0.0)
    turned = _headings(frames, xy, shifts)
    poses = np.stack([pose(r, [x, y, h]) for r, (x, y), h in zip(turned, xy, heights)])
    if any(f.gimbal is None for f in frames):
        assumed += " No gimbal angles: the cameras are taken to look straight down."
    guessed = tuple(f.name for f, focal in zip(frames, focals) if focal is None)
    return Placement(frames, cameras, poses, 0.0, origin, True, assumed, measured, median, guessed)


def positions(frames: Sequence[Frame], origin: Origin) -> Array:
    """East and north of frames with GPS [n, 2], metres."""
    told = [(f.gps.latitude, f.gps.longitude, origin.height) for f in frames if f.gps is not None]
    return enu_from_geodetic(told, origin)[:, :2]


def lines_of(xy: Array) -> list[NDArray[np.int64]]:
    """Runs of two or more consecutive positions [n, 2] that go on in one direction, at most :data:`TURN_DEG` a step."""
    steps = np.diff(xy, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    usual = float(np.median(lengths)) if len(lengths) else 0.0
    runs: list[list[int]] = []
    current = [0]
    for i, (step, length) in enumerate(zip(steps, lengths)):
        go_on = length <= 3 * usual
        if go_on and len(current) > 1 and length > 0:
            before = xy[i] - xy[i - 1]
            size = float(np.linalg.norm(before)) * float(length)
            go_on = size == 0 or float(before @ step) / size > math.cos(math.radians(TURN_DEG))
        if go_on:
            current.append(i + 1)
        else:
            runs.append(current)
            # The frame at a corner may belong to the line that follows; a lone step between lines is dropped below.
            current = [i, i + 1] if length <= 3 * usual and len(current) > 1 else [i + 1]
    runs.append(current)
    longest = max(map(len, runs), default=0)
    kept = [run for run in runs if len(run) >= (3 if longest > 3 else 2)]
    inner = {i for run in kept if len(run) > 2 for i in run}
    # A step from line to line is no line.
    return [np.array(run) for run in kept if len(run) > 2 or not set(run) <= inner]


def _given(flight: Flight, altitude: float | None) -> Placement | None:
    frames = [f for f in flight.frames if f.camera is not None and f.world_from_camera is not None]
    if len(frames) < 2:
        return None
    poses = np.stack([np.asarray(f.world_from_camera, float) for f in frames])
    cameras = [f.camera for f in frames if f.camera is not None]
    metric = flight.origin is not None or flight.cameras_from == "transforms.json"
    metric = metric and flight.facts.get("scale") != "unknown"
    middle = float(np.median(poses[:, 2, 3]))
    relative = [(p[2, 3], f.relative_altitude) for p, f in zip(poses, frames) if f.relative_altitude]
    stated = flight.facts.get("ground_height")
    if altitude is not None and metric:
        ground, how = middle - altitude, "as --altitude says"
    elif isinstance(stated, int | float) and not isinstance(stated, bool):
        ground, how = float(stated), f"as {flight.cameras_from} states"
    elif metric and relative and np.median([above for _, above in relative]) > USABLE_ALTITUDE:
        ground = float(np.median([z - above for z, above in relative]))
        how = "at the height of the take-off by the drone's barometer: sure to a few metres over flat land"
    else:
        from overfly.errors import InputError
        from overfly.mapping.coarse import coarse_points

        try:
            ground = float(np.median(coarse_points(frames, seed=0)[:, 2]))
        except InputError:
            return None
        how = "by a first look at a few pairs of images: sure to about a tenth of the height"
    if ground >= middle or np.median(poses[:, 2, 2]) > -0.2:
        return None  # a frame of its own, in which z is not up
    unit = "m" if metric else "units"
    assumed = f"Cameras of {flight.cameras_from}; level ground {middle - ground:.3g} {unit} below them, {how}."
    if altitude is not None and not metric:
        assumed += " --altitude is not used, because the scale of these cameras is unknown."
    return Placement(frames, cameras, poses, ground, flight.origin, metric, assumed)


def _camera(frame: Frame, focal: float | None) -> Camera:
    focal = focal or GUESSED_FOCAL * max(frame.width, frame.height)
    return Camera(frame.width, frame.height, focal, focal, frame.width / 2, frame.height / 2)


def _measured(xy: Array, cameras: list[Camera], shifts: Shifts) -> float | None:
    """Distance to the ground at which GPS distances become the shifts seen; None without three clear pairs."""
    moved = np.linalg.norm(np.diff(xy, axis=0), axis=1)
    seen = np.linalg.norm(shifts.xy, axis=1)
    focal = np.array([c.fx / c.width for c in cameras[:-1]])
    with np.errstate(invalid="ignore", divide="ignore"):
        distance = moved / seen * focal
    distance = distance[np.isfinite(distance) & (moved > 1.0) & (seen > 0.02)]
    if len(distance) < 3:
        return None
    low, middle, high = np.percentile(distance, [25, 50, 75])
    return float(middle) if high - low < 0.4 * middle else None


def _headings(frames: Sequence[Frame], xy: Array, shifts: Shifts) -> list[Array]:
    """Rotations [3, 3]: by the gimbal, else nadir and turned as the track and the shift of the picture tell."""
    track = np.zeros(len(frames))
    steps = np.diff(xy, axis=0)
    along = np.degrees(np.arctan2(steps[:, 0], steps[:, 1]))
    turn = np.zeros(len(frames))
    angles = shifts.angles()
    usual = angles[np.isfinite(angles)]
    # Without a clear shift the image's top is taken to lie along the line, or along its side if the others do.
    quarter = 90.0 if len(usual) and np.median(np.abs(np.sin(np.radians(usual)))) > 0.7 else 0.0
    for run in lines_of(xy):
        for i in run:
            k = i if i != run[-1] else i - 1
            track[i] = along[k]
            clear = angles[run[:-1]][np.isfinite(angles[run[:-1]])]
            turn[i] = float(np.median(clear)) if len(clear) >= 2 else quarter
    rotations = []
    for i, frame in enumerate(frames):
        yaw, pitch, roll = frame.gimbal or (track[i] - 90 * round(turn[i] / 90), -90.0, 0.0)
        rotations.append(rotation_from_gimbal(yaw, pitch, roll))
    return rotations
