"""Disparities of one rectified pair by semi-global matching (Hirschmüller 2008, OpenCV's block variant)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from overfly.geometry import Array, Camera
from overfly.mapping.rectify import Rectified, canvas_map, from_canvas

UNKNOWN = np.int16(-32768)
"""Marks a pixel without a disparity; disparities are stored in sixteenths of a pixel."""

Image = NDArray[np.uint8]


def disparities(
    images: tuple[Image, Image],
    cameras: tuple[Camera, Camera],
    poses: tuple[Array, Array],
    pair: Rectified,
    *,
    block: int = 5,
    smooth: tuple[float, float] = (8.0, 32.0),
    unique_percent: int = 5,
) -> NDArray[np.int16]:
    """Disparity of every pixel of the left canvas [H, W] in sixteenths of a pixel, ``UNKNOWN`` where not sure.

    Args:
        images: the two frames in gray [H, W], as stored (distorted).
        cameras, poses: of these images.
        pair: from :func:`overfly.mapping.rectify.rectify`, for these cameras.
        block: side of the matched block, pixels.
        smooth: P1 and P2 divided by block².
        unique_percent: by how much the best cost must win over the second best.
    """
    import cv2

    canvases, masks = [], []
    for right, (image, camera, pose) in enumerate(zip(images, cameras, poses)):
        u, v = canvas_map(camera, pose, pair, right=bool(right))
        canvases.append(cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
        masks.append((u > 0) & (v > 0) & (u < image.shape[1] - 1) & (v < image.shape[0] - 1))
    low = int(np.floor(pair.limits[0])) - 1
    span = int(np.ceil((pair.limits[1] + 1 - low) / 16)) * 16
    matcher = cv2.StereoSGBM.create(
        minDisparity=low,
        numDisparities=span,
        blockSize=block,
        P1=int(smooth[0] * block * block),
        P2=int(smooth[1] * block * block),
        disp12MaxDiff=1,
        preFilterCap=31,
        uniquenessRatio=unique_percent,
        speckleWindowSize=60,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    found = matcher.compute(canvases[0], canvases[1])
    # The partner must lie inside the right image, too.
    columns = np.arange(found.shape[1])[None] - (found.astype(np.int32) + 8) // 16
    inside = (columns >= 0) & (columns < found.shape[1]) & (found > (low - 1) * 16)
    partner = np.take_along_axis(masks[1], np.clip(columns, 0, found.shape[1] - 1), axis=1)
    return np.where(inside & partner & masks[0], found, UNKNOWN)


def right_disparities(left: NDArray[np.int16]) -> NDArray[np.int16]:
    """The same surface as seen from the right canvas: every left pixel is carried over, the nearest surface wins."""
    rows, columns = np.nonzero(left != UNKNOWN)
    value = left[rows, columns]
    # Sorted by disparity, so that the largest (nearest) is written last.
    target = columns - (value.astype(np.int32) + 8) // 16
    inside = (target >= 0) & (target < left.shape[1])
    rows, target, value = rows[inside], target[inside], value[inside]
    result = np.full(left.shape, UNKNOWN)
    np.maximum.at(result, (rows, target), value)
    return result


def depth_in_frame(
    disparity: NDArray[np.int16], camera: Camera, world_from_camera: Array, pair: Rectified, *, right: bool
) -> NDArray[np.float32]:
    """Depth of each pixel of the undistorted frame [H, W] in metres, NaN where unknown.

    Args:
        disparity: of the left canvas, or for ``right`` of the right one.
        camera: the undistorted camera at the wanted size.
    """
    import cv2

    real = np.where(disparity == UNKNOWN, np.float32(np.nan), disparity.astype(np.float32) / 16)
    homography = from_canvas(camera, world_from_camera, pair, right=right)
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    index = np.linalg.inv(half) @ homography @ half  # cv2 counts pixel centres from 0
    warped = cv2.warpPerspective(
        real,
        index,
        (camera.width, camera.height),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=float("nan"),
    )
    # A point at depth 1 in rectified axes has depth 1 / (third row of the homography) in camera axes.
    u, v = np.arange(camera.width) + 0.5, np.arange(camera.height)[:, None] + 0.5
    x, y, third = ((row[0] * u + row[1] * v + row[2]).astype(np.float32) for row in homography)
    return (pair.depth(warped, x / third, y / third, right=right) / third).astype(np.float32)
