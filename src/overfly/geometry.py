"""Cameras and rigid transforms: the conventions of the whole project stand here, once.

- World: local ENU in metres, x east, y north, z up, float64. Its origin is an ``Origin`` (geodesy.py), or unknown.
- Camera axes are OpenCV's: x right, y down, z forward. ``world_from_camera`` maps camera to world coordinates.
- Pixels: (u, v) = (column, row); the centre of the first pixel is (0.5, 0.5).
- Depth is the z coordinate in camera axes, in metres, never the length of the ray.
- Angles are degrees where the name ends in ``_deg``. Yaw, pitch and roll are DJI's gimbal angles: yaw clockwise from
  north, pitch 0 at the horizon and -90 straight down, roll clockwise as seen from behind the camera.
- Shapes: B batch, K frames of a window, N points, D height hypotheses, H rows, W columns.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Camera axes: OpenGL (x right, y up, z back) to OpenCV (x right, y down, z forward); its own inverse."""


BORDER = 65
"""Points along each border of an image at which a lens formula must have an inverse."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with OpenCV's radial (k1, k2, k3) and tangential (p1, p2) distortion. Lengths in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    @classmethod
    def from_fov(cls, width: int, height: int, horizontal_fov_deg: float) -> Camera:
        """A pinhole with square pixels and a central principal point."""
        focal = width / 2 / np.tan(np.radians(horizontal_fov_deg) / 2)
        return cls(width, height, focal, focal, width / 2, height / 2)

    @property
    def distortion(self) -> Array:
        """OpenCV's order k1, k2, p1, p2, k3 [5]."""
        return np.array([self.k1, self.k2, self.p1, self.p2, self.k3])

    @property
    def is_distorted(self) -> bool:
        return bool(np.any(self.distortion))

    @property
    def fov_deg(self) -> tuple[float, float]:
        """Horizontal and vertical field of view, distortion ignored."""
        return (
            float(np.degrees(2 * np.arctan(self.width / 2 / self.fx))),
            float(np.degrees(2 * np.arctan(self.height / 2 / self.fy))),
        )

    def matrix(self) -> Array:
        """The calibration matrix [3, 3]."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def resized(self, width: int, height: int) -> Camera:
        """The same camera for an image resampled to ``width`` x ``height`` pixels."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, cx=self.cx * sx, fy=self.fy * sy, cy=self.cy * sy
        )

    def undistorted(self) -> Camera:
        """The same camera without lens distortion."""
        return replace(self, k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0)

    def to_dict(self) -> dict[str, float]:
        return asdict(self)


def distort(normalised: ArrayLike, camera: Camera) -> Array:
    """Apply the lens to ideal image coordinates x/z, y/z [N, 2]."""
    points = np.asarray(normalised, float)
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (camera.k1 + r2 * (camera.k2 + r2 * camera.k3))
    return np.stack(
        [
            x * radial + 2 * camera.p1 * x * y + camera.p2 * (r2 + 2 * x * x),
            y * radial + camera.p1 * (r2 + 2 * y * y) + 2 * camera.p2 * x * y,
        ],
        axis=-1,
    )


def fold(camera: Camera) -> float:
    """Squared radius, in ideal image coordinates, at which the radial lens formula turns back; inf if it never does.

    Beyond it the formula means nothing: it throws points from far outside the field of view back into the image.
    """
    roots = np.roots([7 * camera.k3, 5 * camera.k2, 3 * camera.k1, 1.0])
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
    return float(real.min()) if real.size else np.inf


