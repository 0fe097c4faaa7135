"""The straight flight paths: grid, double grid and random walk."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from overfly.errors import InputError
from overfly.flights.footprint import footprints, pair_overlap
from overfly.flights.site import MAX_FRAMES, SAMPLE_PAIRS, Layout, Site, spacing_for
from overfly.geometry import Array


def count_along(extent: float, size: float, step: float) -> int:
    """Frames of length ``size`` every ``step`` metres that cover ``extent``; a tenth of a step may stay uncovered."""
    return 1 + max(0, math.ceil((extent - size) / step - 0.1))


def too_many(count: int) -> InputError:
    return InputError(
        f"This flight would have {count} frames, {MAX_FRAMES} are allowed: lower the overlap, fly higher, "
        "or give a smaller area or a number of frames."
    )


class _Strips:
    """Parallel strips flown to and fro, whose footprints lie in rows and columns centred on the area."""

    def __init__(self, site: Site, heading_deg: float, n_along: int, n_across: int, frames: int | None) -> None:
        self.site, self.n_along, self.n_across = site, n_along, n_across
        self.heading_deg = heading_deg
        self.ahead = site.frame_size(site.tilt_deg)[2]
        keep = n_along * n_across if frames is None else min(frames, n_along * n_across)
        self.strip, k = np.divmod(np.arange(keep), n_along)
        self.back = self.strip % 2 == 1
        self.slot = np.where(self.back, n_along - 1 - k, k)
        following = np.arange(keep - 1)
        same = self.strip[following] == self.strip[following + 1]
        self.forward = np.stack([following[same], following[same] + 1], axis=-1)
        place = {(int(s), int(t)): i for i, (s, t) in enumerate(zip(self.strip, self.slot, strict=True))}
        pairs = [(i, place[s + 1, t]) for (s, t), i in place.items() if (s + 1, t) in place]
        self.side = np.array(pairs, np.int64).reshape(-1, 2)

    def poses(self, step: float, spacing: float) -> Array:
        heading = math.radians(self.heading_deg)
        along = np.array([math.sin(heading), math.cos(heading)])
        across = np.array([math.cos(heading), -math.sin(heading)])
        a = (self.slot - (self.n_along - 1) / 2) * step
        c = (self.strip - (self.n_across - 1) / 2) * spacing
        # A tilted camera stands behind its footprint: strips are shifted so that the footprints make the grid.
        a = a - self.ahead * np.where(self.back, -1, 1)
        xy = self.site.centre + a[:, None] * along + c[:, None] * across
        yaw = np.where(self.back, self.heading_deg + 180, self.heading_deg) % 360
        return self.site.poses(xy, yaw, self.site.tilt_deg)


def grid(site: Site, overlap: float, side_overlap: float, heading_deg: float, frames: int | None) -> Layout:
    """Strips of one heading, flown to and fro; the camera looks straight down, or ahead by the site's tilt.

    Args:
        overlap, side_overlap: 0..0.95.
        heading_deg: of the first strip, clockwise from north.
        frames: at most so many, in the middle of the area.
    """
    length, width, _ = site.frame_size(site.tilt_deg)
    x0, y0, x1, y1 = site.area
    sin, cos = abs(math.sin(math.radians(heading_deg))), abs(math.cos(math.radians(heading_deg)))
    extent_along, extent_across = (x1 - x0) * sin + (y1 - y0) * cos, (x1 - x0) * cos + (y1 - y0) * sin
    step, spacing = length * (1 - overlap), width * (1 - side_overlap)
    previous = (0, 0)
    for _ in range(3):
        # Terrain and keystone change the spacings by a little, and with them sometimes the number of frames.
        n_along, n_across = max(2, count_along(extent_along, length, step)), count_along(extent_across, width, spacing)
        if frames is not None:
            n_along = max(2, min(n_along, frames))
            n_across = min(n_across, math.ceil(frames / n_along))
        if n_along * n_across > MAX_FRAMES:
            raise too_many(n_along * n_across)
        if (n_along, n_across) == previous:
            break
        previous = (n_along, n_across)
        strips = _Strips(site, heading_deg, n_along, n_across, frames)
        step, spacing = _calibrate(strips, step, spacing, overlap, side_overlap)
    poses = strips.poses(step, spacing)
    outlines = site.outlines(poses) if len(strips.side) else None
    return Layout(
        poses=poses,
        strip=strips.strip,
        forward=strips.forward,
        side=None if outlines is None else (outlines[strips.side[:, 0]], outlines[strips.side[:, 1]]),
        step_m=step,
        line_spacing_m=spacing if len(strips.side) else None,
    )


def _calibrate(
    strips: _Strips, step: float, spacing: float, overlap: float, side_overlap: float
) -> tuple[float, float]:
    """Step and line spacing at which the overlaps on the terrain are the asked ones."""
    site = strips.site
    for _ in range(3):
        before = (step, spacing)

        def forward(x: float, spacing: float = spacing) -> float:
            return site.overlap(strips.poses(x, spacing), strips.forward, SAMPLE_PAIRS)

        step = spacing_for(forward, step, overlap)
        if not len(strips.side):
            break

        def side(x: float, step: float = step) -> float:
            return site.overlap(strips.poses(step, x), strips.side, SAMPLE_PAIRS)

        spacing = spacing_for(side, spacing, side_overlap, what="side overlap")
        if (step, spacing) == before:
            break
    return step, spacing


def double_grid(site: Site, overlap: float, side_overlap: float, heading_deg: float, frames: int | None) -> Layout:
    """Two grids at right angles over the same area; the second gets the smaller half of ``frames``."""
    halves = (None, None) if frames is None else (max(2, frames - frames // 2), max(2, frames // 2))
    first = grid(site, overlap, side_overlap, heading_deg, halves[0])
    second = grid(site, overlap, side_overlap, heading_deg + 90, halves[1])
    sides = [layout.side for layout in (first, second) if layout.side is not None]
    steps, lines = (first.step_m, second.step_m), (first.line_spacing_m, second.line_spacing_m)
    known = [x for x in lines if x is not None]
    return Layout(
        poses=np.concatenate([first.poses, second.poses]),
        strip=np.concatenate([first.strip, second.strip + first.strip[-1] + 1]),
        forward=np.concatenate([first.forward, second.forward + len(first.poses)]),
        side=(np.concatenate([s[0] for s in sides]), np.concatenate([s[1] for s in sides])) if sides else None,
        step_m=sum(s or 0.0 for s in steps) / 2,
        line_spacing_m=sum(known) / len(known) if known else None,
    )


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


def _standing(site: Site, middles: Array, yaw: float, tilt: float) -> Array:
    """Poses [n, 4, 4] whose footprints have their middles at ``middles`` [n, 2] on level ground."""
    ahead = site.frame_size(tilt)[2]
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
        poses = _standing(site, middle + distances[:, None] * toward, yaw, tilt)
        if level:
            outlines = footprints(site.camera, poses, lambda xy: np.full(len(xy), plane), (plane, plane))
            return pair_overlap(np.broadcast_to(on_plane, outlines.shape), outlines)
        outlines = site.outlines(poses)
        return pair_overlap(np.broadcast_to(on_terrain, outlines.shape), outlines)

    share = 1.0
    for _ in range(10):
        yaw, tilt = (old[0] + share * change[0]) % 360, old[1] + share * (change[1] - old[1])
        if overlaps(np.zeros(1), yaw, tilt, True)[0] > min(overlap + 0.03, 0.5 + overlap / 2):
            break
        share /= 2
    else:
        return None
    aim = overlap if overlap > 0 else 1e-4
    low, high = 0.0, 1.6 * math.hypot(length, width)
    # Close in on level ground first, which is cheap, then widen again for the terrain.
    distance = _falls_to(lambda d: overlaps(d, yaw, tilt, True), low, high, aim)
    if distance is None:
        return None
    near = _falls_to(lambda d: overlaps(d, yaw, tilt, False), 0.7 * distance, 1.4 * distance, aim)
    distance = near if near is not None else _falls_to(lambda d: overlaps(d, yaw, tilt, False), low, 1.5 * high, aim)
    if distance is None:
        return None
    pose = _standing(site, middle + distance * toward, yaw, tilt)[0]
    return pose, middle + distance * toward, (yaw, tilt)


def _falls_to(overlaps: Callable[[Array], Array], low: float, high: float, aim: float) -> float | None:
    """The distance between ``low`` and ``high`` at which the overlap first falls to ``aim``; None if it is not there."""
    for n in (9, 6, 6):
        distances = np.linspace(low, high, n)
        values = overlaps(distances)
        beyond = np.flatnonzero(values <= aim)
        if not len(beyond) or beyond[0] == 0:
            return None
        k = int(beyond[0])
        low, high = float(distances[k - 1]), float(distances[k])
    return low + (high - low) * float((values[k - 1] - aim) / max(values[k - 1] - values[k], 1e-12))
