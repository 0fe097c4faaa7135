"""Footprints as rendered: the image's border rays, lens included, met with the bare terrain; and their overlaps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from overfly.geometry import Array, Camera, rays

Ground = Callable[[Array], NDArray]
"""The bare terrain: x, y [N, 2] in metres -> z [N]."""

REACH = 8.0
"""Rays to and over the horizon end at this multiple of the camera's height over the lowest ground."""

MARCH_M = 4.0
MARCH_STEPS = (2, 24)
REFINEMENTS = 10


def border_pixels(camera: Camera, per_side: int = 8) -> Array:
    """Points along the image's outer border, clockwise from the top left corner: [4 * per_side, 2]."""
    t = np.arange(per_side) / per_side
    w, h, zero = float(camera.width), float(camera.height), np.zeros(per_side)
    sides = [(t * w, zero), (zero + w, t * h), ((1 - t) * w, zero + h), (zero, (1 - t) * h)]
    return np.concatenate([np.stack(side, axis=-1) for side in sides])


def meet_ground(
    origins: Array, directions: Array, ground: Ground, height_range: tuple[float, float], reach: float = REACH
) -> Array:
    """Where rays first meet the terrain.

    Args:
        origins, directions: [N, 3], world.
        ground: the terrain.
        height_range: its lowest and highest z; below the lowest a ray ends on that plane.
        reach: where rays end that meet no ground, in heights over the lowest ground, sideways.

    Returns:
        Points [N, 3]; hills thinner than :data:`MARCH_M` (long rays: 1/24 of the way through the terrain's heights)
        can be jumped over.
    """
    low, high = height_range
    height = np.maximum(origins[:, 2] - low, 1e-6)
    flat = np.linalg.norm(directions[:, :2], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        limit = np.where(flat > 0, reach * height / flat, np.inf)
        down = directions[:, 2] < 0
        end = np.minimum(np.where(down, -height / directions[:, 2], np.inf), limit)
        start = np.where(down, np.maximum(origins[:, 2] - high, 0) / np.maximum(-directions[:, 2], 1e-12), 0.0)
        start = np.minimum(start, end)

    def over(t: Array) -> Array:
        """Height of the ray's point over the ground [N]."""
        points = origins + directions * t[:, None]
        return points[:, 2] - np.asarray(ground(points[:, :2]), float)

    if high - low < 1e-9:
        return origins + directions * end[:, None]
    # March to the first crossing (a hill can hide the ground behind it), then close in on it.
    sideways = float(((end - start) * flat).max())
    steps = int(np.clip(np.ceil(sideways / MARCH_M), *MARCH_STEPS))
    before, after = start.copy(), end.copy()
    f_before, f_after = over(before), np.full(len(origins), -1.0)
    found = f_before <= 0
    after[found], f_after[found] = before[found], f_before[found]
    for k in range(1, steps + 1):
        t = start + (end - start) * (k / steps)
        f = over(t)
        crossing, still = ~found & (f <= 0), ~found & (f > 0)
        after[crossing], f_after[crossing] = t[crossing], f[crossing]
        before[still], f_before[still] = t[still], f[still]
        found |= crossing
    after[~found] = before[~found]
    for k in range(REFINEMENTS):  # regula falsi, every third step a bisection against its one-sided crawl
        with np.errstate(divide="ignore", invalid="ignore"):
            share = f_before / (f_before - f_after)
        share = np.where(np.isfinite(share) & (k % 3 < 2), np.clip(share, 0, 1), 0.5)
        t = before + (after - before) * share
        f = over(t)
        under = f <= 0
        after, f_after = np.where(under, t, after), np.where(under, f, f_after)
        before, f_before = np.where(under, before, t), np.where(under, f_before, f)
    return origins + directions * np.where(np.abs(f_before) < np.abs(f_after), before, after)[:, None]


def footprints(
    camera: Camera,
    world_from_camera: ArrayLike,
    ground: Ground,
    height_range: tuple[float, float],
    per_side: int | None = None,
) -> Array:
    """Outlines of images on the terrain, seen from above.

    Args:
        camera: of all the frames.
        world_from_camera: [n, 4, 4].
        ground, height_range: see :func:`meet_ground`.
        per_side: points per image side; by default 1 on flat ground without distortion (exact), else 8.

    Returns:
        x, y [n, 4 * per_side, 2], metres.
    """
    poses = np.asarray(world_from_camera, float).reshape(-1, 4, 4)
    if per_side is None:
        per_side = 1 if height_range[1] - height_range[0] < 1e-9 and not camera.is_distorted else 8
    local = rays(border_pixels(camera, per_side), camera)  # [m, 3]
    directions = np.einsum("nij,mj->nmi", poses[:, :3, :3], local)
    origins = np.broadcast_to(poses[:, None, :3, 3], directions.shape)
    points = meet_ground(origins.reshape(-1, 3), directions.reshape(-1, 3), ground, height_range)
    return points[:, :2].reshape(len(poses), -1, 2)


def polygons(outlines: ArrayLike) -> NDArray[np.object_]:
    """Valid shapely polygons of outlines [n, m, 2]."""
    shapes = shapely.polygons(np.asarray(outlines, float))
    valid = shapely.is_valid(shapes)
    if not valid.all():
        shapes = np.where(valid, shapes, shapely.make_valid(shapes))
    return np.asarray(shapes)


def pair_overlap(a: ArrayLike, b: ArrayLike) -> Array:
    """Share of each outline in ``a`` [n, m, 2] that lies inside its partner in ``b`` [n, m, 2]: [n] in 0..1."""
    first, second = polygons(a), polygons(b)
    return np.asarray(shapely.area(shapely.intersection(first, second)) / shapely.area(first))


def terrain_range(ground: Ground, area: tuple[float, float, float, float], margin: float) -> tuple[float, float, float]:
    """Mean ground height of ``area``, and the lowest and highest within ``margin`` metres around it.

    Sampled on grids of 65 x 65 and 129 x 129 points; the range is widened by 2 % for what lies between.
    """

    def sample(x0: float, y0: float, x1: float, y1: float, n: int) -> Array:
        x, y = np.meshgrid(np.linspace(x0, x1, n), np.linspace(y0, y1, n))
        return np.asarray(ground(np.stack([x.ravel(), y.ravel()], axis=-1)), float)

    mean = float(sample(*area, 65).mean())
    around = sample(area[0] - margin, area[1] - margin, area[2] + margin, area[3] + margin, 129)
    low, high = float(around.min()), float(around.max())
    slack = 0.02 * (high - low)
    return mean, low - slack, high + slack
