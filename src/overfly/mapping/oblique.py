"""A cloud in perspective: points drawn as small squares with a z-buffer, no window system and no GPU needed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from overfly.cloud import Cloud
from overfly.geometry import rotation_from_gimbal

PAPER = 255


def oblique_view(
    cloud: Cloud, *, width: int = 1200, height: int = 700, azimuth_deg: float = 25.0, elevation_deg: float = 38.0
) -> NDArray[np.uint8]:
    """The cloud in perspective on white, each point a small square, the nearest one in front (z-buffer).

    Args:
        cloud: coloured points; without colours they are coloured by height.
        azimuth_deg: the direction in which one looks, clockwise from north.
        elevation_deg: how far above the horizon one stands.
    """
    low, high = np.quantile(cloud.points, [0.01, 0.99], axis=0)
    kept = ((cloud.points >= low - 0.1 * (high - low)) & (cloud.points <= high + 0.3 * (high - low) + 1e-9)).all(1)
    points, colors = cloud.points[kept], colors_of(cloud)[kept]
    centre = (low + high) / 2
    rotation = rotation_from_gimbal(azimuth_deg, -elevation_deg)
    local = (points - centre) @ rotation  # camera axes, seen from the centre
    focal = 1.6 * width
    left, right = np.quantile(local, [0.005, 0.995], axis=0)
    local[:, :2] -= (left[:2] + right[:2]) / 2
    spread = (right - left) / 2 + 1e-9
    # Stand so far back that nearly all points fit.
    distance = float(max(focal * spread[0] / (0.45 * width), focal * spread[1] / (0.42 * height)) + 0.5 * spread[2])
    depth = local[:, 2] + distance
    visible = depth > 0.05 * distance
    local, depth, colors = local[visible], depth[visible], colors[visible]
    plane = local[:, :2] / depth[:, None] * focal
    low, high = np.quantile(plane, [0.002, 0.998], axis=0)
    zoom = min(0.91 * width / max(high[0] - low[0], 1e-9), 0.9 * height / max(high[1] - low[1], 1e-9))
    u, v = ((plane - (low + high) / 2) * zoom + [width / 2, height / 2]).T
    focal *= zoom
    spacing = np.sqrt(4 * spread[0] * spread[1] / max(len(points), 1)) / distance * focal
    radius = int(np.clip(np.ceil(spacing * 0.9), 0, 6))
    return splat(u, v, depth, colors, width, height, radius)


def splat(
    u: NDArray, v: NDArray, depth: NDArray, colors: NDArray, width: int, height: int, radius: int
) -> NDArray[np.uint8]:
    """Draw points as squares of (2 radius + 1)^2 pixels, nearest first, on white; edges of depth are shaded."""
    order = np.argsort(-depth, kind="stable")  # far to near: the last write wins
    depth, colors = depth[order], colors[order]
    column, row = np.floor(u[order]).astype(np.int64), np.floor(v[order]).astype(np.int64)
    nearest = np.full(width * height, np.inf)
    image = np.full((width * height, 3), PAPER, np.uint8)
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            c, r = column + dx, row + dy
            inside = np.flatnonzero((c >= 0) & (c < width) & (r >= 0) & (r < height))
            cell = r[inside] * width + c[inside]
            d = depth[inside]
            np.minimum.at(nearest, cell, d)
            front = d <= nearest[cell]
            image[cell[front]] = colors[inside[front]]
    return _edge_shaded(image.reshape(height, width, 3), nearest.reshape(height, width))


def _edge_shaded(image: NDArray[np.uint8], depth: NDArray) -> NDArray[np.uint8]:
    """Darken pixels that lie behind their neighbours (eye-dome lighting), so that form shows without light."""
    known = np.isfinite(depth)
    logs = np.where(known, np.log2(np.where(known, depth, 1.0)), np.nan)
    darker = np.zeros_like(depth)
    for axis in (0, 1):
        for step in (-2, 2):
            darker += np.nan_to_num(np.maximum(0, logs - np.roll(logs, step, axis)))
    shade = np.exp(-60 * darker / 4)
    shaded = image * np.clip(shade, 0.35, 1)[..., None]
    return np.where(known[..., None], shaded, PAPER).astype(np.uint8)


def colors_of(cloud: Cloud) -> NDArray[np.uint8]:
    """The cloud's colours, or colours by height where it has none [N, 3]."""
    if cloud.colors is not None:
        return cloud.colors
    from matplotlib import colormaps

    z = cloud.points[:, 2]
    low, high = np.percentile(z, [1, 99])
    scaled = np.clip((z - low) / max(high - low, 1e-9), 0, 1)
    return np.asarray(colormaps["turbo"](scaled)[:, :3] * 255, np.uint8)
