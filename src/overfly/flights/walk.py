"""The random flight path: a walk of frames of any heading, for data that no grid resembles."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from overfly.errors import InputError
from overfly.flights.footprint import footprints, pair_overlap
from overfly.flights.paths import count_along, too_many
from overfly.flights.site import MAX_FRAMES, Layout, Site, spacing_for
from overfly.geometry import Array


def random_walk(
    site: Site, overlap: float, side_overlap: float, rng: np.random.Generator, frames: int | None
) -> Layout:
    """Frames of any heading, nearly straight down, each overlapping the one before by the asked share.

    The middles of the footprints stay in the area (half a footprint inside its border where there is room). Where a
    turned frame cannot overlap so much even at the same place, it turns less.
    """
    length, width, _ = site.frame_size(0.0)
    x0, y0, x1, y1 = site.area
    if frames is None:
        along = max(2, count_along(y1 - y0, length, length * (1 - overlap)))
        frames = along * count_along(x1 - x0, width, width * (1 - side_overlap))
        if frames > MAX_FRAMES:
            raise too_many(frames)
    half, size = min(length, width) / 2, np.array([x1 - x0, y1 - y0])
    inner = np.where(size - 2 * half > 1.5 * length, size - 2 * half, size) / 2  # half sides of where middles may be
    middle, heading = site.centre + rng.uniform(-0.5, 0.5, 2) * inner, rng.uniform(0, 360)
    yaw, tilt = rng.uniform(0, 360), rng.uniform(0, site.tilt_deg)
    poses = [_standing(site, middle, yaw, tilt)[0]]
    distances = []
    for _ in range(frames - 1):
        for attempt in range(40):
            turn, lean = rng.uniform(-180, 180), rng.uniform(0, site.tilt_deg)
            direction = heading + rng.normal(0, 40)
            if attempt:  # it left the area: back, more or less towards the middle
                back = site.centre - middle
                direction = math.degrees(math.atan2(back[0], back[1])) + rng.uniform(-1, 1) * max(90 - 4 * attempt, 0)
            found = _next_frame(site, poses[-1], middle, direction, (yaw, tilt), (turn, lean), overlap)
            if found is not None and (np.abs(found[1] - site.centre) <= inner).all():
                break
        else:
            raise InputError(
                f"A random flight with overlap={100 * overlap:g} at {site.altitude:g} m does not fit into an area of "
                f"{size[0]:.0f} x {size[1]:.0f} m: give an area of at least {4 * max(length, width):.0f} m, "
                "a lower altitude or a higher overlap."
            )
        pose, new_middle, (yaw, tilt) = found
        distances.append(float(np.linalg.norm(new_middle - middle)))
        poses.append(pose)
        middle, heading = new_middle, direction
    n = np.arange(len(poses))
    return Layout(
        poses=np.stack(poses),
        strip=np.zeros(len(poses), np.int64),
        forward=np.stack([n[:-1], n[1:]], axis=-1),
        step_m=float(np.mean(distances)) if distances else None,
    )


def _standing(site: Site, middles: Array, yaw: float, tilt: float, ahead: float | None = None) -> Array:
    """Poses [n, 4, 4] whose footprints have their middles at ``middles`` [n, 2] on level ground."""
    ahead = site.frame_size(tilt)[2] if ahead is None else ahead
    toward = np.array([math.sin(math.radians(yaw)), math.cos(math.radians(yaw))])
    xy = np.atleast_2d(middles) - ahead * toward
    return site.poses(xy, yaw, tilt)


def _next_frame(
    site: Site,
    last: Array,
    middle: Array,
    direction_deg: float,
    old: tuple[float, float],
    change: tuple[float, float],
    overlap: float,
) -> tuple[Array, Array, tuple[float, float]] | None:
    """Pose, middle and (yaw, tilt) of the frame in ``direction_deg`` that overlaps ``last`` as asked; None if none."""
    length, width, _ = site.frame_size(0.0)
    toward = np.array([math.sin(math.radians(direction_deg)), math.cos(math.radians(direction_deg))])
    plane = site.ground_height
    on_terrain = site.outlines(last[None])
    on_plane = footprints(site.camera, last[None], lambda xy: np.full(len(xy), plane), (plane, plane))

    def overlaps(distances: Array, yaw: float, tilt: float, level: bool) -> Array:
        poses = _standing(site, middle + distances[:, None] * toward, yaw, tilt, ahead)
        if level:
            outlines = footprints(site.camera, poses, lambda xy: np.full(len(xy), plane), (plane, plane))
            return pair_overlap(np.broadcast_to(on_plane, outlines.shape), outlines)
        outlines = site.outlines(poses)
        return pair_overlap(np.broadcast_to(on_terrain, outlines.shape), outlines)

    share = 1.0
    for _ in range(10):
        yaw, tilt = (old[0] + share * change[0]) % 360, old[1] + share * (change[1] - old[1])
        ahead = site.frame_size(tilt)[2]
        if overlaps(np.zeros(1), yaw, tilt, True)[0] > min(overlap + 0.03, 0.5 + overlap / 2):
            break
        share /= 2
    else:
        return None
    aim = overlap if overlap > 0 else 1e-4
    # Close in on level ground first, which is cheap; the terrain changes little.
    level = _falls_to(lambda d: overlaps(d, yaw, tilt, True), 0.0, 1.6 * math.hypot(length, width), aim)
    if level is None:
        return None
    try:
        distance = spacing_for(lambda d: float(overlaps(np.array([d]), yaw, tilt, False)[0]), level, overlap)
    except InputError:
        return None  # another direction or heading may do
    pose = _standing(site, middle + distance * toward, yaw, tilt, ahead)[0]
    return pose, middle + distance * toward, (yaw, tilt)


def _falls_to(overlaps: Callable[[Array], Array], low: float, high: float, aim: float) -> float | None:
    """The distance between ``low`` and ``high`` where the overlap first falls to ``aim``; None if nowhere."""
    for n in (9, 6, 6):
        distances = np.linspace(low, high, n)
        values = overlaps(distances)
        beyond = np.flatnonzero(values <= aim)
        if not len(beyond) or beyond[0] == 0:
            return None
        k = int(beyond[0])
        low, high = float(distances[k - 1]), float(distances[k])
    return low + (high - low) * float((values[k - 1] - aim) / max(values[k - 1] - values[k], 1e-12))
