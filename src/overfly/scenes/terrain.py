"""Bare ground: smooth relief by spectral synthesis, basins, and the grid that carries it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from overfly.scenes.scene import Heightfield

Array = NDArray[np.float64]

SHORTEST_M = 35.0
"""Shortest wavelength of the relief."""


class Relief:
    """A sum of random waves whose amplitude falls with the wavelength: height at any place, without a grid.

    Args:
        rng: source of the randomness.
        size_m: the landscape's width.
        range_m: height between the 2nd and 98th percentile within the landscape.
        roughness: exponent of the amplitude against the wavelength; larger is smoother.
    """

    def __init__(self, rng: np.random.Generator, size_m: float, range_m: float, roughness: float = 1.4) -> None:
        count = 70
        # The longest waves do not depend on the size, so that larger scenes do not have higher mountains.
        length = SHORTEST_M * (900.0 / SHORTEST_M) ** rng.random(count)
        angle = rng.random(count) * 2 * np.pi
        self._waves = np.stack([np.cos(angle), np.sin(angle)], -1) * (2 * np.pi / length)[:, None]
        self._phase = rng.random(count) * 2 * np.pi
        self._strength = length**roughness
        self._basins: list[tuple[Array, float, float]] = []
        self._mean, self._scale = 0.0, 1.0
        line = np.linspace(-size_m / 2, size_m / 2, 41)
        probe = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
        z = self(probe)
        low, high = np.percentile(z, [2, 98])
        self._mean, self._scale = float(z.mean()), range_m / max(float(high - low), 1e-9)

    def __call__(self, xy: ArrayLike) -> Array:
        """Height [...] at ``xy`` [..., 2]."""
        points = np.asarray(xy, float)
        z = np.zeros(points.shape[:-1])
        for wave, phase, strength in zip(self._waves, self._phase, self._strength):
            z += strength * np.cos(points[..., 0] * wave[0] + points[..., 1] * wave[1] + phase)
        z = (z - self._mean) * self._scale
        for centre, radius, level in self._basins:
            away = np.hypot(points[..., 0] - centre[0], points[..., 1] - centre[1]) / radius
            share = np.clip((1.45 - away) / 0.45, 0, 1)
            share = share * share * (3 - 2 * share)
            z = z + (level - z) * share
        return z

    def level(self, centre: ArrayLike, radius: float, height: float | None = None) -> float:
        """Make a level disc (a pond, a sports ground) at ``centre``; returns its height."""
        centre = np.asarray(centre, float)
        value = float(self(centre[None])[0]) if height is None else height
        self._basins.append((centre, radius, value))
        return value


def grid_lines(size_m: float, cell: float, reach: float) -> Array:
    """Lines of a grid: even by ``cell`` within the landscape, growing beyond it out to ``reach`` on each side."""
    half = size_m / 2
    inner = np.linspace(-half, half, max(2, round(size_m / cell)) + 1)
    outer, step, at = [], cell * 1.5, half
    while at < half + reach:
        at += step
        step *= 1.5
        outer.append(at)
    rim = np.array(outer)
    return np.concatenate([-rim[::-1], inner, rim])


def heightfield(relief: Relief, size_m: float) -> Heightfield:
    """The ground's grid: 4 m cells for usual sizes, coarser for large ones; its mean within the landscape is 0."""
    cell = 4.0 if size_m <= 700 else 4.0 * np.sqrt(size_m / 700)
    lines = grid_lines(size_m, float(cell), max(500.0, size_m))
    z = relief(np.stack(np.meshgrid(lines, lines), -1))
    inside = np.abs(lines) <= size_m / 2 + 1e-6
    return Heightfield(lines, lines, z - z[np.ix_(inside, inside)].mean())
