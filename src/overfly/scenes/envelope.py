"""The bare ground of a surface that came from a file: its lower envelope."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from overfly.scenes.scene import Heightfield

WINDOW_M = 50.0
"""Objects narrower than this stand on the ground; what is wider counts as ground."""


def nearest_fill(z: NDArray[np.float64]) -> NDArray[np.float64]:
    """Replace NaN by the nearest value; the raster must hold one."""
    missing = ~np.isfinite(z)
    if not missing.any():
        return z
    row, col = ndimage.distance_transform_edt(missing, return_distances=False, return_indices=True)
    return z[row, col]


def top_raster(
    points: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Lines x, y and the highest z [rows, cols] of points [N, 3] in cells of 2 m or a 60th of the extent."""
    size = float(min(high[0] - low[0], high[1] - low[1]))
    cell = max(min(2.0, size / 60), float(max(high[0] - low[0], high[1] - low[1])) / 1500)
    cols, rows = (max(2, int(np.ceil((high[i] - low[i]) / cell))) for i in range(2))
    index = np.floor((points[:, :2] - low[:2]) / cell).astype(int)
    index = np.clip(index, 0, [cols - 1, rows - 1])
    z = np.full(rows * cols, -np.inf)
    np.maximum.at(z, index[:, 1] * cols + index[:, 0], points[:, 2])
    z[~np.isfinite(z)] = np.nan
    return low[0] + (np.arange(cols) + 0.5) * cell, low[1] + (np.arange(rows) + 0.5) * cell, z.reshape(rows, cols)


def lower_envelope(x: NDArray[np.float64], y: NDArray[np.float64], z: NDArray[np.float64]) -> Heightfield:
    """Bare ground under a top surface ``z`` [rows, cols] (NaN = unknown) by morphological opening.

    The tilt is taken out first, so that slopes survive; what the smoothing lifts above the surface is put back.
    """
    filled = nearest_fill(z)
    gx, gy = np.meshgrid(x, y)
    design = np.stack([gx.ravel() - x.mean(), gy.ravel() - y.mean(), np.ones(gx.size)], -1)
    tilt = (design @ np.linalg.lstsq(design, filled.ravel(), rcond=None)[0]).reshape(z.shape)
    cell = float(x[1] - x[0])
    window = int(np.clip(round(WINDOW_M / cell), 3, max(3, min(z.shape) // 2)))
    flat = ndimage.minimum_filter(filled - tilt, 3)  # single high cells beside walls are not ground
    opened = ndimage.grey_opening(flat, size=(window, window), mode="nearest")
    smooth = ndimage.gaussian_filter(opened, max(1.0, window / 8), mode="nearest")
    return Heightfield(x, y, np.minimum(smooth + tilt, np.maximum(filled, opened + tilt)))
