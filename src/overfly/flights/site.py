"""What a flight is planned over: camera, terrain, height; and the search for the spacing that gives an overlap."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from overfly.errors import InputError
from overfly.flights.footprint import REACH, Ground, footprints, pair_overlap, terrain_range
from overfly.geometry import Array, Camera, rotation_from_gimbal

Area = tuple[float, float, float, float]
"""x_min, y_min, x_max, y_max in local metres."""

MAX_FRAMES = 20_000
MIN_CLEARANCE_M = 2.0
SAMPLE_PAIRS = 300
TOLERANCE = 0.0005


@dataclass(frozen=True)
class Layout:
    """Frames in the order of flight.

    Attributes:
        poses: world_from_camera [n, 4, 4].
        strip: [n] number of the strip or orbit.
        forward: [m, 2] pairs of consecutive frames of one strip.
        side: outlines [k, p, 2] and those of their neighbours across, which measure the side overlap; None without.
        step_m, step_deg, line_spacing_m, radius_m: what was solved; None where the path has no such thing.
    """

    poses: Array
    strip: NDArray[np.int64]
    forward: NDArray[np.int64]
    side: tuple[Array, Array] | None = None
    step_m: float | None = None
    step_deg: float | None = None
    line_spacing_m: float | None = None
    radius_m: float | None = None


@dataclass(frozen=True)
class Site:
    """A camera at a height over a terrain."""

    camera: Camera
    ground: Ground
    area: Area
    altitude: float
    tilt_deg: float
    terrain_follow: bool
    ground_height: float = field(init=False)
    height_range: tuple[float, float] = field(init=False)

    def __post_init__(self) -> None:
        half_deg = self.camera.fov_deg[1] / 2
        far_deg = min(self.tilt_deg + half_deg, math.degrees(math.atan(REACH)))
        margin = self.altitude * (math.tan(math.radians(far_deg)) + 1.0)
        mean, low, high = terrain_range(self.ground, self.area, margin)
        if not math.isfinite(mean + low + high):
            raise InputError("The terrain under the area is not known everywhere: choose an area inside the scene.")
        object.__setattr__(self, "ground_height", mean)
        object.__setattr__(self, "height_range", (low, high))

    @property
    def centre(self) -> Array:
        x0, y0, x1, y1 = self.area
        return np.array([(x0 + x1) / 2, (y0 + y1) / 2])

    def poses(self, xy: ArrayLike, yaw_deg: ArrayLike, tilt_deg: ArrayLike) -> Array:
        """world_from_camera [n, 4, 4] of level cameras at ``xy`` [n, 2]; yaw [n], tilt off nadir [n] or one value."""
        xy = np.asarray(xy, float).reshape(-1, 2)
        yaw, tilt = np.broadcast_to(yaw_deg, len(xy)), np.broadcast_to(tilt_deg, len(xy))
        poses = np.tile(np.eye(4), (len(xy), 1, 1))
        turns: dict[tuple[float, float], Array] = {}
        for i, key in enumerate(zip(yaw.tolist(), tilt.tolist(), strict=True)):
            if key not in turns:
                turns[key] = rotation_from_gimbal(key[0], -90.0 + key[1])
            poses[i, :3, :3] = turns[key]
        poses[:, :2, 3] = xy
        base = np.asarray(self.ground(xy), float) if self.terrain_follow else self.ground_height
        poses[:, 2, 3] = base + self.altitude
        return poses

    def outlines(self, poses: ArrayLike) -> Array:
        """Footprints [n, m, 2] on the terrain; flights through the ground are refused, see :meth:`check_clearance`."""
        self.check_clearance(np.asarray(poses, float))
        return footprints(self.camera, poses, self.ground, self.height_range)

    def frame_size(self, tilt_deg: float) -> tuple[float, float, float]:
        """On level ground: length along the heading, mean width, and how far its middle lies ahead of the camera."""
        pose = np.eye(4)
        pose[:3, :3] = rotation_from_gimbal(0.0, -90.0 + tilt_deg)
        pose[2, 3] = self.altitude
        outline = footprints(self.camera, pose, lambda xy: np.zeros(len(xy)), (0.0, 0.0))[0]
        near, far = float(outline[:, 1].min()), float(outline[:, 1].max())
        x, y = outline.T
        area = abs(float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))) / 2
        return far - near, area / (far - near), (near + far) / 2

    def overlap(self, poses: ArrayLike, pairs: NDArray[np.int64], limit: int | None = None) -> float:
        """Mean overlap (0..1) of pairs of frames [m, 2]; ``limit`` takes as many of them, evenly chosen."""
        if limit is not None and len(pairs) > limit:
            pairs = pairs[np.linspace(0, len(pairs) - 1, limit).round().astype(int)]
        used, index = np.unique(pairs, return_inverse=True)
        outlines = self.outlines(np.asarray(poses)[used])
        index = index.reshape(-1, 2)
        return float(pair_overlap(outlines[index[:, 0]], outlines[index[:, 1]]).mean())

    def check_clearance(self, poses: Array) -> None:
        """Refuse flights through the ground.

        Raises:
            InputError: a camera is less than :data:`MIN_CLEARANCE_M` over the bare terrain.
        """
        clearance = float((poses[:, 2, 3] - np.asarray(self.ground(poses[:, :2, 3]), float)).min())
        if clearance < MIN_CLEARANCE_M:
            needed = math.ceil(self.altitude - clearance + MIN_CLEARANCE_M)
            raise InputError(
                f"At altitude={self.altitude:g} over the mean ground the flight comes to {clearance:.1f} m over the "
                f"terrain: give an altitude of at least {needed}, a smaller area, or terrain_follow=true."
            )


def spacing_for(
    measure: Callable[[float], float], start: float, target: float, *, upper: float = math.inf, what: str = "overlap"
) -> float:
    """The spacing at which a falling overlap reaches its target: secant steps (Illinois) inside a bracket.

    Args:
        measure: mean overlap 0..1 at a spacing > 0.
        start: first guess; it is returned unchanged when it is right.
        target: 0..1. At 0 the smallest spacing with (nearly) no overlap is sought.
        upper: largest spacing allowed.

    Raises:
        InputError: the overlap cannot be reached.
    """
    x = min(start, upper)
    value = measure(x)
    # At 0 % the overlap is flat at 0 beyond the root: aim just short of it.
    aim, tolerance = (target, TOLERANCE) if target > 0 else (3 * TOLERANCE, 2 * TOLERANCE)
    if abs(value - target) <= 1e-7 or (target == 0 and value <= aim + tolerance):
        return x
    low, high = (x, math.nan) if value > aim else (math.nan, x)
    f_low, f_high = (value - aim, math.nan) if value > aim else (math.nan, value - aim)
    for _ in range(60):
        if math.isnan(high):
            if low >= upper:
                break
            x = min(low * (1.3 if f_low > 0.1 else 1.05), upper)
        elif math.isnan(low):
            x = high * (0.7 if f_high < -0.1 else 0.95)
        else:
            x = (low * f_high - high * f_low) / (f_high - f_low)
        value = measure(x)
        f = value - aim
        if abs(f) <= tolerance:
            return x
        if f > 0:
            if not math.isnan(low):
                f_high /= 2
            low, f_low = x, f
        else:
            if not math.isnan(high):
                f_low /= 2
            high, f_high = x, f
    raise InputError(
        f"An {what} of {100 * target:g} % cannot be flown here (the nearest found is {100 * value:.1f} %): "
        "choose another overlap, a higher altitude or a larger area."
    )
