"""Cameras estimated from the images: verified matches, sparse mapping, adjustment held by GPS and ground control."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from overfly.errors import InputError
from overfly.flights import Flight, Frame
from overfly.flights.georeference import by_ground
from overfly.flights.locate import gps_frame
from overfly.geodesy import Origin
from overfly.geometry import Array, Camera
from overfly.mapping.adjustment import Adjusted
from overfly.mapping.block import Block
from overfly.mapping.bundle import Bundle
from overfly.mapping.calibration import FOCAL_TRIED, UNTOLD, adjusted_twice, calibrated, composed, held_by_images
from overfly.mapping.control import control_origin, control_places
from overfly.mapping.controlled import Controlled, controlled, placed_by_controls
from overfly.mapping.database import focal_px, strongest_pair
from overfly.mapping.depth_ranges import beside_others
from overfly.mapping.matches import Bar, matched
from overfly.mapping.placing import UNKNOWN_M, placed, some_of
from overfly.mapping.sparse import sparse_parts
from overfly.mapping.survey import Precision
from overfly.mapping.ties import untied
from overfly.networks.encoder import Encoder

FEWEST_TO_JUDGE, UNJUDGED_M = 4, 1.5
"""GPS positions from which on their misfit tells what they are worth, and what is taken of fewer, metres."""

SCALE_UNSURE = 0.04
"""Standard deviation of the scale by GPS, as a share, from which on it is told."""

FOCAL_DRIFT = 0.1
"""Share by which a focal length may differ from the photos' data before this is said."""


def align(
    flight: Flight,
    *,
    workdir: Path,
    seed: int,
    bar: Bar,
    matcher: str = "sift",
    encoder: Callable[[], Encoder] | None = None,
    control: str = "split",
) -> Block:
    """Estimate the cameras of a flight.

    Args:
        flight: frames with GPS and focal lengths where their files tell them; cameras they may have are not used, a
            ``calibration`` is kept as it is.
        workdir: features, matches and the sparse models are kept here, and reused.
        seed: of every random choice; the same seed gives the same cameras.
        bar: (step, unit) -> context manager of a function that takes (done, total).
        matcher: what finds the key points: "sift", "encoder", "both", or "auto": both where SIFT's matches are too few.
        encoder: loads that of a trained network; not needed by "sift", and by "auto" only where it is asked.
        control: what the flight's ground control points do: "split" keeps a quarter as check points, "all" puts all
            of them into the adjustment, "none" leaves them aside.

    Returns:
        The block of the registered frames: in local ENU metres where GPS or three control points place it, else in a
        levelled frame whose cameras stand 100 units above the ground and ``metric`` is False.

    Raises:
        InputError: fewer than two images could be placed, or the CRS of the controls cannot be used.
    """
    import pycolmap
    import scipy.linalg  # noqa: F401  # brings a BLAS of its own, which is limited below
    from threadpoolctl import threadpool_limits

    # Warnings of the sparse solver speak of its inside; what matters is said in the block's own warnings.
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    if len(flight.frames) < 2:
        raise InputError(f"Cameras cannot be estimated from {len(flight.frames)} image: give two or more that overlap.")
    if control != "none":
        control_places(flight.gcps)  # refuses a CRS that does not fit, or lacks its grid, before the long steps
    workdir.mkdir(parents=True, exist_ok=True)
    warnings: list[str] = []
    flight = _without_doubtful_lenses(flight, warnings)
    origin, told = gps_frame(flight)

    def matches_by(how: str) -> tuple[Path, list[str]]:
        network = encoder() if encoder is not None and how != "sift" else None
        return matched(flight, told, workdir, matcher=how, encoder=network, seed=seed, bar=bar)

    database, guessed = matches_by("sift" if matcher == "auto" else matcher)
    more = (lambda: matches_by("both")[0]) if matcher == "auto" and encoder is not None else None
    if guessed:
        warnings.append(
            f"The focal length of {len(guessed)} images is not known and was estimated from the images alone: "
            "keep the photos' EXIF, or give a calibrated camera by --calibration."
        )
    with bar("cameras", "models") as update:
        # Small matrices gain nothing by more threads, and their sums would depend on the machine.
        with threadpool_limits(1, user_api="blas"):
            parts = sparse_parts(database, flight, guessed, told, workdir, seed, bar, warnings, more)
        update(1, 2)
        if not parts:
            raise InputError(
                f"No two of the {len(flight)} images could be placed together (best pair: "
                f"{strongest_pair(database)} common points, 15 needed): give sharp images that overlap by 30 % or more."
            )
        with threadpool_limits(1, user_api="blas"):
            block = _held_block(flight, parts, origin, told, control, warnings, seed)
        update(2, 2)
    return block


