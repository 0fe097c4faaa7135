"""Bundles brought to metres by the images' own GPS, each by itself, then together; and GPS that is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from overfly.errors import InputError
from overfly.flights import Frame
from overfly.flights.georeference import by_gps, level_line, on_a_line
from overfly.geometry import Array, rotation_from_gimbal
from overfly.mapping.bundle import Bundle, components, merged
from overfly.mapping.ties import placed_by_others

GPS_SIGMA_M = (0.5, 0.5)
"""Standard deviation of GPS within one flight, horizontal and vertical, where the file does not state it."""

BAROMETER_SIGMA_M = 0.15
"""The same of a height that the drone's barometer holds (frames with a relative altitude)."""

FAR_OFF_M = 8.0
"""A position or height at least this far (and six times the median) off the common fit is wrong."""

DISTORTED = 0.05
"""Share of the flight's extent by which cameras may be off GPS: delays and antennas move them by some metres."""

LOST = 4.0
"""Times as far as most may be, at which a single image counts as lost."""

TILTED_DEG, LEVEL_DEG, FEWEST_GIMBALS = 20.0, 5.0, 4
"""An image whose vertical is so far from the gimbals' is placed wrongly, if half of so many at least are less far off.
Headings are not asked: Brighton's gimbals tell those of one line the other way round."""

TURNED_DEG = 20.0
"""A heading that is so far from what most are off is wrong, or the image is."""

FEW_RAYS, FEWEST_TO_SCATTER = 150, 8
"""Rays from which on an image is believed against its gimbal, and gimbals that tell what is usual."""

SCATTERED, LEAST_OFF_DEG = 5.0, 2.0
"""Times as far off its gimbal's vertical as is usual, and degrees, beyond which an image of few rays is wrong."""

UNKNOWN_M = 1e3
"""Standard deviation of a height of which nothing is known."""

FEWEST_OF_A_PART = 2
"""Frames with GPS that place a part of the flight that has no common points with the rest."""

MIRRORED = -0.6
"""Correlation of heights by GPS and by the images below which the sign of the altitude is wrong."""


@dataclass(frozen=True, eq=False)
class Placed:
    """Bundles in one metric frame.

    Attributes:
        bundle: all parts.
        places: GPS positions [n, 3], NaN where unknown or wrong.
        sigmas: their standard deviations [n, 3], metres.
        ups: the vertical in camera axes [n, 3]: by the gimbals, which level a small block as well as GPS does; of
            images without one, where GPS does not level the block, as it stands; NaN for the others.
        easts: east in camera axes [n, 3], by the gimbals against one another; NaN where one is far off the
            others, and of few.
        apart: frames that no common points but GPS alone connects to the largest part.
    """

    bundle: Bundle
    places: Array
    sigmas: Array
    ups: Array
    easts: Array
    apart: NDArray[np.intp]


def placed(parts: Sequence[Bundle], frames: Sequence[Frame], told: Array, warnings: list[str]) -> Placed:
    """Bring each part to its GPS positions by its own similarity; parts that have too few are left out.

    Args:
        parts: the largest first.
        frames: of the flight.
        told: their GPS positions [n, 3] in local ENU metres, NaN where unknown.
        warnings: for the user.

    Raises:
        InputError: GPS does not scale the largest part.
    """
    done: list[tuple[Bundle, Array, Array, Array, Array]] = []
    for number, part in enumerate(_not_by_chance(parts, frames, warnings)):
        own = [frames[i] for i in part.frames]
        gimbals, places = [frame.gimbal for frame in own], told[part.frames]
        if number and np.isfinite(places[:, :2]).all(1).sum() < FEWEST_OF_A_PART:
            continue
        try:
            part = part.moved(by_gps(part.centres, places, gimbals, part.world_from_camera))
        except InputError:
            if number == 0:
                raise
            continue
        if (wrong := tilted(part, frames)).any():
            warnings.append(
                f"{some_of(wrong, own)} are tilted by more than {TILTED_DEG:.0f} degrees against what their gimbals "
                "say: wrong matches have placed them, or these gimbals are wrong. Look at the picture of the block, "
                "and fly with more overlap."
            )
        clean = without_faults(part, places, own, warnings)
        if np.isnan(clean).sum() > np.isnan(places).sum() and np.isfinite(clean[:, :2]).all(1).sum() >= 2:
            part = part.moved(by_gps(part.centres, clean, gimbals, part.world_from_camera))
        places = clean
        if on_a_line(places):  # GPS along a line holds the ends only: the block may have rolled about it
            part = part.moved(level_line(part.centres, gimbals, part.world_from_camera))
        ups = _ups(part, gimbals, level=on_a_line(places) or bool(np.isnan(places[:, 2]).all()))
        sigmas = gps_sigmas(own)
        if np.isnan(places[:, 2]).all():  # the heights stay as they are, so that the equations are regular
            places[:, 2] = np.where(np.isfinite(places[:, 0]), part.centres[:, 2], np.nan)
            sigmas[:, 2] = UNKNOWN_M
        done.append((part, places, sigmas, ups, easts_of(part, gimbals)))
    numbers = np.concatenate([part.frames for part, *_ in done])
    order = np.argsort(numbers, kind="stable")
    bundle = merged([part for part, *_ in done])
    places, sigmas, ups, easts = (np.concatenate([parts[i] for parts in done])[order] for i in (1, 2, 3, 4))
    return Placed(bundle, places, sigmas, ups, easts, apart=np.sort(numbers[len(done[0][0]) :]))


