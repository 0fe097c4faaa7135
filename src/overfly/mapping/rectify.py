"""Epipolar rectification of any two frames, whatever their relative yaw, height or direction of the baseline.

Both cameras are turned about their centres until their x axes lie along the baseline and their z axes are parallel
(Fusiello, Trucco & Verri 2000, section 3): corresponding points then share a row. The turn is made from the baseline
itself, so vertical baselines and neighbouring strips flown in opposite directions need no special case.

Then the right canvas is sheared along its rows until level ground lies at the same place in both. Tilted frames see it
sheared against one another, so that blocks of pixels would not match; and what is left to search is the relief instead
of the depth of the whole view.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from overfly.geometry import Array, Camera, rays
from overfly.mapping.depth_ranges import Span

Image = NDArray[np.uint8]

STRETCHED, SHEARED = (0.5, 2.0), 2.0
"""How much wider one frame may show the ground than the other along the baseline, and by how many pixels a row a canvas
may be sheared, or it stays as it is: ground that is almost as high as the cameras asks for any shear."""


@dataclass(frozen=True)
class Relief:
    """Heights z in the cameras' frame, metres: the lowest and highest of the surface, and that of usual ground."""

    low: float
    ground: float
    high: float


def relief_of(here: Span, there: Span) -> Relief:
    """The relief that two frames may show."""
    return Relief(min(here.low, there.low), (here.ground + there.ground) / 2, max(here.high, there.high))


@dataclass(frozen=True)
class Rectified:
    """Two virtual cameras with one rotation and one focal length; ``left`` lies at the smaller x of the baseline.

    A pixel (u, v) of the left canvas and its partner (u - d, v) of the right canvas see one point.

    Attributes:
        rotation: world-from-rectified rotation [3, 3], the same for both.
        focal: pixels.
        baseline: metres.
        left, right: calibration matrices [3, 3] of the two canvases; that of the right one shears.
        size: (width, height) of both canvases.
        limits: least and most disparity of the surface, pixels.
        reach: nearest and farthest depth, metres.
    """

    rotation: Array
    focal: float
    baseline: float
    left: Array
    right: Array
    size: tuple[int, int]
    limits: tuple[float, float]
    reach: tuple[float, float]

    def matrix(self, right: bool) -> Array:
        """Calibration matrix [3, 3] of one canvas."""
        return self.right if right else self.left

    def sigma(self, depth: NDArray, disparity_sigma: float) -> NDArray:
        """Standard deviation of depths [H, W] by that of their disparities, pixels."""
        return np.asarray(depth * depth * np.float32(disparity_sigma / (self.right[0, 0] * self.baseline)))

    def depth(self, disparity: NDArray, u: NDArray, v: NDArray, *, right: bool = False) -> NDArray:
        """Depth along the rectified z axis of the pixels (u, v) of a canvas; NaN in, and out of reach, NaN out."""
        start = u + disparity if right else u
        (focal, _, u0), (stretch, shear, offset) = (matrix[0].astype(np.float32) for matrix in (self.left, self.right))
        y = (v - np.float32(self.left[1, 2])) / focal
        # Where each of the two sees the point in the plane z = 1.
        x, partner = (start - u0) / focal, (start - disparity - shear * y - offset) / stretch
        parallax = x - partner
        known = (parallax >= self.baseline / self.reach[1]) & (parallax <= self.baseline / self.reach[0])
        return np.where(known, np.float32(self.baseline) / np.where(known, parallax, 1), np.float32(np.nan))


