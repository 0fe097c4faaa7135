"""A hill village among fields and woods, and plain woods and meadows."""

from __future__ import annotations

import numpy as np

from overfly.scenes import materials as m
from overfly.scenes.builder import Array
from overfly.scenes.buildings import pitched
from overfly.scenes.cover import along
from overfly.scenes.homes import homes, sheds
from overfly.scenes.site import PLASTER, TILE, Site
from overfly.scenes.terrain import Relief


def _lane(rng: np.random.Generator, start: Array, turn: float, length: float, wild: float) -> Array:
    """A wandering line."""
    points, at, angle = [start], start, turn
    for _ in range(int(length / 14)):
        angle += rng.normal(0, wild)
        at = at + 14 * np.array([np.cos(angle), np.sin(angle)])
        points.append(at)
    return np.array(points)


def village(site: Site) -> None:
    """A hill village: winding lanes from a square, gabled houses, a church; barns, fields, orchards, woods."""
    rng, painter = site.rng, site.painter
    _fields(site, Relief(rng, site.size_m, 2.0), share=0.75)
    spots: list[tuple[Array, float, float, float]] = []
    lines: list[Array] = []
    centres = [rng.uniform(-0.12, 0.12, 2) * min(site.size_m, 500)]
    if site.size_m > 800:  # more villages in a larger landscape
        centres += list(rng.uniform(-0.42, 0.42, (round(site.size_m**2 / 400_000), 2)) * site.size_m)
    for centre in centres:
        first = rng.uniform(0, 2 * np.pi)
        lanes = [
            _lane(rng, centre, first + k * 2 * np.pi / 5 + rng.normal(0, 0.2), rng.uniform(150, 260), 0.16)
            for k in range(5)
        ]
        for line in lanes[:3]:
            branch = line[min(5, len(line) - 1)]
            away = np.arctan2(*(line[5] - line[4])[::-1]) + rng.choice([-1, 1]) * 1.3
            lanes.append(_lane(rng, branch, away, rng.uniform(70, 140), 0.14))
        painter.disc(centre, 16, m.PAVING)
        for line in lanes:
            painter.street(line, 2.6)
        lines += lanes
        site.take(centre + np.array([0, 18]), 0.3, 22, 10, 2.0)
        _church(site, centre + np.array([0, 18]))
    for line in lines:
        for side in (-1, 1):
            xy, angle = along(line, 16.5, 9 + float(rng.uniform(0, 8)))
            for i, (p, a) in enumerate(zip(xy, angle)):
                length, width = rng.uniform(9, 15), rng.uniform(7, 10)
                turn = a + rng.normal(0, 0.12) + (np.pi / 2 if rng.random() < 0.3 else 0)
                centre = p + side * np.array([-np.sin(a), np.cos(a)]) * (3 + rng.uniform(2, 6) + length / 2)
                if (
                    rng.random() < 0.9 - 0.025 * i
                    and site.inner(centre, 10)
                    and painter.fits(centre, turn, length + 2, width + 2)
                ):
                    spots.append((centre, turn, length, width))
                    painter.area(
                        centre,
                        turn,
                        (length + 13, width + 13),
                        int(rng.choice([m.GARDEN, m.GARDEN, m.PAVING, m.GRAVEL])),
                    )
                    site.take(centre, turn, length, width, 1.0)
    if spots:
        plots = homes(site, spots, steep=1.0, hips=0.15, storeys=(1, 2))
        beside = (
            plots.centre
            + rng.choice([-1, 1], (len(plots), 1))
            * np.stack([np.cos(plots.angle), np.sin(plots.angle)], -1)
            * (plots.length / 2 + 4.5)[:, None]
        )
        free = site.inner(beside, 6) & painter.free(beside, 3.0) & (rng.random(len(beside)) < 0.5)
        sheds(site, beside[free], plots.angle[free])
    for line in lines:
        site.park(line, 1.9, 0.05)
    _barns(site, 6)
    shrubs = site.inside(7)
    near = painter.kind_at(shrubs) == m.GARDEN
    site.bushes(shrubs[near & (rng.random(len(shrubs)) < 0.4)])
    site.plant(shrubs[near & (rng.random(len(shrubs)) < 0.30)], (3.5, 10), conifers=0.15)
    _woods(site, Relief(rng, site.size_m, 2.0), threshold=0.6, spacing=6.0)
    lone = site.inside(30)
    site.plant(lone[rng.random(len(lone)) < 0.3], (6, 15), conifers=0.1)


