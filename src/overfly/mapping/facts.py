"""The numbers of a map, for ``map.json`` and its report."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from overfly.cloud import Cloud
from overfly.data.footprints import sees
from overfly.geometry import Array, Camera, project
from overfly.mapping.raster import Surface
from overfly.mapping.tiles import Tiles

CLOSED = 10
"""Half the cells of a gap, up to which it lies within the outline even if it is open to one side."""

ASKED = 200
"""Frames, spread over the flight, that tell the ground sampling distance."""


def ground_sampling(cloud: Cloud, cameras: Sequence[Camera], poses: Array) -> float:
    """Median over the frames of depth / focal length: metres (or units) per pixel on what they see."""
    sample = cloud.points[:: max(1, len(cloud) // max(4000, 20 * len(cameras)))]
    step = -(-len(cameras) // ASKED)
    found = []
    for camera, pose in zip(cameras[::step], poses[::step], strict=True):
        inside = sample[sees(sample, camera, pose)]
        if len(inside):
            found.append(float(np.median(project(inside, camera, pose)[1])) / camera.fx)
    return float(np.median(found)) if found else float("nan")


def cloud_facts(cloud: Tiles, sample: Cloud, seen: Surface, gsd: float) -> dict[str, Any]:
    """Points, measured, predicted, area, density, height range, median sigma; lengths in the cloud's unit.

    Args:
        cloud: all points.
        sample: many of them, in the CRS of the product.
        seen: the surface that areas are counted on, with the number of frames that have each cell inside them.
        gsd: ground sampling distance.
    """
    area = float(np.count_nonzero(seen.filled)) * seen.grid.cell**2
    low, high = np.percentile(sample.points[:, 2], [1, 99])
    return {
        "points": len(cloud),
        "measured": len(cloud) - cloud.predicted,
        "predicted": cloud.predicted,
        "area": round(area, 4),
        "points_per_area": round(len(cloud) / area, 3) if area else 0.0,
        "height_range": [round(float(low), 3), round(float(high), 3)],
        "median_sigma": None if sample.sigma_m is None else round(float(np.median(sample.sigma_m)), 4),
        "seen_once_share": _share_once(seen),
        "unmatched_share": _share_unmatched(seen),
        "gsd": gsd,
    }


def _share_once(seen: Surface) -> float:
    """Share of the mapped ground that fewer than two frames have inside them."""
    if seen.views is None or not seen.filled.any():
        return 0.0
    return round(float((seen.views[seen.filled] < 2).mean()), 4)


def _share_unmatched(seen: Surface) -> float:
    """Share of the ground within the map's outline that two frames or more have inside them and that has no point.

    Gaps are within the outline where they are narrow or enclosed; what hides behind a roof counts, too.
    """
    from scipy.ndimage import binary_closing, binary_fill_holes

    if seen.views is None:
        return 0.0
    padded = np.pad(seen.filled, CLOSED)
    within = binary_fill_holes(binary_closing(padded, iterations=CLOSED))[CLOSED:-CLOSED, CLOSED:-CLOSED]
    twice = within & (seen.views >= 2)
    if not twice.any():
        return 0.0
    return round(float((twice & ~seen.filled).sum() / twice.sum()), 4)


def heights_above_ground(seen: Surface, poses: Array) -> NDArray[np.float64]:
    """Height of each camera above the map under it, or above its median height where nothing is under it [n]."""
    cells = seen.grid.cells(poses[:, :3, 3])
    below = np.where(cells >= 0, seen.heights.ravel()[np.maximum(cells, 0)], np.nan)
    return np.asarray(poses[:, 2, 3] - np.where(np.isfinite(below), below, np.nanmedian(seen.heights)))