def agrees_with_gps(bundle: Bundle, told: Array, frames: Sequence[Frame], *, mostly: bool = False) -> bool:
    """Whether a bundle, brought to the flight's GPS positions [n, 3] by a similarity, comes near to most of them.

    No image may be far away from its own, or tilted otherwise than its gimbal says: either what is told of it is wrong,
    or it has been placed by wrong matches. With ``mostly`` single images may, but not half of them.
    """
    if (wrong := tilted(bundle, frames)).mean() >= 0.5 or (wrong.any() and not mostly):
        return False
    places = told[bundle.frames]
    try:
        moved = bundle.moved(by_gps(bundle.centres, places, [None] * len(bundle), bundle.world_from_camera))
    except InputError:
        return True
    away = np.linalg.norm((moved.centres - places)[:, :2], axis=1)
    extent = float((np.nanmax(places[:, :2], axis=0) - np.nanmin(places[:, :2], axis=0)).max())
    usual = max(FAR_OFF_M, DISTORTED * extent)
    return float(np.nanmedian(away)) < usual and (mostly or float(np.nanmax(away)) < LOST * usual)


def tilted(bundle: Bundle, frames: Sequence[Frame]) -> NDArray[np.bool_]:
    """Which images of a bundle, in any frame of reference, are tilted otherwise than their gimbals say [k]."""
    angles = _tilts(bundle, [frames[i].gimbal for i in bundle.frames.tolist()])
    known = np.isfinite(angles)
    if known.sum() < FEWEST_GIMBALS or np.median(angles[known]) >= LEVEL_DEG:
        return np.zeros(len(bundle), bool)
    return angles > TILTED_DEG


def _tilts(bundle: Bundle, gimbals: Sequence[tuple[float, float, float] | None]) -> Array:
    """Degrees [n] of each gimbal's vertical from where most of them have it; NaN without a gimbal."""
    ups = np.einsum("nij,nj->ni", bundle.world_from_camera, _ups(bundle, gimbals, level=False))
    known = np.isfinite(ups[:, 0])  # all alike, were there no errors
    middle = np.median(ups[known], axis=0) if known.any() else np.zeros(3)
    return np.rad2deg(np.arccos(np.clip(ups @ middle / max(float(np.linalg.norm(middle)), 1e-9), -1, 1)))


def _not_by_chance(parts: Sequence[Bundle], frames: Sequence[Frame], warnings: list[str]) -> list[Bundle]:
    """The parts without images that are :func:`by_chance` where they are, and what these held together apart."""
    kept: list[Bundle] = []
    for part in parts:
        own = [frames[i] for i in part.frames]
        wrong = by_chance(part, [frame.gimbal for frame in own])
        if not wrong.any() or (~wrong).sum() < 2:
            kept.append(part)
            continue
        warnings.append(
            f"{some_of(wrong, own)} were left out: they share few points with others, and these contradict their "
            "gimbals. Fly with more overlap there."
        )
        kept += components(part.without(wrong))
    return sorted(kept, key=len, reverse=True)


def by_chance(bundle: Bundle, gimbals: Sequence[tuple[float, float, float] | None]) -> NDArray[np.bool_]:
    """Which images [n] of few rays are tilted otherwise than their gimbals say, by far more than the others are.

    Some dozen wrong matches agree by chance on a pose that is off by degrees, and outweigh any prior. Headings are not
    asked here either: on half of Brighton they are off by line.
    """
    angles = _tilts(bundle, gimbals)
    known = np.isfinite(angles)
    if known.sum() < FEWEST_TO_SCATTER:
        return np.zeros(len(bundle), bool)
    few = np.bincount(bundle.image, minlength=len(bundle)) < FEW_RAYS
    return few & (angles > max(LEAST_OFF_DEG, SCATTERED * float(np.median(angles[known]))))


def far_off(distance: Array) -> NDArray[np.bool_]:
    """Which of positions that are so many metres off [n] are wrong: further than most, and than an antenna makes it."""
    return np.asarray(distance > max(FAR_OFF_M, 6 * float(np.nanmedian(distance))))