def rectify(
    cameras: tuple[Camera, Camera],
    poses: tuple[Array, Array],
    ranges: tuple[tuple[float, float], tuple[float, float]],
    relief: Relief | None = None,
) -> Rectified | None:
    """Lay out the two canvases so that they hold the overlap and nothing else.

    Args:
        cameras: of the two frames; the one at the smaller x of the common frame must come first (see :func:`ordered`).
        poses: world_from_camera [4, 4].
        ranges: (nearest, farthest) depth in each frame, metres.
        relief: of the surface; without it the right canvas is not sheared, and heights do not limit disparities.

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
    left, right = (_border(c, rotation.T @ p[:3, :3]) for c, p in zip(cameras, poses))
    if left is None or right is None:
        return None
    nearest = max(min(ranges[0][0], ranges[1][0]) * 0.9, 1e-6)
    farthest = max(ranges[0][1], ranges[1][1]) * 1.1
    # All along the plane z = 1 from here to the canvases.
    sheared, least, most = np.array([1.0, 0, 0]), baseline / farthest, baseline / nearest
    if relief is not None and (ground := _of_ground(rotation, baseline, pose_l, pose_r, relief)) is not None:
        shear = np.array([1, ground[1], ground[2]]) / (1 - ground[0])
        moved = np.column_stack([right @ shear, right[:, 1:]])
        low, high = _limits(left @ ground, pose_l[2, 3], (least, most), relief) * shear[0]
        other_low, other_high = _limits(moved @ ground, pose_r[2, 3], (least, most), relief)
        low, high = max(low, other_low), min(high, other_high)
        if 0 < high - low < most - least:  # else there is more to search than without
            sheared, right, least, most = shear, moved, low, high
    focal = (cam_l.fx + cam_l.fy + cam_r.fx + cam_r.fy) / 4
    # Single wrong points close to a camera ask for disparities without end; nothing matches over a whole image.
    widest = max(cam_l.width, cam_r.width)
    least, most = float(max(focal * least, -widest / 2)), float(focal * most)
    most = min(most, least + widest)
    (l0, top_l), (r0, top_r) = (border[:, :2].min(0) * focal for border in (left, right))
    (l1, bottom_l), (r1, bottom_r) = (border[:, :2].max(0) * focal for border in (left, right))
    pad = (most - least) / 2 + 8
    start, stop = max(l0, r0 + least) - pad, min(l1, r1 + most) + pad
    top, bottom = max(top_l, top_r), min(bottom_l, bottom_r)
    width, height = int(np.ceil(stop - start)), int(np.ceil(bottom - top))
    if most <= least or width < 32 + 2 * pad or height < 32:
        return None
    middle = float(np.round((most + least) / 2))
    matrix = np.array([[focal, 0, -start], [0, focal, -top], [0, 0, 1.0]])
    limits = least - middle, most - middle
    other = matrix.copy()
    other[0] = focal * sheared + [0, 0, middle - start]
    return Rectified(rotation, focal, baseline, matrix, other, (width, height), limits, (nearest, farthest))


def _of_ground(rotation: Array, baseline: float, left: Array, right: Array, relief: Relief) -> Array | None:
    """Parallax of level ground in the plane z = 1: at a place (x, y) of the left frame (x, y, 1) times this, [3].

    None where it would shear or stretch the canvas too much.

    Args:
        left, right: world_from_camera [4, 4].
    """
    if relief.ground >= min(left[2, 3], right[2, 3]):
        return None
    found: Array = baseline * rotation[2] / (relief.ground - left[2, 3])
    stretch = 1 - found[0]
    return found if STRETCHED[0] < stretch < STRETCHED[1] and abs(found[1]) < SHEARED * stretch else None


def _limits(ground: Array, height: float, reach: tuple[float, float], relief: Relief) -> Array:
    """Least and most of what parallaxes are above the ground's [N] along rays of a camera at a height z; [2].

    Args:
        reach: least and most parallax of all rays.
    """
    # Rays that come down beyond the farthest depth, or go up, see nothing that may be matched but towers.
    ground = ground[ground > reach[0]]
    if not len(ground):
        return np.zeros(2)
    over = height - relief.ground
    rise = over / (height - relief.high) if relief.high < height else np.inf
    # What is highest is nearest in the middle of a border, if the reach ends there.
    ground = np.append(ground, np.clip(reach[1] / rise, ground.min(), ground.max()))
    least = np.maximum(ground * (over / (height - relief.low)), reach[0])
    most = np.minimum(ground * rise, reach[1])
    return np.array([(least - ground).min(), (most - ground).max()])


def ordered(poses: tuple[Array, Array]) -> bool:
    """Whether the first frame should be the left one; False asks to swap.

    Either order rectifies; this one turns the left image least, so that texture is resampled alike in both.
    """
    right = poses[0][:3, 0] + poses[1][:3, 0]
    return bool(right @ (poses[1][:3, 3] - poses[0][:3, 3]) >= 0)


def _border(camera: Camera, rectified_from_camera: Array) -> Array | None:
    """Points (x, y, 1) [N, 3] along an image's border in the rectified plane, None if part of it is behind."""
    t = np.linspace(0, 1, 9)
    edge = np.concatenate([np.stack([t, 0 * t], 1), np.stack([t, 0 * t + 1], 1), np.stack([0 * t, t], 1)])
    edge = np.concatenate([edge, np.stack([0 * t + 1, t], 1)]) * [camera.width, camera.height]
    local = rays(edge, camera) @ rectified_from_camera.T
    if local[:, 2].min() < 0.2 * np.linalg.norm(local, axis=1).max():
        return None
    return np.asarray(local / local[:, 2:])


def canvas_map(camera: Camera, world_from_camera: Array, pair: Rectified, *, right: bool) -> tuple[NDArray, NDArray]:
    """Where each canvas pixel lies in the original (distorted) image: maps for cv2.remap, float32 [H, W] each."""
    import cv2

    turn = pair.rotation.T @ world_from_camera[:3, :3]
    matrix, canvas = camera.matrix(), pair.matrix(right).copy()
    # cv2 counts pixel centres from 0, this project from 0.5.
    matrix[:2, 2] -= 0.5
    canvas[:2, 2] -= 0.5
    u, v = cv2.initUndistortRectifyMap(matrix, camera.distortion, turn, canvas, pair.size, cv2.CV_32FC1)
    return u, v


def from_canvas(camera: Camera, world_from_camera: Array, pair: Rectified, *, right: bool) -> Array:
    """Homography [3, 3] that takes pixels of the undistorted frame to canvas pixels (both in this project's pixels)."""
    return np.asarray(pair.matrix(right) @ pair.rotation.T @ world_from_camera[:3, :3] @ np.linalg.inv(camera.matrix()))