def _held_block(
    flight: Flight,
    parts: list[Bundle],
    origin: Origin | None,
    told: Array | None,
    control: str,
    warnings: list[str],
    seed: int,
) -> Block:
    """The adjusted block, by what there is: GPS and controls, either, or the ground alone."""
    at = None
    if told is not None:
        try:
            at = placed(parts, flight.frames, told, warnings)
        except InputError as error:
            warnings.append(f"{error} The map has no metric scale.")
    apart: list[str] = []
    if at is not None:
        held = replace(held_by_images(at.bundle, flight.frames), ups=at.ups, easts=at.easts)
        held = replace(held, places=at.places, place_sigmas=at.sigmas, lever=True)
        result = adjusted_twice(at.bundle, held, flight.frames)
        _remark_scale(at.places[:, :2], at.sigmas[:, :2], warnings)
        apart = [flight.frames[i].name for i in at.apart]
        own = [flight.frames[i] for i in result.bundle.frames]
        alone = np.isin(result.bundle.frames, at.apart)
        if apart:
            warnings.append(
                f"{some_of(alone, own)} have too few points in common with the others and are held by GPS only: "
                "between them and the rest the map may step by the error of GPS."
            )
        if len(own) > 2 and (loose := untied(result.bundle) & ~alone).any():
            warnings.append(
                f"{some_of(loose, own)} share ground with others two at a time only: how far apart they stand is told "
                "by their positions (GPS, ground control) and not by the images, and heights there are wrong by as "
                "much, in percent. Fly with 60 % overlap or more along the lines."
            )
    else:
        bundle = parts[0]
        # A scale near metres: the unit of a sparse model is arbitrary.
        result = adjusted_twice(bundle, held_by_images(bundle, flight.frames), flight.frames)
    result, untold = calibrated(result)
    ruled: Controlled | None = None
    if flight.gcps and control != "none":
        if at is None and (origin := control_origin(flight.gcps)) is not None:
            result = placed_by_controls(flight, result, origin, warnings)
        if origin is not None:
            ruled = controlled(flight, result, origin, with_gps=at is not None, how=control, warnings=warnings)
            result, origin = ruled.adjusted, ruled.in_their_crs(origin)
    metric = at is not None or (ruled is not None and ruled.used)
    if not metric:
        origin = None
        bundle = result.bundle
        lift = by_ground(bundle.centres, bundle.points, bundle.world_from_camera, seed)
        result = replace(result, bundle=bundle.moved(lift))
    if untold and not (ruled is not None and ruled.used):
        warnings.append(
            f"{UNTOLD}: one that is {100 * FOCAL_TRIED:.0f} % longer would explain them "
            "as well. Differences in height may be wrong by as much: use ground control, add images from another "
            "height, or give a calibrated camera by --calibration."
        )
    _remark_focal(result.bundle, [flight.frames[i] for i in result.bundle.frames], warnings)
    return _block(result, flight.frames, origin, metric, ruled, at is not None, apart, warnings)


def _without_doubtful_lenses(flight: Flight, warnings: list[str]) -> Flight:
    """The flight without lenses in the photos whose focal length the photos' other data contradict."""
    frames, doubtful = [], []
    for frame in flight.frames:
        other = focal_px(replace(frame, lens=None, calibration=None))
        if frame.lens is not None and other and abs(frame.lens.fx / other - 1) > FOCAL_DRIFT:
            doubtful.append(f"{frame.lens.fx:.0f} px in {frame.name}, by other data {other:.0f} px")
            frame = replace(frame, lens=None)
        frames.append(frame)
    if doubtful:
        warnings.append(
            f"The lens in {len(doubtful)} photos (DewarpData) was not used: its focal length is {doubtful[0]}. Images "
            "that were cut or resized may keep that of the whole; give a calibrated camera by --calibration."
        )
    return replace(flight, frames=frames) if doubtful else flight


