"""Cameras estimated from the images: verified matches, global mapping, bundle adjustment held by GPS."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from overfly.errors import InputError
from overfly.flights import Flight, Frame
from overfly.geodesy import Origin, enu_from_geodetic
from overfly.geometry import Array, Camera, pose
from overfly.mapping.block import Block
from overfly.mapping.database import focal_px, strongest_pair
from overfly.mapping.georeference import by_gps, by_ground, level_line, on_a_line
from overfly.mapping.matches import Bar, matched
from overfly.mapping.model import adjust, centres_and_rotations, mapped, moved
from overfly.networks.encoder import Encoder

GPS_SIGMA_M = (0.5, 0.5)
"""Standard deviation of GPS within one flight, horizontal and vertical, where the file does not state it."""

BAROMETER_SIGMA_M = 0.15
"""The same of a height that the drone's barometer holds (frames with a relative altitude)."""

FAR_OFF_M = 8.0
"""A frame at least this far (and six times the median) off the common fit has a wrong GPS position."""

FOCAL_DRIFT = 0.1


def align(
    flight: Flight, *, workdir: Path, seed: int, bar: Bar, matcher: str = "sift", encoder: Encoder | None = None
) -> Block:
    """Estimate the cameras of a flight.

    Args:
        flight: frames with GPS and focal lengths where their files tell them; cameras they may have are not used.
        workdir: features, matches and the sparse model are kept here, and reused.
        seed: of every random choice; the same seed gives the same cameras.
        bar: (step, unit) -> context manager of a function that takes (done, total).
        matcher: what finds the key points: "sift", "encoder" or "both".
        encoder: of a trained network; not needed by "sift".

    Returns:
        The block of the registered frames: in local ENU metres where the images have GPS, else in a levelled frame
        whose cameras stand 100 units above the ground and ``metric`` is False.

    Raises:
        InputError: fewer than two images could be placed.
    """
    import pycolmap

    # Warnings of the sparse solver speak of its inside; what matters is said in the block's own warnings.
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    if len(flight.frames) < 2:
        raise InputError(f"Cameras cannot be estimated from {len(flight.frames)} image: give two or more that overlap.")
    workdir.mkdir(parents=True, exist_ok=True)
    warnings: list[str] = []
    origin, told = gps_frame(flight)
    database, guessed = matched(flight, told, workdir, matcher=matcher, encoder=encoder, seed=seed, bar=bar)
    if guessed:
        warnings.append(
            f"The focal length of {len(guessed)} images is not known and was estimated from the images alone: "
            "keep the photos' EXIF, or give a calibrated camera."
        )
    with bar("cameras", "models") as update:
        model = mapped(database, flight.root, workdir, total=len(flight), seed=seed)
        update(1, 2)
        if model is None or model.num_reg_images() < 2:
            raise InputError(
                f"No two of the {len(flight)} images could be placed together (best pair: "
                f"{strongest_pair(database)} common points, 15 needed): give sharp images that overlap by 30 % or more."
            )
        ids = sorted(model.reg_image_ids())
        index = {frame.name: i for i, frame in enumerate(flight.frames)}
        order = [index[model.images[i].name] for i in ids]
        registered = [flight.frames[i] for i in order]
        model, metric = _placed(model, ids, registered, None if told is None else told[order], warnings, seed)
        update(2, 2)
    _remark_focal(model, ids, registered, warnings)
    return _block(model, ids, registered, order, origin if metric else None, metric, warnings)


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


def _placed(
    model: Any, ids: list[int], frames: list[Frame], told: Array | None, warnings: list[str], seed: int
) -> tuple[Any, bool]:
    """The adjusted model in its final frame, and whether that is metric."""
    gimbals = [frame.gimbal for frame in frames]
    centres, rotations = centres_and_rotations(model, ids)
    matrix = None
    if told is not None:
        try:
            matrix = by_gps(centres, told, gimbals, rotations)
        except InputError as error:
            warnings.append(f"{error} The map has no metric scale.")
    if matrix is None or told is None:
        model = adjust(model, ids, None, None, seed=seed)
        centres, rotations = centres_and_rotations(model, ids)
        points = np.array([p.xyz for p in model.points3D.values()]).reshape(-1, 3)
        return moved(model, by_ground(centres, points, rotations, seed)), False
    model = moved(model, matrix)
    away = centres_and_rotations(model, ids)[0] - told
    away[:, 2] = np.nan_to_num(away[:, 2])
    distance = np.linalg.norm(away, axis=1)
    wrong = distance > max(FAR_OFF_M, 6 * float(np.nanmedian(distance)))
    if wrong.any():
        names = ", ".join(frames[k].name for k in np.flatnonzero(wrong)[:5])
        warnings.append(f"The GPS position of {int(wrong.sum())} images is far off and was not used: {names}.")
    places, sigmas = np.where(wrong[:, None], np.nan, told), _sigmas(frames)
    if np.isnan(places[:, 2]).all():
        places[:, 2], sigmas[:, 2] = centres_and_rotations(model, ids)[0][:, 2], 1e3
    model = adjust(model, ids, places, sigmas, seed=seed)
    if on_a_line(told):
        # GPS along a line holds the ends only: the block may have rolled about it.
        centres, rotations = centres_and_rotations(model, ids)
        model = moved(model, level_line(centres, gimbals, rotations))
    return model, True


def _sigmas(frames: list[Frame]) -> Array:
    """Standard deviations [n, 3] of the frames' GPS positions, metres."""
    barometer = all(frame.relative_altitude is not None for frame in frames)
    rows = []
    for frame in frames:
        stated = (frame.gps.horizontal_m, frame.gps.vertical_m) if frame.gps else (None, None)
        flat = stated[0] or GPS_SIGMA_M[0]
        rows.append([flat, flat, stated[1] or (BAROMETER_SIGMA_M if barometer else GPS_SIGMA_M[1])])
    return np.array(rows)


def _remark_focal(model: Any, ids: list[int], frames: list[Frame], warnings: list[str]) -> None:
    """Say where the images and the photo's own data disagree about the focal length."""
    for i in {model.images[i].camera_id: i for i in ids}.values():
        prior, found = focal_px(frames[ids.index(i)]), float(model.images[i].camera.params[0])
        if prior and abs(found / prior - 1) > FOCAL_DRIFT:
            warnings.append(
                f"The focal length came out as {found:.0f} px, the photos' data say {prior:.0f} px: heights may be "
                f"wrong by up to {100 * abs(found / prior - 1):.0f} % where the overlap is weak."
            )


def _block(
    model: Any,
    ids: list[int],
    frames: list[Frame],
    order: list[int],
    origin: Origin | None,
    metric: bool,
    warnings: list[str],
) -> Block:
    centres, rotations = centres_and_rotations(model, ids)
    placed: dict[int, Frame] = {}
    for i, number, frame, centre, rotation in zip(ids, order, frames, centres, rotations, strict=True):
        f, cx, cy, k1, k2 = (float(v) for v in model.images[i].camera.params)
        camera = Camera(frame.width, frame.height, f, f, cx, cy, k1=k1, k2=k2)
        placed[number] = replace(frame, camera=camera, world_from_camera=pose(rotation, centre))
    points = np.array([p.xyz for p in model.points3D.values() if p.error < 2]).reshape(-1, 3)
    return Block(
        frames=[placed[number] for number in sorted(placed)],
        origin=origin,
        cameras_from="estimated",
        metric=metric,
        reprojection_px=float(model.compute_mean_reprojection_error()),
        points=points,
        warnings=warnings,
    )
