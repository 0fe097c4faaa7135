"""Detached houses with wings, garages and sheds."""

from __future__ import annotations

import numpy as np

from overfly.scenes import materials as m
from overfly.scenes.builder import Array
from overfly.scenes.buildings import Plots, chimneys, flat, pitched
from overfly.scenes.site import BRICK, FLAT_ROOF, PLASTER, TILE, Site


def homes(
    site: Site, spots: list[tuple[Array, float, float, float]], *, steep: float, hips: float, storeys: tuple[int, int]
) -> Plots:
    """Detached houses at (centre, angle, length, width): gabled, hipped, a few flat; with chimneys."""
    rng, n = site.rng, len(spots)
    centre = np.array([s[0] for s in spots]).reshape(n, 2)
    angle, length, width = (np.array([s[i] for s in spots]) for i in (1, 2, 3))
    brick = rng.random(n) < 0.3
    wall = np.where(brick, m.WALL_BRICK, m.WALL_WINDOWS)
    color = np.where(brick[:, None], site.choose(BRICK, n), site.choose(PLASTER, n))
    form = rng.random(n)
    is_flat = form > 0.93
    roof = np.where(is_flat, m.ROOF_GRAVEL, m.ROOF_TILES)
    roof_color = np.where(is_flat[:, None], site.choose(FLAT_ROOF, n), site.choose(TILE, n))
    height = rng.integers(storeys[0], storeys[1] + 1, n) * 2.8
    plots = site.plots(centre, angle, length, width, height, wall, color, roof, roof_color)
    flat(site.builder, plots[is_flat], parapet=0.4)
    pitch = ~is_flat
    rise = plots.width / 2 * rng.uniform(0.75, 1.15, n) * steep
    hip = np.where(form < hips, plots.width / 2 * rng.uniform(0.7, 1.1, n), 0.0)
    pitched(site.builder, plots[pitch], rise[pitch], hip[pitch])
    chimneys(site.builder, plots[pitch], rise[pitch], rng)
    # A lower wing at right angles makes half of the houses L-shaped.
    wing = np.flatnonzero(pitch & (rng.random(n) < 0.45))
    side = rng.choice([-1, 1], len(wing))
    normal = np.stack([-np.sin(angle[wing]), np.cos(angle[wing])], -1)
    tangent = np.stack([np.cos(angle[wing]), np.sin(angle[wing])], -1)
    at = (
        centre[wing]
        + normal * (side * width[wing] * 0.55)[:, None]
        + tangent * (rng.uniform(-0.2, 0.2, len(wing)) * length[wing])[:, None]
    )
    extra = plots[wing]
    extra.centre, extra.angle = at, angle[wing] + np.pi / 2
    extra.length, extra.width = width[wing] * 0.9, width[wing] * 0.6
    extra.top = np.maximum(extra.floor + 2.5, extra.top - 0.3)
    pitched(site.builder, extra, rise[wing] * 0.6, np.where(hip[wing] > 0, extra.width / 2, 0.0))
    return plots


def sheds(site: Site, spots: Array, angle: Array) -> None:
    """Garages and garden sheds."""
    n = len(spots)
    if not n:
        return
    rng = site.rng
    plots = site.plots(
        spots,
        angle,
        rng.uniform(3, 6, n),
        rng.uniform(2.4, 3.6, n),
        2.3,
        m.WALL_PLAIN,
        site.choose(PLASTER, n),
        m.ROOF_PLAIN,
        site.choose(FLAT_ROOF, n),
    )
    pitched(site.builder, plots, plots.width * 0.22, np.zeros(n), overhang=0.2)