def _remark_scale(places: Array, sigmas: Array, warnings: list[str]) -> None:
    """Say how well positions [n, 2] with standard deviations [n, 2] tell the scale, where they tell it badly."""
    known = np.isfinite(places).all(1)
    spread = float(np.sqrt(((places[known] - places[known].mean(0)) ** 2).sum()))
    sigma = float(np.median(sigmas[known]))
    if known.sum() < FEWEST_TO_JUDGE:  # their misfit shows nothing of what they are worth
        sigma = max(sigma, UNJUDGED_M)
    share = sigma / max(spread, 1e-9)
    if share > SCALE_UNSURE:
        warnings.append(
            f"The scale is known to about {100 * share:.0f} % only: {known.sum()} GPS positions within "
            f"{np.ptp(places[known], axis=0).max():.0f} m tell it, each good to {sigma:.1f} m. Lengths "
            "and heights are wrong by as much: fly over more ground, or use ground control."
        )


def _remark_focal(bundle: Bundle, frames: list[Frame], warnings: list[str]) -> None:
    """Say where the images and the photo's own data disagree about the focal length."""
    for j in range(len(bundle.lenses)):
        frame, found = frames[int(np.flatnonzero(bundle.lens_of == j)[0])], float(bundle.lenses[j, 0])
        prior = focal_px(replace(frame, calibration=None))
        if prior and frame.calibration is not None and abs(found / prior - 1) > FOCAL_DRIFT:
            warnings.append(
                f"The calibration has a focal length of {found:.0f} px, the photos' data say {prior:.0f} px: if it is "
                "of another camera or zoom, heights are wrong by as much; map without --calibration to compare."
            )
        elif prior and abs(found / prior - 1) > FOCAL_DRIFT:
            warnings.append(
                f"The focal length came out as {found:.0f} px, the photos' data say {prior:.0f} px: heights may be "
                f"wrong by up to {100 * abs(found / prior - 1):.0f} % where the overlap is weak."
            )


def _block(
    result: Adjusted,
    frames: Sequence[Frame],
    origin: Origin | None,
    metric: bool,
    ruled: Controlled | None,
    told: bool,
    apart: list[str],
    warnings: list[str],
) -> Block:
    bundle, extra = result.bundle, 0 if ruled is None else ruled.added
    known = [
        replace(
            frames[i],
            camera=_camera(frames[i], bundle.camera(k, frames[i].width, frames[i].height)),
            world_from_camera=bundle.pose(k),
        )
        for k, i in enumerate(bundle.frames.tolist())
    ]
    tied = bundle.point < len(bundle.points) - extra
    errors = bundle.errors()
    mean = np.bincount(bundle.point, errors, minlength=len(bundle.points)) / np.maximum(
        np.bincount(bundle.point, minlength=len(bundle.points)), 1
    )
    points = bundle.points[: len(bundle.points) - extra]
    points = points[mean[: len(points)] < 2]
    return Block(
        frames=known,
        origin=origin,
        cameras_from="estimated",
        metric=metric,
        reprojection_px=float(errors[tied].mean()) if tied.any() else None,
        points=points[beside_others(points, bundle.centres)],
        survey=None if ruled is None else ruled.survey,
        precision=precision_of(result) if metric else Precision(why_not="no GPS and no control gives the block metres"),
        links=[(i, j, count) for (i, j), count in bundle.links().items()],
        antenna=(float(result.lever[0]), float(result.lever[1]), float(result.lever[2])) if origin and told else None,
        held_by_gps=apart,
        warnings=warnings,
    )


def _camera(frame: Frame, found: Camera) -> Camera:
    """The camera of an image as it is stored, of the one that was found with straightened pixels."""
    if frame.calibration is not None or frame.lens is None:
        return frame.calibration or found
    return composed(frame.lens, found)


def precision_of(result: Adjusted) -> Precision:
    """Standard deviations of the cameras, or why there are none."""
    if (result.held.place_sigmas[:, 2] >= UNKNOWN_M).all() and not np.isfinite(result.held.knows).any():
        return Precision(why_not="the heights of the cameras are unknown, so that nothing holds the block")
    found = result.deviations()
    if found is None:
        return Precision(why_not="fewer than three positions hold the block")
    positions, rotations, focals = found
    return Precision(positions, np.rad2deg(rotations), float(focals[~result.held.lens_fixed].max(initial=0.0)) or None)
