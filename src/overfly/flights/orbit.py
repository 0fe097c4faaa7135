"""The circular flight path: orbits whose cameras face the middle."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from overfly.flights.footprint import pair_overlap
from overfly.flights.paths import too_many
from overfly.flights.site import MAX_FRAMES, SAMPLE_PAIRS, Layout, Site, spacing_for
from overfly.geometry import Array

MAX_STEP_DEG = 60.0
"""Frames further apart than this angle are not an orbit any more: the radius grows instead."""

CALIBRATION_PAIRS = 36


def circular(site: Site, overlap: float, side_overlap: float, heading_deg: float, frames: int | None) -> Layout:
    """Orbits round the area's middle, clockwise; the first camera looks along ``heading_deg``.

    The first orbit's radius is altitude x tan(tilt): its cameras point at the middle of the ground. Its angle step is
    the one with the asked overlap; where even :data:`MAX_STEP_DEG` overlaps more, the orbit widens at the same tilt.
    Further orbits follow outwards, ``side_overlap`` apart, until the area is covered.
    """
    length, _, ahead = site.frame_size(site.tilt_deg)
    near, far = ahead - length / 2, ahead + length / 2

    def ring(radius: float, azimuth_deg: ArrayLike) -> Array:
        azimuth = np.radians(np.asarray(azimuth_deg, float))
        xy = site.centre + radius * np.stack([np.sin(azimuth), np.cos(azimuth)], axis=-1)
        return site.poses(xy, (np.asarray(azimuth_deg) + 180) % 360, site.tilt_deg)

    def measured(radius: float, start: NDArray, step_deg: float) -> float:
        pairs = np.arange(2 * len(start)).reshape(2, -1).T
        return site.overlap(np.concatenate([ring(radius, start), ring(radius, start + step_deg)]), pairs, SAMPLE_PAIRS)

    around = np.arange(CALIBRATION_PAIRS) * 360 / CALIBRATION_PAIRS
    first = heading_deg + 180.0
    radius = max(site.altitude * math.tan(math.radians(site.tilt_deg)), 0.02 * site.altitude)
    widest = measured(radius, around, MAX_STEP_DEG)
    wide = widest > max(overlap, 0.001)
    if wide:
        turns = first + MAX_STEP_DEG * np.arange(5 if frames is None else min(5, frames - 1))
        radius = spacing_for(lambda r: measured(r, turns, MAX_STEP_DEG), 1.5 * radius, overlap)

    # How far the first orbit sees from the middle: across it, or outside of it.
    reach = max(far - radius, radius - near)
    x0, y0, x1, y1 = site.area
    needed = max(x1 - x0, y1 - y0) / 2

    def fly_orbits(spacing: float | None) -> tuple[list[float], list[Array], list[float]]:
        """Radii, azimuths and angle steps of all orbits."""
        radii = [radius]
        while spacing is not None and radii[-1] - near < 0.98 * needed:
            radii.append(radii[-1] + spacing)
            if 6 * len(radii) > MAX_FRAMES:
                raise too_many(6 * len(radii))
        azimuths: list[Array] = []
        steps: list[float] = []
        total = 0
        for r in radii:
            left = None if frames is None else frames - total
            if left is not None and left < 2:
                break
            step = MAX_STEP_DEG
            fixed = wide and r == radius
            if not fixed:
                step = spacing_for(lambda x: measured(r, around, x), 20.0, overlap, upper=MAX_STEP_DEG)  # noqa: B023
            count = max(2, math.floor((360 - step / 2) / step) + 1)
            count = count if left is None else min(count, left)
            if total + count > MAX_FRAMES:
                raise too_many(total + count)
            if not fixed:
                # The pairs really flown, not those all around, shall have the asked mean.
                k = np.arange(count - 1)
                step = spacing_for(lambda x: measured(r, first + k * x, x), step, overlap)  # noqa: B023
            azimuths.append(first + step * np.arange(count, dtype=float))
            steps.append(step)
            total += count
        return radii[: len(azimuths)], azimuths, steps

    def neighbours(radii: list[float], azimuths: list[Array], spacing: float) -> tuple[Array, Array]:
        """Outlines of all frames but the last orbit's, and of frames at the same azimuths one orbit further out."""
        inner = np.concatenate([ring(r, a) for r, a in zip(radii, azimuths)])
        outer = np.concatenate([ring(r + spacing, a) for r, a in zip(radii, azimuths)])
        return site.outlines(inner), site.outlines(outer)

    spacing, sides = None, None
    if reach < 0.95 * needed:
        spacing = length * (1 - side_overlap)
        flown_radii, flown_azimuths = [radius], [around]
        for _ in range(4):
            spacing = spacing_for(
                lambda x: float(pair_overlap(*neighbours(flown_radii, flown_azimuths, x)).mean()),  # noqa: B023
                spacing,
                side_overlap,
                what="side overlap",
            )
            radii, azimuths, steps = fly_orbits(spacing)
            if len(radii) == 1:
                spacing = None
                break
            flown_radii, flown_azimuths = radii[:-1], azimuths[:-1]
            sides = neighbours(flown_radii, flown_azimuths, spacing)
            if abs(float(pair_overlap(*sides).mean()) - side_overlap) < 0.002:
                break
    else:
        radii, azimuths, steps = fly_orbits(None)
    poses = np.concatenate([ring(r, a) for r, a in zip(radii, azimuths)])
    strip = np.repeat(np.arange(len(azimuths)), [len(a) for a in azimuths])
    n = np.flatnonzero(strip[1:] == strip[:-1])
    return Layout(
        poses=poses,
        strip=strip,
        forward=np.stack([n, n + 1], axis=-1),
        side=sides,
        step_deg=steps[0],
        line_spacing_m=spacing,
        radius_m=radius,
    )