def undistort(distorted: ArrayLike, camera: Camera, iterations: int = 20) -> Array:
    """Invert :func:`distort` by Newton's method [N, 2], to about 1e-12 within three to six steps for usual lenses.

    NaN where the lens formula has no inverse: beyond the radius at which a strong barrel folds back.
    (Fixed-point iteration is simpler, but leaves 1e-4 px at the corners of a strong barrel after 20 steps.)
    """
    target = np.asarray(distorted, float)
    points = target.copy()
    for _ in range(iterations):
        x, y = points[..., 0], points[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (camera.k1 + r2 * (camera.k2 + r2 * camera.k3))
        slope = 2 * (camera.k1 + r2 * (2 * camera.k2 + r2 * 3 * camera.k3))  # d radial / d x = slope x
        xx = radial + slope * x * x + 2 * camera.p1 * y + 6 * camera.p2 * x
        yy = radial + slope * y * y + 6 * camera.p1 * y + 2 * camera.p2 * x
        xy = slope * x * y + 2 * camera.p1 * x + 2 * camera.p2 * y  # the Jacobian is symmetric
        miss_x, miss_y = np.moveaxis(distort(points, camera) - target, -1, 0)
        determinant = xx * yy - xy * xy
        step = np.stack([yy * miss_x - xy * miss_y, xx * miss_y - xy * miss_x], axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = np.clip(step / determinant[..., None], -1, 1)
        points = points - step
        if not np.any(np.abs(step) > 1e-12):
            break
    solved = np.abs(distort(points, camera) - target).max(-1) < 1e-7
    return np.where((solved & ((points**2).sum(-1) < fold(camera)))[..., None], points, np.nan)


def invertible(camera: Camera) -> bool:
    """Whether every pixel of the image has a ray: a strong lens formula may fold back before the border."""
    u, v = np.linspace(0, camera.width, BORDER), np.linspace(0, camera.height, BORDER)
    sides = [np.stack([u, 0 * u + y], 1) for y in (0, camera.height)]
    sides += [np.stack([0 * v + x, v], 1) for x in (0, camera.width)]
    return bool(np.isfinite(rays(np.concatenate(sides), camera)).all())


def project(points: ArrayLike, camera: Camera, world_from_camera: ArrayLike) -> tuple[Array, Array]:
    """Project world points into an image.

    Args:
        points: [..., 3] world coordinates, metres.
        camera: the camera, distortion included.
        world_from_camera: [4, 4].

    Returns:
        Pixels [..., 2] (NaN behind the camera and where the lens formula folds) and depth [...], metres.
    """
    local = transform(invert(world_from_camera), points)
    depth = local[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        normalised = np.where(depth[..., None] > 0, local[..., :2] / depth[..., None], np.nan)
    if camera.is_distorted:
        inside = (normalised**2).sum(-1, keepdims=True) < fold(camera)
        normalised = np.where(inside, distort(normalised, camera), np.nan)
    return normalised * [camera.fx, camera.fy] + [camera.cx, camera.cy], depth


def rays(pixels: ArrayLike, camera: Camera) -> Array:
    """Directions with z = 1 in camera axes for pixels [..., 2] -> [..., 3]."""
    normalised = (np.asarray(pixels, float) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    if camera.is_distorted:
        normalised = undistort(normalised, camera)
    return np.concatenate([normalised, np.ones_like(normalised[..., :1])], axis=-1)


def unproject(pixels: ArrayLike, depth: ArrayLike, camera: Camera, world_from_camera: ArrayLike) -> Array:
    """World points [..., 3] of pixels [..., 2] at ``depth`` [...]: the inverse of :func:`project`."""
    return transform(world_from_camera, rays(pixels, camera) * np.asarray(depth, float)[..., None])


def pixel_grid(width: int, height: int) -> Array:
    """The centres of all pixels [H, W, 2]."""
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([u, v], axis=-1)


def on_plane(pixels: ArrayLike, camera: Camera, world_from_camera: ArrayLike, height: float) -> Array:
    """Where the rays of pixels [..., 2] meet the plane z = ``height``: world points [..., 3], NaN above the horizon."""
    pose = np.asarray(world_from_camera, float)
    direction = rays(pixels, camera) @ pose[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (height - pose[2, 3]) / direction[..., 2]
    distance = np.where(np.isfinite(distance) & (distance > 0), distance, np.nan)
    return pose[:3, 3] + direction * distance[..., None]


def transform(matrix: ArrayLike, points: ArrayLike) -> Array:
    """Apply a [4, 4] (rigid or similarity) transform to points [..., 3]."""
    matrix = np.asarray(matrix, float)
    return np.asarray(points, float) @ matrix[:3, :3].T + matrix[:3, 3]


def invert(matrix: ArrayLike) -> Array:
    """The inverse of a rigid or similarity transform [4, 4]."""
    return np.linalg.inv(np.asarray(matrix, float))


def pose(rotation: ArrayLike, position: ArrayLike) -> Array:
    """``world_from_camera`` [4, 4] from a rotation [3, 3] and the camera's position [3]."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = position
    return matrix


def is_rotation(matrix: ArrayLike, tolerance: float = 1e-3) -> bool:
    """Whether a [3, 3] matrix is orthonormal with determinant +1."""
    matrix = np.asarray(matrix, float)
    close = np.allclose(matrix @ matrix.T, np.eye(3), atol=tolerance)
    return bool(np.isfinite(matrix).all() and close and np.linalg.det(matrix) > 0)


def rotation_from_gimbal(yaw_deg: float, pitch_deg: float, roll_deg: float = 0.0) -> Array:
    """Rotation world-from-camera [3, 3] of a gimbal (convention at the top of this file)."""
    yaw, pitch, roll = np.radians([yaw_deg, pitch_deg, roll_deg])
    forward = np.array([np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.cos(yaw), -np.sin(yaw), 0.0])
    down = np.cross(forward, right)
    # Roll clockwise as seen from behind: the camera's right side goes down.
    right, down = np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right
    return np.stack([right, down, forward], axis=1)


def gimbal_from_rotation(rotation: ArrayLike) -> tuple[float, float, float]:
    """Yaw, pitch and roll in degrees: the inverse of :func:`rotation_from_gimbal`.

    Straight down or up, where yaw and roll turn about the same axis, roll is taken as 0.
    """
    rotation = np.asarray(rotation, float)
    forward = rotation[:, 2]
    pitch = np.arcsin(np.clip(forward[2], -1, 1))
    if np.hypot(forward[0], forward[1]) < 1e-6:
        yaw = np.arctan2(-rotation[1, 0], rotation[0, 0])
        return float(np.degrees(yaw) % 360), float(np.degrees(pitch)), 0.0
    yaw = np.arctan2(forward[0], forward[1])
    level = rotation_from_gimbal(float(np.degrees(yaw)), float(np.degrees(pitch)))
    roll = np.arctan2(rotation[:, 0] @ level[:, 1], rotation[:, 0] @ level[:, 0])
    return float(np.degrees(yaw) % 360), float(np.degrees(pitch)), float(np.degrees(roll))


def look_at(position: ArrayLike, target: ArrayLike) -> Array:
    """``world_from_camera`` [4, 4] of a level camera at ``position`` [3] that faces ``target`` [3]."""
    position, direction = np.asarray(position, float), np.asarray(target, float) - np.asarray(position, float)
    yaw = np.degrees(np.arctan2(direction[0], direction[1]))
    pitch = np.degrees(np.arctan2(direction[2], np.hypot(direction[0], direction[1])))
    return pose(rotation_from_gimbal(float(yaw), float(pitch)), position)


def fit_similarity(
    source: ArrayLike,
    target: ArrayLike,
    *,
    rotate: bool = True,
    scale: bool = True,
    weights: ArrayLike | None = None,
) -> Array:
    """The least-squares transform target = M(source), [4, 4] (Umeyama 1991, Eqs. 39 to 43).

    Args:
        source, target: matched points [N, 3].
        rotate: False fits a translation (and the scale, if asked).
        scale: False keeps the scale at 1.
        weights: [N], non-negative; None weighs all points alike.
    """
    source, target = np.asarray(source, float), np.asarray(target, float)
    w = np.ones(len(source)) if weights is None else np.asarray(weights, float)
    w = (w / w.sum())[:, None]
    mean_s, mean_t = (w * source).sum(0), (w * target).sum(0)
    a, b = source - mean_s, target - mean_t
    rotation = np.eye(3)
    if rotate:
        u, _, vt = np.linalg.svd((w * b).T @ a)
        sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
        rotation = u @ sign @ vt
    factor = 1.0
    if scale:
        factor = float((w * b * (a @ rotation.T)).sum() / (w * a * a).sum())
    matrix = np.eye(4)
    matrix[:3, :3] = factor * rotation
    matrix[:3, 3] = mean_t - factor * rotation @ mean_s
    return matrix
