"""A tilted image as it would be seen looking straight down: level ground has one shape from whatever side it is seen.

SIFT finds a place again under turns and zooms, not under the foreshortening of a tilted view, which differs from one
heading to the next. A camera that turns about its centre changes its image by a homography, whatever the relief is,
so that the gimbal alone tells how to undo it (planar rectification: Wu et al., "3D model matching with
viewpoint-invariant patches (VIP)", 2008, section 2, with the horizontal plane for every patch).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from overfly.geometry import Array, Camera, gimbal_from_rotation, pixel_grid, rotation_from_gimbal

LEAST_TILT_DEG = 15.0
"""From nadir: images tilted by less are alike as they are (by 10 degrees: 4 % fewer right matches with a view)."""

STEEPEST_DEG = 65.0
"""From nadir: the view ends about there. Farther ground is mostly stretched pixels, and has no key points."""

LARGEST = 4.0
"""Most pixels of a view in those of the image."""

RIM_PX = 7
"""Pixels beside the image's border whose surroundings are not the image's."""


class NadirView(NamedTuple):
    """An image seen straight down, with the image's heading.

    Attributes:
        image: [h, w].
        mask: [h, w], 255 where it shows the image.
        from_image: homography [3, 3] of pixels (centres at +0.5), view from image.
    """

    image: NDArray[np.uint8]
    mask: NDArray[np.uint8]
    from_image: Array

    def in_image(self, pixels: NDArray) -> Array:
        """Pixels [n, 2] of the view in the image."""
        at = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(self.from_image).T
        return np.asarray(at[:, :2] / at[:, 2:])


def nadir_view(gray: NDArray[np.uint8], gimbal: tuple[float, float, float], focal_px: float) -> NadirView | None:
    """The view of an image [H, W]; None for one that looks down already, or along the horizon.

    Args:
        gray: the image; its distortion is taken as none, which bends the view a little and takes no place from it.
        gimbal: yaw, pitch and roll, degrees.
        focal_px: in pixels of ``gray``.
    """
    import cv2

    height, width = gray.shape
    rotation = rotation_from_gimbal(*gimbal)
    tilt = np.arccos(np.clip(-rotation[2, 2], -1, 1))
    if not LEAST_TILT_DEG <= np.degrees(tilt) < STEEPEST_DEG:
        return None
    down = rotation_from_gimbal(gimbal_from_rotation(rotation)[0], -90.0)
    camera = Camera(width, height, focal_px, focal_px, width / 2, height / 2)
    ground_from_image = down.T @ rotation @ np.linalg.inv(camera.matrix())
    corners = pixel_grid(49, 37).reshape(-1, 2) * [width / 49, height / 37]
    at = np.column_stack([corners, np.ones(len(corners))]) @ ground_from_image.T
    seen = at[:, 2] > np.cos(np.radians(STEEPEST_DEG)) * np.linalg.norm(at, axis=1)
    places = at[seen, :2] / at[seen, 2:]
    low, high = places.min(0), places.max(0)
    # Across the line of sight a pixel in the middle of the image stays a pixel.
    zoom = focal_px * np.cos(tilt)
    zoom *= min(1.0, np.sqrt(LARGEST * gray.size / np.prod(zoom * (high - low))))
    from_image = np.diag([zoom, zoom, 1.0]) @ np.array([[1, 0, -low[0]], [0, 1, -low[1]], [0, 0, 1.0]])
    from_image = from_image @ ground_from_image
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    index = np.linalg.inv(half) @ from_image @ half  # cv2 counts pixel centres from 0
    columns, rows = (int(n) for n in np.ceil(zoom * (high - low)))
    view = cv2.warpPerspective(gray, index, (columns, rows), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    mask = cv2.warpPerspective(np.full_like(gray, 255), index, (columns, rows), flags=cv2.INTER_NEAREST)
    mask = cv2.erode(mask, np.ones((2 * RIM_PX + 1, 2 * RIM_PX + 1), np.uint8), borderValue=(0,))
    return NadirView(view, mask, from_image)
