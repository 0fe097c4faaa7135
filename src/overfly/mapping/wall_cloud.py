"""Points on walls beside what the network alone says of the same pixels, and as a part of the cloud."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from overfly.cloud import Cloud
from overfly.geometry import project
from overfly.mapping.depth_map import DepthMap
from overfly.mapping.subpixel import Map
from overfly.mapping.walls import CONFIDENCE, SIGMA, WallPoints


def instead_of_words(walls: WallPoints, own: DepthMap, farthest: Map) -> tuple[WallPoints, NDArray[np.bool_]]:
    """The points on walls before which no lone word stands, and the words [H, W] that they replace.

    Args:
        walls: in the frame ``own``.
        farthest: how far away [H, W] each lone word may be, metres; NaN where there is none.
    """
    import cv2

    away = project(walls.points, own.camera, own.world_from_camera)[1].astype(np.float32)
    stand = ~(farthest[walls.rows, walls.columns] < away)
    kept = WallPoints(walls.points[stand], walls.rows[stand], walls.columns[stand], walls.voxels)
    wall = np.full(farthest.shape, -np.inf, np.float32)
    np.maximum.at(wall, (kept.rows, kept.columns), away[stand])
    wall = np.asarray(cv2.dilate(wall, np.ones((3, 3), np.uint8)))  # near the camera a ground pixel is many
    return kept, np.isfinite(wall) & (farthest >= wall)


def wall_cloud(walls: WallPoints, own: DepthMap, image: NDArray) -> Cloud:
    """What a frame shows of walls that nobody has matched."""
    n = len(walls.points)
    gsd = np.linalg.norm(walls.points - own.world_from_camera[:3, 3], axis=1) / own.camera.fx
    return Cloud(
        walls.points,
        image[walls.rows, walls.columns],
        confidence=np.full(n, CONFIDENCE, np.float32),
        sigma_m=(SIGMA * gsd).astype(np.float32),
        views=np.ones(n, np.uint8),
        predicted=np.ones(n, bool),
    )