def without_faults(bundle: Bundle, places: Array, frames: Sequence[Frame], warnings: list[str]) -> Array:
    """GPS positions [n, 3] with what is wrong taken out: single positions, single heights, heights of wrong sign."""
    places = places.copy()
    away = bundle.centres - places
    flat = np.linalg.norm(away[:, :2], axis=1)
    off = far_off(flat)
    wrong = off & placed_by_others(bundle, np.isfinite(flat) & ~off)
    if wrong.any():
        warnings.append(f"The GPS position of {some_of(wrong, frames)} is far off and was not used.")
    places[wrong] = np.nan
    rise = np.where(off, np.nan, away[:, 2])  # an image that has run off tells nothing of heights, nor they of it
    if np.isfinite(rise).sum() >= 4:
        known = np.isfinite(rise)
        told, seen = places[known, 2], bundle.centres[known, 2]
        # A tilt of the frame must not hide it: heights are compared without their planes.
        plan = np.column_stack([bundle.centres[known, :2], np.ones(known.sum())])
        told, seen = (z - plan @ np.linalg.lstsq(plan, z, rcond=None)[0] for z in (told, seen))
        if known.sum() >= 8 and min(told.std(), seen.std()) > 1.0 and np.corrcoef(told, seen)[0, 1] < MIRRORED:
            warnings.append(
                "The altitudes fall where the images show that the cameras rise: their sign is wrong, and they were "
                "not used."
            )
            places[:, 2] = np.nan
            return places
    size = np.abs(rise)
    high = (
        size > max(FAR_OFF_M, 6 * float(np.nanmedian(size))) if np.isfinite(size).any() else np.zeros(len(size), bool)
    )
    if high.any():
        typical = float(np.median(rise[high]))
        warnings.append(
            f"The altitude of {some_of(high, frames)} disagrees with the others by about {abs(typical):.0f} m and was "
            "not used: look for frames that tell it above another level."
        )
    places[high, 2] = np.nan
    return places


def some_of(chosen: NDArray[np.bool_], frames: Sequence[Frame]) -> str:
    """How many frames [n] are chosen, and the first of their names."""
    names = [frames[k].name for k in np.flatnonzero(chosen).tolist()]
    return f"{len(names)} images ({', '.join(names[:5])}{' …' if len(names) > 5 else ''})"


def _ups(bundle: Bundle, gimbals: Sequence[tuple[float, float, float] | None], *, level: bool) -> Array:
    """The vertical in camera axes [n, 3]: by the gimbal; without one as the levelled bundle has it, else NaN."""
    ups = bundle.rotations[:, :, 2].copy() if level else np.full((len(bundle), 3), np.nan)
    for k, gimbal in enumerate(gimbals):
        if gimbal is not None:
            ups[k] = rotation_from_gimbal(*gimbal)[2]
    return ups


def easts_of(bundle: Bundle, gimbals: Sequence[tuple[float, float, float] | None]) -> Array:
    """East in camera axes [n, 3] by the gimbals, the error that most of them have in common taken out.

    That is the compass's; GPS turns the block. NaN of those that are far off it (some are told the other way round for
    a whole line), and of all where few have one in common.
    """
    easts = np.full((len(bundle), 3), np.nan)
    turns = {k: rotation_from_gimbal(*gimbal) for k, gimbal in enumerate(gimbals) if gimbal is not None}
    off = {k: (bundle.world_from_camera[k] @ turn.T)[:2, 0] for k, turn in turns.items()}  # where its east lies
    by = {k: float(np.arctan2(north, east)) for k, (east, north) in off.items()}
    angles = np.array(list(by.values()))
    apart = (angles[:, None] - angles + np.pi) % (2 * np.pi) - np.pi
    close = np.abs(apart) < np.deg2rad(TURNED_DEG) / 2
    if close.sum(1).max(initial=0) >= FEWEST_GIMBALS:
        middle = int(close.sum(1).argmax())
        common = float(angles[middle] + np.median(apart[close[:, middle], middle]))
        off_common = np.abs((angles - common + np.pi) % (2 * np.pi) - np.pi)
        near = [k for k, angle in zip(by, off_common, strict=True) if angle < np.deg2rad(TURNED_DEG)]
        turned = np.array([np.cos(common), -np.sin(common), 0.0])
        for k in near:
            easts[k] = turned @ turns[k]
    return easts


def gps_sigmas(frames: Sequence[Frame]) -> Array:
    """Standard deviations [n, 3] of the frames' GPS positions, metres."""
    barometer = all(frame.relative_altitude is not None for frame in frames)
    rows = []
    for frame in frames:
        stated = (frame.gps.horizontal_m, frame.gps.vertical_m) if frame.gps else (None, None)
        flat = stated[0] or GPS_SIGMA_M[0]
        rows.append([flat, flat, stated[1] or (BAROMETER_SIGMA_M if barometer else GPS_SIGMA_M[1])])
    return np.array(rows)


def widened(sigmas: Array, away: Array) -> Array:
    """Standard deviations [n, 3], not smaller than what the residuals [n, 3] show robustly, per axis pair."""
    sigmas = sigmas.copy()
    for axes in ((0, 1), (2,)):
        size = np.abs(away[:, axes] / sigmas[:, axes])
        if np.isfinite(size).sum() >= 8:
            sigmas[:, axes] *= max(1.0, 1.4826 * float(np.nanmedian(size)))
    return sigmas
