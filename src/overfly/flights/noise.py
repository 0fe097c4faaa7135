"""What GPS receivers and gimbals add to the truth: errors of positions and angles, seeded."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from overfly.errors import InputError, unknown
from overfly.geometry import Array, gimbal_from_rotation, rotation_from_gimbal

VERTICAL_FACTOR = 3.0
"""Satellite heights are about three times worse than positions (research on drone GPS: 3 to 4 times)."""


@dataclass(frozen=True, kw_only=True)
class PoseNoise:
    """Standard deviations of Gaussian errors. Heights get :data:`VERTICAL_FACTOR` times the horizontal values.

    Attributes:
        horizontal_m: of each frame, per axis.
        bias_horizontal_m: of the whole flight, per axis (it moves all frames alike).
        yaw_deg, tilt_deg: of each frame; tilt means pitch and roll.
        bias_yaw_deg: of the whole flight (compass).
    """

    horizontal_m: float
    bias_horizontal_m: float
    yaw_deg: float
    tilt_deg: float
    bias_yaw_deg: float

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < float("inf"):
                raise InputError(f"The noise {f.name}={value!r} is not allowed: give a number of 0 or more.")

    def positions(self, positions: ArrayLike, rng: np.random.Generator) -> Array:
        """Positions [n, 3] as a receiver would report them."""
        true = np.asarray(positions, float).reshape(-1, 3)
        scale = np.array([1.0, 1.0, VERTICAL_FACTOR])
        bias = rng.normal(size=3) * scale * self.bias_horizontal_m
        return true + bias + rng.normal(size=true.shape) * scale * self.horizontal_m

    def angles(self, gimbal_deg: ArrayLike, rng: np.random.Generator) -> Array:
        """Yaw, pitch, roll [n, 3] in degrees as a gimbal would report them."""
        true = np.asarray(gimbal_deg, float).reshape(-1, 3)
        scale = np.array([self.yaw_deg, self.tilt_deg, self.tilt_deg])
        bias = np.array([rng.normal() * self.bias_yaw_deg, 0.0, 0.0])
        return true + bias + rng.normal(size=true.shape) * scale

    def poses(self, world_from_camera: ArrayLike, rng: np.random.Generator) -> Array:
        """Poses [n, 4, 4] as GPS and gimbal would report them: priors for an alignment."""
        poses = np.array(world_from_camera, float).reshape(-1, 4, 4)
        gimbal = np.array([gimbal_from_rotation(p[:3, :3]) for p in poses])
        noisy = poses.copy()
        noisy[:, :3, 3] = self.positions(poses[:, :3, 3], rng)
        for pose, angles in zip(noisy, self.angles(gimbal, rng), strict=True):
            pose[:3, :3] = rotation_from_gimbal(*angles.tolist())
        return noisy


NOISE: dict[str, PoseNoise] = {
    "none": PoseNoise(horizontal_m=0, bias_horizontal_m=0, yaw_deg=0, tilt_deg=0, bias_yaw_deg=0),
    "gps": PoseNoise(horizontal_m=1.0, bias_horizontal_m=2.0, yaw_deg=1.0, tilt_deg=0.3, bias_yaw_deg=2.0),
    "rtk": PoseNoise(horizontal_m=0.015, bias_horizontal_m=0.01, yaw_deg=0.5, tilt_deg=0.2, bias_yaw_deg=0.5),
}
"""Usual receivers: within one flight consumer GPS wanders by about a metre around an offset of a few metres."""


def noise_model(name: str | PoseNoise) -> PoseNoise:
    """The model called ``name``, or the one given.

    Raises:
        InputError: no such model.
    """
    if isinstance(name, PoseNoise):
        return name
    if name not in NOISE:
        raise unknown("The noise", name, NOISE)
    return NOISE[name]
