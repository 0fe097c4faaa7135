"""The block of cameras that the flight folder holds, and what ground control makes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from overfly.errors import InputError
from overfly.flights import Flight, Frame
from overfly.flights.georeference import moved_poses
from overfly.geodesy import Origin
from overfly.geometry import fit_similarity
from overfly.mapping.block import Block, checked
from overfly.mapping.bundle import Bundle
from overfly.mapping.clicks import see
from overfly.mapping.control import FEWEST, checks_of, control_crs, control_origin, flat, read_controls, spread_m
from overfly.mapping.controlled import fitting, residual_of
from overfly.mapping.survey import Survey


def given_block(flight: Flight, control: str = "none") -> Block:
    """The cameras that the flight folder holds.

    Args:
        flight: with cameras.
        control: "split", "all" or "none". Ground control moves cameras that stand nowhere on the Earth, or only by the
            images' GPS, by a similarity, with "split" a quarter of it checks that; on all others it is a check.

    Raises:
        InputError: it holds none, or for fewer than two frames.
    """
    if flight.cameras_from is None:
        raise InputError(
            f"{flight.root} holds no cameras (transforms.json, sparse/0 or reconstruction.json): "
            "map it with --cameras estimate."
        )
    frames = [f for f in flight.frames if f.camera is not None and f.world_from_camera is not None]
    # A COLMAP model without an origin has a scale of its own; transforms.json is in metres by definition.
    metric = flight.origin is not None or flight.cameras_from == "transforms.json"
    metric = metric and flight.facts.get("scale") != "unknown"  # as our own transforms.json says of such blocks
    block = checked(Block(frames, flight.origin, flight.cameras_from, metric), flight)
    located = flight.facts.get("located")
    if flight.gcps and control != "none":
        free = flight.origin is None or located is not None
        origin = flight.origin or control_origin(flight.gcps)
        if origin is None:
            why = f"Ground control was not used: {len(flight.gcps)} points cannot place the cameras, three are needed."
            return replace(block, warnings=[why])
        block = _surveyed(block, flight, origin, control, free)
    if located is not None and (block.survey is None or block.survey.sigma_m is None):
        block = replace(block, warnings=[*block.warnings, located])
    return block


def _surveyed(block: Block, flight: Flight, origin: Origin, control: str, free: bool) -> Block:
    """The block with its survey about ``origin``; moved onto the controls if it is ``free``."""
    warnings: list[str] = []
    # Clicks are told in images as they are stored, the bundle has none but pinholes.
    own = [replace(frame, calibration=frame.camera) for frame in flight.frames]
    numbers = [k for k, frame in enumerate(own) if frame.camera is not None and frame.world_from_camera is not None]
    bundle, sizes = _pinholes(own, numbers), [(own[k].width, own[k].height) for k in numbers]
    controls = read_controls(replace(flight, frames=own), bundle, origin, warnings)
    seen = [see(bundle, point, sizes, warnings) for point in controls]
    if not free:
        usable = [i for i, view in enumerate(seen) if view is not None]
        warnings.append(
            f"The cameras are given on the Earth, so that ground control does not hold the map: all {len(usable)} "
            "points that two images see check it. With --cameras estimate they hold it."
        )
        points = [
            residual_of(bundle, point, "check" if i in usable else None, sizes) for i, point in enumerate(controls)
        ]
        return replace(block, survey=Survey(tuple(points)), warnings=warnings)
    usable = fitting(controls, seen, metric=flight.origin is not None, warnings=warnings)
    source = np.array([view.point for i in usable if (view := seen[i]) is not None]).reshape(-1, 3)
    target = np.array([controls[i].place for i in usable]).reshape(-1, 3)
    if len(usable) < FEWEST or flat(target):
        warnings.append(
            f"Ground control was not used: {len(usable)} of {len(controls)} points are seen in two or more images and "
            f"fit together; {FEWEST} that do not lie on a line are needed."
        )
        return replace(block, warnings=warnings)
    check = checks_of(target) if control == "split" else np.zeros(len(target), bool)
    if not check.any():
        warnings.append(f"All {len(usable)} usable control points hold the map, so that nothing checks it.")
    matrix = fit_similarity(source[~check], target[~check])
    bundle = bundle.moved(matrix)
    roles = {i: "check" if apart else "control" for i, apart in zip(usable, check, strict=True)}
    points = [residual_of(bundle, point, roles.get(i), sizes) for i, point in enumerate(controls)]
    flat_m, up_m = (round(float(v), 4) for v in spread_m(source[~check], target[~check], scaled=True))
    epsg, vertical = control_crs(flight.gcps[0].crs)
    poses = moved_poses(matrix, block.poses)
    moved = replace(
        block,
        frames=[replace(frame, world_from_camera=pose) for frame, pose in zip(block.frames, poses, strict=True)],
        origin=replace(origin, epsg=epsg or origin.epsg, vertical_epsg=vertical),
        metric=True,
        warnings=warnings,
    )
    away = moved.gps_residuals()
    away = away[np.isfinite(away).all(1)]
    shift = None
    if len(away):
        east, north, up = (round(float(v), 3) for v in np.median(away, axis=0))
        shift = east, north, up
    return replace(moved, survey=Survey(tuple(points), (flat_m, up_m), shift))


def _pinholes(frames: list[Frame], numbers: list[int]) -> Bundle:
    """The frames with cameras as a bundle without points, their lenses straightened (:meth:`Frame.straight`)."""
    poses = np.stack([np.asarray(frames[k].world_from_camera, float) for k in numbers])
    lenses = []
    for k in numbers:
        pinhole = frames[k].pinhole
        assert pinhole is not None
        lenses.append([pinhole.fx, pinhole.cx, pinhole.cy, 0.0, 0.0])
    count, nobody = len(numbers), np.zeros(0, np.intp)
    return Bundle(
        frames=np.array(numbers, np.intp),
        rotations=poses[:, :3, :3].transpose(0, 2, 1),
        centres=poses[:, :3, 3],
        lens_of=np.arange(count),
        lenses=np.array(lenses),
        lens_ids=tuple(range(count)),
        points=np.zeros((0, 3)),
        image=nobody,
        point=nobody,
        pixels=np.zeros((0, 2)),
    )
