"""Cameras of a reconstruction that has a frame and a scale of its own, brought to where they stood."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from overfly.errors import InputError
from overfly.flights.flight import Flight
from overfly.flights.georeference import by_gps, by_ground, level_line, moved_poses, on_a_line, upright
from overfly.geodesy import Origin, enu_from_geodetic
from overfly.geometry import Array, transform

FREE = ("sparse", "sparse/0", "reconstruction.json")
"""Sources of cameras that are free where they have no origin; transforms.json is in metres, z up, by definition."""

BY_GPS = "gps"
"""Fact ``located`` of a flight whose cameras have their place and scale by the images' GPS alone."""

LEVEL_DEG = 20.0
"""Without GPS a model's frame is kept if its z axis is so near to the vertical that its ground or cameras tell."""

FEWEST_POINTS = 50
"""Points of a model that tell its ground."""


def located(flight: Flight) -> Flight:
    """The flight, its cameras in local ENU metres by the images' GPS if they come from a model without an origin.

    Without GPS the cameras are levelled by the model's points, else by the gimbals or their mean view, unless the
    model's z axis points up already; their scale stays unknown.
    """
    if flight.cameras_from not in FREE or flight.origin is not None:
        return flight
    own = [k for k, frame in enumerate(flight.frames) if frame.world_from_camera is not None]
    if len(own) < 2:
        return flight
    poses = np.stack([np.asarray(flight.frames[k].world_from_camera, float) for k in own])
    gimbals = [flight.frames[k].gimbal for k in own]
    centres, turns = poses[:, :3, 3], poses[:, :3, :3]
    origin, told = gps_frame(flight)
    try:
        if told is None:
            raise InputError("The images carry no GPS.")
        told = told[own]
        matrix = by_gps(centres, told, gimbals, turns)
        if on_a_line(told):
            moved = moved_poses(matrix, poses)
            matrix = level_line(moved[:, :3, 3], gimbals, moved[:, :3, :3]) @ matrix
    except InputError:
        matrix, origin = _levelled(flight, centres, turns, gimbals), None
    frames = list(flight.frames)
    for k, moved_pose in zip(own, moved_poses(matrix, poses), strict=True):
        frames[k] = replace(frames[k], world_from_camera=moved_pose)
    if origin is None:
        return replace(flight, frames=frames)
    assert told is not None
    away = np.linalg.norm((transform(matrix, centres) - told)[:, :2], axis=1)
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    sentence = (
        f"The cameras of {flight.cameras_from} were brought to the images' GPS: one of its units is {scale:.4g} m, and "
        f"they are {float(np.sqrt(np.nanmean(away**2))):.2f} m off it (RMS, horizontal)."
    )
    return replace(
        flight,
        frames=frames,
        origin=origin,
        facts={**flight.facts, "located": BY_GPS},
        warnings=[*flight.warnings, sentence],
    )


def gps_frame(flight: Flight) -> tuple[Origin | None, Array | None]:
    """The local frame of a flight's GPS and the positions in it [n, 3], NaN where unknown; None without GPS."""
    fixes = [frame.gps for frame in flight.frames]
    known = [fix for fix in fixes if fix is not None]
    if len(known) < 2:
        return None, None
    origin = flight.origin or flight.gps_origin()
    assert origin is not None
    told = np.full((len(fixes), 3), np.nan)
    for i, fix in enumerate(fixes):
        if fix is not None:
            height = origin.height if fix.altitude is None else fix.altitude
            told[i] = enu_from_geodetic([[fix.latitude, fix.longitude, height]], origin)[0]
            told[i, 2] = np.nan if fix.altitude is None else told[i, 2]
    return origin, told


def _levelled(flight: Flight, centres: Array, turns: Array, gimbals: list[tuple[float, float, float] | None]) -> Array:
    """The similarity [4, 4] that turns a model's vertical to +z; the identity if it is there already."""
    from overfly.flights.colmap import read_colmap_points

    assert flight.cameras_from is not None
    model = flight.root / flight.cameras_from
    points = read_colmap_points(model) if model.is_dir() else np.zeros((0, 3))
    if len(points) >= FEWEST_POINTS:
        matrix = by_ground(centres, points, turns, seed=0)
    else:
        matrix = np.eye(4)
        matrix[:3, :3] = upright(gimbals, turns)
    up = matrix[2, :3] / np.linalg.norm(matrix[2, :3])
    return np.eye(4) if up[2] > np.cos(np.deg2rad(LEVEL_DEG)) else matrix
