"""Cameras of a reconstruction that has a frame and a scale of its own, brought to where they stood."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from overfly.errors import InputError
from overfly.flights.flight import Flight
from overfly.flights.georeference import by_gps, by_ground, moved_poses, upright
from overfly.geodesy import Origin, enu_from_geodetic
from overfly.geometry import Array, transform

FREE = ("sparse", "sparse/0", "reconstruction.json")
"""Sources of cameras that are free where they have no origin; transforms.json is in metres, z up, by definition."""

LEVEL_DEG = 20.0
"""Without GPS a model's frame is kept if its z axis is so near to the vertical that its ground or cameras tell."""

FEWEST_POINTS, MOST_POINTS = 50, 5000
"""Points of a model that tell its ground, and how many of them are looked at."""

AMISS = 0.2
"""Share of the spread of the GPS positions by which cameras may miss them, or they tell no scale."""


def located(flight: Flight) -> Flight:
    """The flight, its cameras in local ENU metres by the images' GPS if they come from a model without an origin.

    Without GPS the cameras are levelled by the model's points, else by the gimbals or their mean view, unless the
    model's z axis points up already; their scale stays unknown. Where a reference cloud lies beside them, in their own
    frame, they stay as they are.
    """
    if flight.cameras_from not in FREE or flight.origin is not None or flight.reference is not None:
        return flight
    own = [k for k, frame in enumerate(flight.frames) if frame.world_from_camera is not None]
    if len(own) < 2:
        return flight
    poses = np.stack([np.asarray(flight.frames[k].world_from_camera, float) for k in own])
    gimbals = [flight.frames[k].gimbal for k in own]
    centres, turns = poses[:, :3, 3], poses[:, :3, :3]
    origin, told = gps_frame(flight)
    matrix = None if told is None else _by_gps(centres, told[own], gimbals, turns)
    facts = dict(flight.facts)
    if matrix is None or told is None:
        matrix, origin = _levelled(flight, centres, turns, gimbals), None
    else:
        facts["located"] = (
            f"The cameras of {flight.cameras_from} were brought to the images' GPS: one of its units is "
            f"{float(np.cbrt(np.linalg.det(matrix[:3, :3]))):.4g} m, and they are "
            f"{_amiss(matrix, centres, told[own]):.2f} m off it (RMS, horizontal)."
        )
    frames = list(flight.frames)
    for k, moved in zip(own, moved_poses(matrix, poses), strict=True):
        frames[k] = replace(frames[k], world_from_camera=moved)
    return replace(flight, frames=frames, origin=origin, facts=facts)


def _by_gps(
    centres: Array, told: Array, gimbals: list[tuple[float, float, float] | None], turns: Array
) -> Array | None:
    """The similarity that brings cameras to their GPS; None where that tells no scale."""
    try:
        matrix = by_gps(centres, told, gimbals, turns)
    except InputError:
        return None
    spread = float(np.sqrt(np.nanvar(told[:, :2], axis=0).sum()))
    return matrix if _amiss(matrix, centres, told) <= AMISS * spread else None


def _amiss(matrix: Array, centres: Array, told: Array) -> float:
    """RMS of the horizontal distances between cameras, moved by a similarity, and their GPS, metres."""
    away = np.linalg.norm((transform(matrix, centres) - told)[:, :2], axis=1)
    return float(np.sqrt(np.nanmean(away**2)))


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
    points = points[:: len(points) // MOST_POINTS + 1]
    matrix, surely = np.eye(4), np.cos(np.deg2rad(LEVEL_DEG))
    if len(points) >= FEWEST_POINTS:
        matrix = by_ground(centres, points, turns, seed=0)
    else:
        matrix[:3, :3] = upright(gimbals, turns)
        if all(gimbal is None for gimbal in gimbals):  # the mean view of oblique images is no vertical
            surely = 0.0
    up = matrix[2, :3] / np.linalg.norm(matrix[2, :3])
    return np.eye(4) if up[2] > surely else matrix
