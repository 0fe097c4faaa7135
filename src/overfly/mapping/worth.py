"""What a photograph is worth for each cell of a surface: by its place in the image, its slope, and what hides it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from overfly.geometry import Camera
from overfly.mapping.fill import SURE
from overfly.mapping.lattice import Map

HEM, SOFT = 9, 5
"""Kernels, in cells, by which a frame's mask shrinks from what is hidden from it, and is then smoothed."""

EDGE = 8
"""Cells around a frame's box in which the filters of its mask may look."""

RAMP = 4
"""A frame has its full weight from 1 / RAMP of the image's side from the border on."""

NADIR = 0.5
"""Tangent off the vertical at which a frame is worth half of one that looks straight down."""


def value_of(x: Map, y: Map, depth: Map, slope: Map, camera: Camera, cell: float) -> Map:
    """What a frame is worth for each cell, if nothing hides it: 0 outside the image.

    Args:
        x, y: pixels of the cells.
        depth: along the optical axis.
        slope: squared tangent off the vertical.
        camera: of the image as it is drawn.
        cell: side of the cells.
    """
    with np.errstate(invalid="ignore"):
        edge = np.minimum(
            np.minimum(x, camera.width - x) / np.float32(camera.width),
            np.minimum(y, camera.height - y) / np.float32(camera.height),
        )
        fineness = np.minimum(1, np.float32(cell * camera.fx) / depth)
        value = np.clip(RAMP * edge, 0, 1) * fineness / (1 + slope / np.float32(NADIR**2))
        return np.where(value > 0, value, np.float32(0))


def feathered(free: NDArray[np.uint8]) -> Map:
    """Factors 0..1 from a mask of 255 where nothing hides the cells: 0 where hidden, and little beside that.

    The cells beside are the edges of roofs, of which this frame may be the only one to see anything.
    """
    import cv2

    # Beyond the box lies what the image does not show: free in any window.
    padded = cv2.medianBlur(np.pad(free, EDGE, constant_values=255), 5)
    soft = cv2.blur(cv2.erode(padded, np.ones((HEM, HEM), np.uint8)), (SOFT, SOFT))
    factor = np.where(padded > 0, np.maximum(soft, int(255 * SURE)), 0) / np.float32(255)
    return np.asarray(factor[EDGE:-EDGE, EDGE:-EDGE])
