"""How a scene looks when it is photographed: sun, air, camera electronics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from overfly.errors import InputError


@dataclass(frozen=True)
class Appearance:
    """Light, air and sensor of one image; every value is independent of the camera's geometry.

    Attributes:
        sun_azimuth_deg: clockwise from north.
        sun_elevation_deg: above the horizon, 5 to 90.
        shadows: whether the sun casts shadows.
        sun, sky: strength of the direct and of the ambient light; a clear day has far more of the first.
        haze: share of the light that 1 km of air replaces by sky colour, 0 to 1.
        exposure: factor on all light; 1 shows a mid-grey surface mid-grey.
        gain: white balance, a factor for red, green and blue.
        vignetting: loss of light in the image's corners, 0 to 1.
        noise_std: standard deviation of the sensor's noise at full signal, in grey values of 255; needs ``rng``.
    """

    sun_azimuth_deg: float = 150.0
    sun_elevation_deg: float = 50.0
    shadows: bool = True
    sun: float = 1.1
    sky: float = 0.40
    haze: float = 0.04
    exposure: float = 1.0
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    vignetting: float = 0.0
    noise_std: float = 0.0

    def __post_init__(self) -> None:
        if not 5 <= self.sun_elevation_deg <= 90:
            raise InputError(
                f"The sun's elevation is {self.sun_elevation_deg} degrees: give 5 to 90 (50 is a summer noon)."
            )
        for name in ("haze", "vignetting"):
            if not 0 <= getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}: give a share, 0 to less than 1.")
        if self.noise_std < 0 or self.exposure <= 0 or min(self.gain) <= 0:
            raise InputError("exposure and gain must be above 0, noise_std at least 0.")

    def sun_direction(self) -> NDArray[np.float64]:
        """Unit vector [3] from the ground to the sun."""
        azimuth, elevation = np.radians([self.sun_azimuth_deg, self.sun_elevation_deg])
        flat = np.cos(elevation)
        return np.array([np.sin(azimuth) * flat, np.cos(azimuth) * flat, np.sin(elevation)])
