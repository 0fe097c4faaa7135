"""A coloured surface from a lidar cloud."""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from overfly.cloud import Cloud
from overfly.errors import InputError
from overfly.scenes.envelope import nearest_fill
from overfly.scenes.rasters import MAX_CELLS, Array, grid_scene, is_geographic
from overfly.scenes.scene import Scene


def from_cloud(cloud: Cloud, name: str) -> Scene:
    """A coloured surface from a lidar cloud.

    Cells are about the spacing of the points (0.1 m at least). A cell takes its highest point, unless that stands alone
    more than 12 m above the cells around it (a bird). Gaps of single cells take the mean of their neighbours; larger
    holes (occlusions beside walls, water) are filled from their lower rim, because what is hidden from above is ground.
    """
    points = cloud.points
    low, high = points[:, :2].min(0), points[:, :2].max(0)
    if len(points) < 100 or not (high - low > 0).all():
        raise InputError(
            f"The cloud {name} has {len(points)} points over no area: a scene needs at least 100, spread out."
        )
    if cloud.epsg and is_geographic(cloud.epsg):
        raise InputError(
            f"The cloud {name} is in degrees (EPSG:{cloud.epsg}): give it in a projected CRS, for example UTM."
        )
    probe = max(float((high - low).max()) / 400, 1e-6)
    cells = len(np.unique(np.floor((points[:, :2] - low) / probe).astype(np.int64) @ [100_000, 1]))
    cell = max(0.1, 1.25 * np.sqrt(cells * probe**2 / len(points)), np.sqrt(np.prod(high - low) / MAX_CELLS))
    cols, rows = (int(v) for v in np.floor((high - low) / cell) + 1)
    index = np.floor((points[:, :2] - low) / cell).astype(np.int64)
    flat = (rows - 1 - index[:, 1]) * cols + index[:, 0]  # row 0 is the north
    top = np.full(rows * cols, -np.inf)
    np.maximum.at(top, flat, points[:, 2])
    known = np.isfinite(top)
    surface = np.where(known, top, np.nan).reshape(rows, cols)
    surface = _without_spikes(surface)
    texture = None
    if cloud.colors is not None:
        near_top = points[:, 2] >= np.nan_to_num(surface.ravel()[flat], nan=np.inf) - 0.5
        count = np.bincount(flat[near_top], minlength=rows * cols)
        colors = np.stack(
            [np.bincount(flat[near_top], cloud.colors[near_top, k], minlength=rows * cols) for k in range(3)], -1
        )
        mean = (colors / np.maximum(count, 1)[:, None]).reshape(rows, cols, 3)
        row, col = ndimage.distance_transform_edt(
            (count == 0).reshape(rows, cols), return_distances=False, return_indices=True
        )
        texture = np.rint(mean[row, col]).astype(np.uint8)
    surface = _fill_holes(surface)
    x = low[0] + (np.arange(cols) + 0.5) * cell
    y = low[1] + (rows - np.arange(rows) - 0.5) * cell
    gx, gy = np.meshgrid(x, y)
    return grid_scene(name, gx, gy, surface, None, texture, cloud.epsg, cell)


def _without_spikes(z: Array, jump: float = 12.0) -> Array:
    around = ndimage.median_filter(nearest_fill(z), 5, mode="nearest")
    high = np.isfinite(z) & (z > around + jump)
    labels, count = ndimage.label(high, np.ones((3, 3)))
    small = np.concatenate([[False], np.bincount(labels.ravel(), minlength=count + 1)[1:] <= 3])
    return np.where(small[labels], np.nan, z)


def _fill_holes(z: Array) -> Array:
    """Fill gaps and enclosed holes; what lies outside the cloud stays NaN."""
    eight = np.ones((3, 3), bool)
    missing = ~np.isfinite(z)
    # The cloud's area: known cells, closed over gaps of up to 8 cells, and everything enclosed.
    padded = np.pad(~missing, 8)
    area = ndimage.binary_fill_holes(ndimage.binary_closing(padded, eight, iterations=8))[8:-8, 8:-8]
    neighbours = ndimage.convolve((~missing).astype(float), eight.astype(float), mode="constant")
    total = ndimage.convolve(np.where(missing, 0.0, z), eight.astype(float), mode="constant")
    single = missing & (neighbours >= 5)
    spread = ndimage.maximum_filter(np.where(missing, -np.inf, z), 3) - ndimage.minimum_filter(
        np.where(missing, np.inf, z), 3
    )
    single &= spread < 1.0  # across an edge the lower side is right
    z = np.where(single, total / np.maximum(neighbours, 1), z)
    labels, count = ndimage.label(~np.isfinite(z) & area, eight)
    if not count:
        return z
    # The rim of every hole: pairs of a hole's number and a known cell beside it.
    row, col = np.nonzero(labels)
    steps = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j])
    beside = np.stack([row, col], -1)[:, None] + steps  # [holes' cells, 8, 2]
    inside = ((beside >= 0) & (beside < z.shape)).all(-1)
    beside = np.where(inside[..., None], beside, 0)
    inside &= np.isfinite(z[beside[..., 0], beside[..., 1]])
    number = np.broadcast_to(labels[row, col][:, None], inside.shape)[inside]
    rim = np.unique(np.c_[number, beside[inside]], axis=0)
    height = z[rim[:, 1], rim[:, 2]]
    order = np.lexsort([height, rim[:, 0]])
    rim, height = rim[order], height[order]
    size = np.bincount(rim[:, 0], minlength=count + 1)
    first = np.cumsum(size) - size
    lowest = np.where(size > 0, height[np.minimum(first + size // 10, len(height) - 1)], 0.0)
    # Ground may rise a little along a hole, but what stands well above the lowest part of its rim is a wall or a tree.
    low = height <= (lowest + 1.0 + 0.05 * np.sqrt(np.bincount(labels.ravel())))[rim[:, 0]]
    apart = 10.0 * max(z.shape)  # one axis for the hole's number, so that each takes its own rim only
    tree = cKDTree(rim[low][:, [1, 2, 0]] * [1, 1, apart])
    near, which = tree.query(np.c_[row, col, labels[row, col] * apart], k=4, distance_upper_bound=apart / 2)
    weight = np.where(np.isfinite(near), 1 / near, 0.0)
    value = np.append(height[low], 0.0)[which]
    filled = z.copy()
    total_weight = weight.sum(1)
    filled[row, col] = np.where(total_weight > 0, (weight * value).sum(1) / np.maximum(total_weight, 1e-12), np.nan)
    return filled
