"""The straight flight paths: grid and double grid."""

from __future__ import annotations

import math

import numpy as np

from overfly.errors import InputError
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