def _church(site: Site, centre: Array) -> None:
    rng = site.rng
    nave = site.plots([centre], [0.3], [22.0], [10.0], [8.0], m.WALL_WINDOWS, PLASTER[1:2], m.ROOF_TILES, TILE[:1])
    pitched(site.builder, nave, np.array([7.0]), np.array([0.0]), storey=8, bay=4)
    at = centre + np.array([np.cos(0.3), np.sin(0.3)]) * 13
    tower = site.plots(
        [at], [0.3], [6.0], [6.0], [20.0 + rng.uniform(0, 6)], m.WALL_PLAIN, PLASTER[1:2], m.ROOF_METAL, TILE[4:5]
    )
    pitched(site.builder, tower, np.array([10.0]), np.array([2.95]), overhang=0.3)


def _barns(site: Site, count: int) -> None:
    rng = site.rng
    for _ in range(count * max(1, round(site.size_m**2 / 250_000))):
        centre, angle = rng.uniform(-0.45, 0.45, 2) * site.size_m, rng.uniform(0, np.pi)
        length, width = rng.uniform(18, 32), rng.uniform(10, 14)
        if site.inner(centre, 20) and site.painter.fits(centre, angle, length + 4, width + 4):
            site.painter.area(centre, angle, (length + 16, width + 16), m.GRAVEL)
            barn = site.plots(
                [centre],
                [angle],
                [length],
                [width],
                [5.0],
                m.WALL_METAL,
                [(0.28, 0.20, 0.14)],
                m.ROOF_METAL,
                [(0.34, 0.30, 0.28)],
            )
            pitched(site.builder, barn, barn.width * 0.22, np.zeros(1), pitch_m=0.6)


def _fields(site: Site, noise: Relief, share: float) -> None:
    """Fields in strips across the layout, with crops, bare soil and meadow."""
    rng, painter = site.rng, site.painter
    xy = painter.grid()
    c, s = np.cos(painter.heading), np.sin(painter.heading)
    u = xy[..., 0] * c + xy[..., 1] * s
    v = xy[..., 1] * c - xy[..., 0] * s
    bent = v + 12 * noise(xy[::4, ::4]).repeat(4, 0).repeat(4, 1)[: v.shape[0], : v.shape[1]]
    row = np.floor(bent / 85).astype(int)
    col = np.floor((u + 37 * row) / 60).astype(int)
    table = rng.choice(
        [m.CROP, m.PLOUGHED, m.RIPE, m.LAWN, m.MEADOW],
        (97,),
        p=[0.26 * share / 0.75, 0.2, 0.2, 0.1, 0.5 - 0.26 * share / 0.75],
    )
    kind = table[(row * 31 + col * 17) % 97].astype(np.uint8)
    dry = painter.kind != m.WATER
    painter.kind[dry] = kind[dry]


def _woods(site: Site, noise: Relief, threshold: float, spacing: float, conifers: float = 0.45) -> None:
    """Forest where a slow noise is above a threshold."""
    painter, rng = site.painter, site.rng
    coarse = painter.grid()[::4, ::4]
    value = noise(coarse).repeat(4, 0).repeat(4, 1)[: len(painter.kind), : len(painter.kind)]
    open_ground = np.isin(painter.kind, [m.MEADOW, m.CROP, m.PLOUGHED, m.LAWN, m.RIPE]) & ~painter.taken
    wood = open_ground & (value > threshold)
    painter.where(wood, m.FOREST_FLOOR)
    spots = site.inside(spacing)
    spots = spots[(painter.kind_at(spots) == m.FOREST_FLOOR) & (rng.random(len(spots)) < 0.93)]
    patch = np.clip(0.5 + 0.35 * (noise(spots * 1.7 + 300)), 0, 1)
    pines = rng.random(len(spots)) < np.where(patch > 0.5, conifers * 1.6, conifers * 0.3)
    site.plant(spots[pines], (12, 21), conifers=1.0, trunks=False, margin=0.8)
    site.plant(spots[~pines], (9, 18), conifers=0.0, trunks=False, margin=0.8, slim=0.30)


def vegetation(site: Site) -> None:
    """Forest and meadow on slopes: hardly anything built, hardly any corner."""
    rng, painter = site.rng, site.painter
    half = site.size_m / 2
    track = _lane(
        rng, np.array([-half - 20, rng.uniform(-0.5, 0.5) * half]), rng.normal(0, 0.3), site.size_m * 1.3, 0.13
    )
    noise = Relief(rng, site.size_m, 2.0)
    _woods(site, noise, threshold=0.05, spacing=5.2)
    painter.path(track, 3.0, m.DIRT)
    lone = site.inside(24)
    on_meadow = painter.kind_at(lone) == m.MEADOW
    site.plant(lone[on_meadow & (rng.random(len(lone)) < 0.22)], (4, 13), conifers=0.2)
    shrubs = site.inside(10)
    site.bushes(shrubs[(painter.kind_at(shrubs) == m.MEADOW) & (rng.random(len(shrubs)) < 0.10)])
    _barns(site, 1)
