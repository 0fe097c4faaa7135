"""Epipolar rectification of any two frames, whatever their relative yaw, height or direction of the baseline.

Both cameras are turned about their centres until their x axes lie along the baseline and their z axes are parallel
(Fusiello, Trucco & Verri 2000, section 3): corresponding points then share a row. The turn is made from the baseline
itself, so vertical baselines and neighbouring strips flown in opposite directions need no special case.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from overfly.geometry import Array, Camera, rays

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Rectified:
    """Two virtual cameras with one rotation and one focal length; ``left`` lies at the smaller x of the baseline.

    A pixel (u, v) of the left canvas and its partner (u - d, v) of the right canvas see the point at depth
    ``focal * baseline / (d + offset)``.

    Attributes:
        rotation: world-from-rectified rotation [3, 3], the same for both.
        focal: pixels.
        left_centre, right_centre: principal points (u, v) in the two canvases.
        baseline: metres.
        size: (width, height) of both canvases.
        nearest, farthest: depth range in metres that the canvas was laid out for.
    """

    rotation: Array
    focal: float
    left_centre: tuple[float, float]
    right_centre: tuple[float, float]
    baseline: float
    size: tuple[int, int]
    nearest: float
    farthest: float

    @property
    def offset(self) -> float:
        """Added to a disparity in canvas pixels it gives focal * baseline / depth."""
        return self.right_centre[0] - self.left_centre[0]

    def disparity(self, depth: float | Array) -> float | Array:
        """Canvas disparity of a depth along the rectified z axis."""
        return self.focal * self.baseline / depth - self.offset

    def depth(self, disparity: NDArray) -> NDArray:
        """Depth along the rectified z axis; NaN in, NaN out."""
        return np.float32(self.focal * self.baseline) / (disparity + np.float32(self.offset))

    def matrix(self, right: bool = False) -> Array:
        """Calibration matrix [3, 3] of one canvas."""
        u, v = self.right_centre if right else self.left_centre
        return np.array([[self.focal, 0, u], [0, self.focal, v], [0, 0, 1.0]])


def rectify(
    cameras: tuple[Camera, Camera],
    poses: tuple[Array, Array],
    ranges: tuple[tuple[float, float], tuple[float, float]],
    *,
    scale: float = 1.0,
) -> Rectified | None:
    """Lay out the two canvases so that they hold the overlap and nothing else.

    Args:
        cameras: of the two frames; the one at the smaller x of the common frame must come first (see :func:`ordered`).
        poses: world_from_camera [4, 4].
        ranges: (nearest, farthest) depth in each frame, metres.
        scale: size of canvas pixels: 0.5 halves the resolution.

    Returns:
        None where the frames look along their baseline, or do not overlap.
    """
    (cam_l, cam_r), (pose_l, pose_r) = cameras, poses
    shift = pose_r[:3, 3] - pose_l[:3, 3]
    baseline = float(np.linalg.norm(shift))
    forward = pose_l[:3, 2] + pose_r[:3, 2]
    if baseline == 0 or np.linalg.norm(forward) < 0.2:
        return None
    x = shift / baseline
    z = forward - x * (forward @ x)
    if np.linalg.norm(z) < 0.35 * np.linalg.norm(forward):
        return None
    z /= np.linalg.norm(z)
    rotation = np.stack([x, np.cross(z, x), z], axis=1)
    focal = scale * (cam_l.fx + cam_l.fy + cam_r.fx + cam_r.fy) / 4
    boxes = [_box(c, rotation.T @ p[:3, :3]) for c, p in zip(cameras, poses)]
    if boxes[0] is None or boxes[1] is None:
        return None
    nearest = max(min(ranges[0][0], ranges[1][0]) * 0.9, 1e-6)
    farthest = max(ranges[0][1], ranges[1][1]) * 1.1
    most, least = focal * baseline / nearest, focal * baseline / farthest
    # Single wrong points close to a camera ask for disparities without end; nothing matches over a whole image.
    most = min(most, least + max(cam_l.width, cam_r.width))
    nearest = focal * baseline / most
    (l0, l1), (r0, r1) = boxes[0][0] * focal, boxes[1][0] * focal
    top, bottom = (f(boxes[0][1][i], boxes[1][1][i]) * focal for f, i in ((max, 0), (min, 1)))
    pad = (most - least) / 2 + 8
    start, stop = max(l0, r0 + least) - pad, min(l1, r1 + most) + pad
    width, height = int(np.ceil(stop - start)), int(np.ceil(bottom - top))
    if width < 32 + 2 * pad or height < 32:
        return None
    middle = np.round((most + least) / 2)
    return Rectified(
        rotation,
        focal,
        (-start, -top),
        (-start + middle, -top),
        baseline,
        (width, height),
        nearest,
        farthest,
    )


def ordered(poses: tuple[Array, Array]) -> bool:
    """Whether the first frame should be the left one; False asks to swap.

    Either order rectifies; this one turns the left image least, so that texture is resampled alike in both.
    """
    right = poses[0][:3, 0] + poses[1][:3, 0]
    return bool(right @ (poses[1][:3, 3] - poses[0][:3, 3]) >= 0)


def _box(camera: Camera, rectified_from_camera: Array) -> Array | None:
    """Bounds of an image in the rectified plane z = 1: [[x0, x1], [y0, y1]], None if part of it is behind."""
    t = np.linspace(0, 1, 9)
    edge = np.concatenate([np.stack([t, 0 * t], 1), np.stack([t, 0 * t + 1], 1), np.stack([0 * t, t], 1)])
    edge = np.concatenate([edge, np.stack([0 * t + 1, t], 1)]) * [camera.width, camera.height]
    local = rays(edge, camera) @ rectified_from_camera.T
    if local[:, 2].min() < 0.2 * np.linalg.norm(local, axis=1).max():
        return None
    flat = local[:, :2] / local[:, 2:]
    return np.stack([flat.min(0), flat.max(0)], axis=1)


def canvas_map(camera: Camera, world_from_camera: Array, pair: Rectified, *, right: bool) -> tuple[NDArray, NDArray]:
    """Where each canvas pixel lies in the original (distorted) image: maps for cv2.remap, float32 [H, W] each."""
    import cv2

    turn = pair.rotation.T @ world_from_camera[:3, :3]
    matrix, canvas = camera.matrix(), pair.matrix(right)
    # cv2 counts pixel centres from 0, this project from 0.5.
    matrix[:2, 2] -= 0.5
    canvas[:2, 2] -= 0.5
    u, v = cv2.initUndistortRectifyMap(matrix, camera.distortion, turn, canvas, pair.size, cv2.CV_32FC1)
    return u, v


def from_canvas(camera: Camera, world_from_camera: Array, pair: Rectified, *, right: bool) -> Array:
    """Homography [3, 3] that takes pixels of the undistorted frame to canvas pixels (both in this project's pixels)."""
    return pair.matrix(right) @ pair.rotation.T @ world_from_camera[:3, :3] @ np.linalg.inv(camera.matrix())
