"""Which frames make good stereo pairs: much common ground, a base-to-height ratio that measures, no twisted views."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from overfly.geometry import Array, Camera, rays, unproject
from overfly.mapping.depth_ranges import Span

GRID = 10
"""Samples of a frame's ground along each side of the image."""

DOWN = 0.2
"""Cosine of the angle with straight down up to which a frame is taken to look at level ground."""

CANDIDATES = 40
"""Nearest cameras that are looked at."""

WIDE, FURTHER = 0.9, 2
"""Base-to-height ratio from which on a pair is wide, as on circles with an image every 60 degrees: it is chosen for
ground that no better one has. And how many wide partners a frame may have besides: they see past what hides a place
from others (on circles over blocks 0.41 of the level ground that two images see was missing, 0.81 of it where these
were no pair), and are more precise, but search hundreds of disparities."""

REPEATS = (1.0, 0.6, 0.35, 0.2, 0.1)
"""What seeing a place once more is worth: the first partner makes it measured, the later ones make it sure."""


def choose_partners(
    cameras: Sequence[Camera],
    poses: Sequence[Array],
    spans: Sequence[Span],
    *,
    count: int,
    ratio: tuple[float, float],
) -> list[list[int]]:
    """The partners of every frame, best first.

    Args:
        cameras, poses: of n frames; lenses are taken as undistorted.
        spans: where each frame's ground lies.
        count: most partners of a frame, but for :data:`FURTHER` wide ones.
        ratio: smallest and largest base-to-height ratio.

    Returns:
        n lists of frame indices; empty where nothing overlaps. Partners are chosen one by one for the ground they add
        (a greedy set cover), so that the rim of a frame gets its partner, too, also at 30 % overlap. The far ground of
        oblique frames counts by its area, not by the few pixels that show it.
    """
    centres = np.array([pose[:3, 3] for pose in poses])
    lenses = np.array([(c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in cameras])
    turns = np.array([pose[:3, :3] for pose in poses])
    return [
        _partners(i, cameras[i], poses[i], lenses, turns, centres, spans[i], count, ratio) for i in range(len(cameras))
    ]


def _partners(
    i: int,
    camera: Camera,
    world_from_camera: Array,
    lenses: Array,
    turns: Array,
    centres: Array,
    span: Span,
    count: int,
    ratio: tuple[float, float],
) -> list[int]:
    ground, area = _ground(camera, world_from_camera, span)
    near = np.argsort(np.linalg.norm(centres - centres[i], axis=1), kind="stable")[: CANDIDATES + 1]
    near = near[near != i]
    there = ground - centres[near, None]  # [J, G, 3]
    local = there @ turns[near]
    fx, fy, cx, cy, width, height = lenses[near, :, None].swapaxes(0, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = local[..., 0] / local[..., 2] * fx + cx, local[..., 1] / local[..., 2] * fy + cy
        inside = (local[..., 2] > 0) & (u > 0) & (u < width) & (v > 0) & (v < height)
    ratios = base_to_height(ground - centres[i], there)
    values = np.where(inside, _value(ratios, ratio), 0.0)
    wide = {int(j): far for j, far in zip(near, ratios > WIDE, strict=True)}
    worth = {int(j): value for j, value in zip(near, values, strict=True) if value @ area > 0.02}
    chosen: list[int] = []
    for more, wide_only in ((count, False), (FURTHER, True)):
        most, times = len(chosen) + more, np.zeros(len(ground), int)
        if wide_only:  # all over what it shows, not in a corner
            worth = {
                j: value
                for j, value in worth.items()
                if (area * wide[j])[value > 0].sum() > 0.5 * area[value > 0].sum()
            }
        while worth and len(chosen) < most:
            repeat = np.array([REPEATS[min(t, len(REPEATS) - 1)] for t in times])
            counts = {j: wide_only | ~wide[j] | (times == 0) for j in worth}
            gains = {j: float((value * repeat * counts[j]) @ area) for j, value in worth.items()}
            best = max(gains, key=lambda j: (gains[j], -j))
            if gains[best] < 0.02:
                break
            chosen.append(best)
            times += worth.pop(best) > 0
    return chosen


def _ground(camera: Camera, world_from_camera: Array, span: Span) -> tuple[Array, Array]:
    """Places [N, 3] on level ground all over a frame, and the share [N] of its ground that each stands for: none of the
    sky, and of what is farther than the span."""
    side = (np.arange(GRID) + 0.5) / GRID
    pixels = np.stack(np.meshgrid(side * camera.width, side * camera.height), -1).reshape(-1, 2)
    depth, area = np.full(len(pixels), span.middle), np.ones(len(pixels))
    over, down = world_from_camera[2, 3] - span.ground, -world_from_camera[2, 2]
    if down > DOWN and span.near < over / down < span.far:  # else the z axis points elsewhere than up
        fall = -(rays(pixels, camera) @ world_from_camera[2, :3])
        seen = fall > over / span.far
        depth = np.where(seen, np.maximum(over / np.where(seen, fall, 1), span.near), span.far)
        area = np.where(seen, depth**3, 0)  # of a pixel on a plane
    return unproject(pixels, depth, camera, world_from_camera), area / area.sum()


def base_to_height(here: Array, there: Array) -> Array:
    """Base-to-height ratio of two lines of sight [..., 3] to one place, as of two cameras level with each other."""
    lengths = np.linalg.norm(here, axis=-1) * np.linalg.norm(there, axis=-1)
    cosine = (here * there).sum(-1) / np.maximum(lengths, 1e-12)
    return np.asarray(2 * np.tan(np.arccos(np.clip(cosine, -1, 1)) / 2))


def is_wide(camera: Camera, world_from_camera: Array, depth: float, other: Array) -> bool:
    """Whether a frame and another one, whose pose is given, make a wide pair at a depth in the middle of the first."""
    middle = unproject(np.array([[camera.cx, camera.cy]]), np.array([depth]), camera, world_from_camera)[0]
    return bool(base_to_height(middle - world_from_camera[:3, 3], middle - other[:3, 3]) > WIDE)


def _value(ratios: Array, limits: tuple[float, float]) -> Array:
    """1 between 0.15 and 0.45; less where depth is imprecise (narrow) or views differ much (wide)."""
    low, high = limits
    rise = (ratios - low) / max(0.15 - low, 1e-9)
    fall = np.interp(ratios, [0.45, WIDE, max(high, WIDE)], [1, 0.3, 0.1])
    return np.where((ratios > low) & (ratios < high), np.clip(np.minimum(rise, fall), 0, 1), 0.0)
