"""The block of cameras that the flight folder holds, and what ground control makes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from overfly.errors import InputError
from overfly.flights import Flight, Frame
from overfly.flights.georeference import moved_poses
from overfly.geodesy import enu_from_geodetic, geodetic_from_enu
from overfly.geometry import Array, fit_similarity
from overfly.mapping.block import Block, checked
from overfly.mapping.bundle import Bundle
from overfly.mapping.clicks import Control, see
from overfly.mapping.control import (
    FEWEST,
    checks_of,
    consistent,
    control_origin,
    flat,
    read_controls,
    spread_m,
)
from overfly.mapping.controlled import residual_of
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
        origin = (control_origin(flight.gcps) if free else None) or flight.origin
        if origin is None:
            why = f"Ground control was not used: {len(flight.gcps)} points cannot place the cameras, three are needed."
            return replace(block, warnings=[why])
        block = _surveyed(block, replace(block, origin=origin, metric=True), flight, control, free)
    if located is not None and (block.survey is None or block.survey.sigma_m is None):
        block = replace(block, warnings=[*block.warnings, located])
    return block


def _surveyed(block: Block, placed: Block, flight: Flight, control: str, free: bool) -> Block:
    """The block with its survey; moved onto the controls if it is ``free``, then with the origin of ``placed``."""
    assert placed.origin is not None
    warnings: list[str] = []
    # Clicks are told in images as they are stored, the bundle has none but pinholes.
    own = [replace(frame, calibration=frame.camera) for frame in flight.frames]
    numbers = [k for k, frame in enumerate(own) if frame.camera is not None and frame.world_from_camera is not None]
    bundle, sizes = _pinholes(own, numbers), [(own[k].width, own[k].height) for k in numbers]
    controls = read_controls(replace(flight, frames=own), bundle, placed.origin, warnings)
    seen = [see(bundle, point, sizes, warnings) for point in controls]
    usable = [i for i, view in enumerate(seen) if view is not None]
    source = np.array([view.point for view in seen if view is not None]).reshape(-1, 3)
    target = np.array([controls[i].place for i in usable]).reshape(-1, 3)
    check = np.ones(len(usable), bool)
    sigma: tuple[float, float] | None = None
    if free:
        good = consistent(source, _in_frame(block, placed, target), metric=block.metric)
        warnings += [_contradicts(controls[i]) for i, fits in zip(usable, good, strict=True) if not fits]
        if good.sum() < FEWEST or flat(target[good]):
            warnings.append(
                f"Ground control was not used: {int(good.sum())} of {len(controls)} points are seen in two or more "
                f"images and fit together; {FEWEST} that do not lie on a line are needed."
            )
            return replace(block, warnings=warnings)
        usable = [i for i, fits in zip(usable, good, strict=True) if fits]
        source, target = source[good], target[good]
        check = checks_of(target) if control == "split" else np.zeros(len(target), bool)
        if not check.any():
            warnings.append(f"All {len(usable)} usable control points hold the map, so that nothing checks it.")
        matrix = fit_similarity(source[~check], target[~check])
        bundle = bundle.moved(matrix)
        flat_m, up_m = (round(float(v), 4) for v in spread_m(source[~check], target[~check], scaled=True))
        sigma = flat_m, up_m
        poses = moved_poses(matrix, block.poses)
        frames = [replace(f, world_from_camera=pose) for f, pose in zip(block.frames, poses, strict=True)]
        block = replace(placed, frames=frames)
    else:
        warnings.append(
            f"The cameras are given on the Earth, so that ground control does not hold the map: all {len(usable)} "
            "points that two images see check it. With --cameras estimate they hold it."
        )
    shift = block.gps_residuals() if sigma is not None else np.full((1, 3), np.nan)
    known = shift[np.isfinite(shift).all(1)]
    east, north, up = (round(float(v), 3) for v in np.median(known, axis=0)) if len(known) else (0.0, 0.0, 0.0)
    gps_shift = (east, north, up) if len(known) else None
    roles = {i: "check" if apart else "control" for i, apart in zip(usable, check, strict=True)}
    points = [residual_of(bundle, point, roles.get(i), sizes) for i, point in enumerate(controls)]
    return replace(block, survey=Survey(tuple(points), sigma, gps_shift), warnings=warnings)


def _in_frame(block: Block, placed: Block, target: Array) -> Array:
    """Places [n, 3] about the origin of ``placed`` in a block's frame if it stands on the Earth; else as they are."""
    if block.origin is None or placed.origin is None or not block.metric:
        return target
    return enu_from_geodetic(geodetic_from_enu(target, placed.origin), block.origin)


def _contradicts(control: Control) -> str:
    return (
        f"The control point {control.name} contradicts the others and was not used: check its coordinates and its "
        "pixels in gcp_list.txt."
    )


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
