"""Loose styles: a suburb, a hilly village, woods and meadows."""

from __future__ import annotations

import numpy as np

from overfly.scenes import materials as m
from overfly.scenes.buildings import Plots, chimneys, flat, pitched
from overfly.scenes.builder import Array, boxes
from overfly.scenes.cover import along
from overfly.scenes.site import BRICK, FLAT_ROOF, PLASTER, TILE, Site
from overfly.scenes.terrain import Relief
from overfly.scenes.vehicles import cars


def _homes(site: Site, spots: list[tuple[Array, float, float, float]], *, steep: float, hips: float, storeys: tuple[int, int]) -> Plots:
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
    at = centre[wing] + normal * (side * width[wing] * 0.55)[:, None] + tangent * (rng.uniform(-0.2, 0.2, len(wing)) * length[wing])[:, None]
    extra = plots[wing]
    extra.centre, extra.angle = at, angle[wing] + np.pi / 2
    extra.length, extra.width = width[wing] * 0.9, width[wing] * 0.6
    extra.top = np.maximum(extra.floor + 2.5, extra.top - 0.3)
    pitched(site.builder, extra, rise[wing] * 0.6, np.where(hip[wing] > 0, extra.width / 2, 0.0))
    return plots


def _sheds(site: Site, spots: Array, angle: Array) -> None:
    """Garages and garden sheds."""
    n = len(spots)
    if not n:
        return
    rng = site.rng
    plots = site.plots(
        spots, angle, rng.uniform(3, 6, n), rng.uniform(2.4, 3.6, n), 2.3, m.WALL_PLAIN, site.choose(PLASTER, n), m.ROOF_PLAIN, site.choose(FLAT_ROOF, n)
    )
    pitched(site.builder, plots, plots.width * 0.22, np.zeros(n), overhang=0.2)


def suburb(site: Site) -> None:
    """Detached houses along bent streets, gardens with trees, hedges, pools, driveways."""
    rng, painter, reach = site.rng, site.painter, site.size_m * 0.75
    rows = np.arange(-reach, reach, 66.0) + rng.uniform(-20, 20)
    t = np.linspace(-reach, reach, int(reach / 6))
    bend, phase, wave = rng.uniform(6, 16), rng.uniform(0, 6.28), rng.uniform(180, 300)
    lines = [np.stack([t, y + bend * np.sin(t / wave * 2 * np.pi + phase)], -1) for y in rows]
    cross = np.arange(-reach, reach, 190.0) + rng.uniform(-60, 60)
    lanes = [np.stack([x + 0.4 * bend * np.sin(t / wave * 2 * np.pi), t], -1) for x in cross]
    lines, lanes = [site.world(line) for line in lines], [site.world(line) for line in lanes]
    for line in lines + lanes:
        painter.street(line, 3.2)
    spots: list[tuple[Array, float, float, float]] = []
    drives, sheds, turns = [], [], []
    for line in lines:
        for side in (-1, 1):
            xy, angle = along(line, 19.0, float(rng.uniform(0, 19)))
            for p, a in zip(xy, angle):
                length, width = rng.uniform(10, 15), rng.uniform(7.5, 10.5)
                back = rng.uniform(5.5, 8.5)
                turn = a + rng.normal(0, 0.04)
                normal = side * np.array([-np.sin(a), np.cos(a)])
                tangent = np.array([np.cos(a), np.sin(a)])
                centre = p + normal * (4.6 + back + width / 2)
                if site.inner(centre, 10) and painter.fits(centre, turn, length + 2, width + 2) and rng.random() < 0.93:
                    spots.append((centre, turn, length, width))
                    site.take(centre, turn, length, width, 1.0)
                    door = tangent * (length / 2 - 1.5) * rng.choice([-1, 1])
                    painter.path([p + door, centre + door], 3.0, int(rng.choice([m.ASPHALT, m.PAVING, m.GRAVEL])))
                    painter.area(centre + normal * (width / 2 + 6), turn, rng.uniform(12, 17), 9, int(rng.choice([m.LAWN, m.GARDEN, m.LAWN])))
                    if rng.random() < 0.5:
                        drives.append((*(p + door + normal * rng.uniform(6, 8)), a + np.pi / 2))
                    if rng.random() < 0.6:
                        sheds.append(centre + normal * (width / 2 + rng.uniform(5, 10)) + tangent * rng.uniform(-6, 6))
                        turns.append(turn)
    if spots:
        _homes(site, spots, steep=0.75, hips=0.4, storeys=(1, 2))
    fit = [i for i in range(len(sheds)) if site.inner(sheds[i], 5) and painter.free(sheds[i], 3.2)]
    _sheds(site, np.array([sheds[i] for i in fit]).reshape(-1, 2), np.array([turns[i] for i in fit]))
    if drives:
        d = np.array(drives)
        cars(site.builder, d[:, :2], d[:, 2], site.field(d[:, :2]), rng)
    for line in lines + lanes:
        site.park(line, 2.1, 0.10)
    _hedges(site, spots)
    trees = site.inside(9.5)
    site.plant(trees[rng.random(len(trees)) < 0.42], (4, 13), conifers=0.22)
    shrubs = site.inside(5.5)
    site.bushes(shrubs[rng.random(len(shrubs)) < 0.22])
    _pools(site, spots)


def _hedges(site: Site, spots: list[tuple[Array, float, float, float]]) -> None:
    """Clipped hedges between neighbours."""
    rng = site.rng
    chosen = [s for s in spots if rng.random() < 0.55]
    if not chosen:
        return
    n = len(chosen)
    angle = np.array([s[1] for s in chosen])
    tangent = np.stack([np.cos(angle), np.sin(angle)], -1)
    centre = np.array([s[0] for s in chosen]) + tangent * 9.3
    keep = site.painter.free(centre, 1.0)
    centre, angle, n = centre[keep], angle[keep], int(keep.sum())
    size = np.stack([np.full(n, 0.9), rng.uniform(9, 18, n), rng.uniform(1.2, 2.2, n)], -1)
    green = np.c_[np.tile([0.035, 0.07, 0.02], (n, 1)), rng.random(n)]
    boxes(site.builder, centre, angle, size, site.field(centre) - 0.4, green, material=m.FOLIAGE)


def _pools(site: Site, spots: list[tuple[Array, float, float, float]]) -> None:
    """A few swimming pools behind houses: a rim and water."""
    rng = site.rng
    for centre, angle, _, width in spots:
        if rng.random() > 0.10:
            continue
        at = centre + np.array([-np.sin(angle), np.cos(angle)]) * (width / 2 + 6.5) * rng.choice([-1, 1])
        if site.painter.fits(at, angle, 10, 6):
            z = site.field(at[None])
            boxes(site.builder, at[None], [angle], [(9.0, 5.2, 0.5)], z - 0.25, [(0.55, 0.52, 0.48, 0.3)])
            boxes(site.builder, at[None], [angle], [(7.8, 4.0, 0.5)], z - 0.22, [(0.10, 0.38, 0.45, 0.3)])


def _lane(rng: np.random.Generator, start: Array, turn: float, length: float, wild: float) -> Array:
    """A wandering line."""
    points, at, angle = [start], start, turn
    for _ in range(int(length / 14)):
        angle += rng.normal(0, wild)
        at = at + 14 * np.array([np.cos(angle), np.sin(angle)])
        points.append(at)
    return np.array(points)


def village(site: Site) -> None:
    """A hill village: winding lanes from a square, gabled houses, a church, barns; fields, orchards and woods around."""
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
            _lane(rng, centre, first + k * 2 * np.pi / 5 + rng.normal(0, 0.2), rng.uniform(150, 260), 0.16) for k in range(5)
        ]
        for line in lanes[:3]:
            branch = line[min(5, len(line) - 1)]
            away = np.arctan2(*(line[5] - line[4])[::-1]) + rng.choice([-1, 1]) * 1.3
            lanes.append(_lane(rng, branch, away, rng.uniform(70, 140), 0.14))
        painter.disc(centre, 16, m.PAVING)
        for line in lanes:
            painter.street(line, 2.6)
        lines += lanes
        site.take(centre + [0, 18], 0.3, 22, 10, 2.0)
        _church(site, centre + np.array([0, 18]))
    for line in lines:
        for side in (-1, 1):
            xy, angle = along(line, 16.5, 9 + float(rng.uniform(0, 8)))
            for i, (p, a) in enumerate(zip(xy, angle)):
                length, width = rng.uniform(9, 15), rng.uniform(7, 10)
                turn = a + rng.normal(0, 0.12) + (np.pi / 2 if rng.random() < 0.3 else 0)
                centre = p + side * np.array([-np.sin(a), np.cos(a)]) * (3 + rng.uniform(2, 6) + length / 2)
                if rng.random() < 0.9 - 0.025 * i and site.inner(centre, 10) and painter.fits(centre, turn, length + 2, width + 2):
                    spots.append((centre, turn, length, width))
                    painter.area(centre, turn, length + 13, width + 13, int(rng.choice([m.GARDEN, m.GARDEN, m.PAVING, m.GRAVEL])))
                    site.take(centre, turn, length, width, 1.0)
    if spots:
        plots = _homes(site, spots, steep=1.0, hips=0.15, storeys=(1, 2))
        beside = plots.centre + rng.choice([-1, 1], (len(plots), 1)) * np.stack([np.cos(plots.angle), np.sin(plots.angle)], -1) * (plots.length / 2 + 4.5)[:, None]
        free = site.inner(beside, 6) & painter.free(beside, 3.0) & (rng.random(len(beside)) < 0.5)
        _sheds(site, beside[free], plots.angle[free])
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
    tower = site.plots([at], [0.3], [6.0], [6.0], [20.0 + rng.uniform(0, 6)], m.WALL_PLAIN, PLASTER[1:2], m.ROOF_METAL, TILE[4:5])
    pitched(site.builder, tower, np.array([10.0]), np.array([2.95]), overhang=0.3)


def _barns(site: Site, count: int) -> None:
    rng = site.rng
    for _ in range(count * max(1, round(site.size_m**2 / 250_000))):
        centre, angle = rng.uniform(-0.45, 0.45, 2) * site.size_m, rng.uniform(0, np.pi)
        length, width = rng.uniform(18, 32), rng.uniform(10, 14)
        if site.inner(centre, 20) and site.painter.fits(centre, angle, length + 4, width + 4):
            site.painter.area(centre, angle, length + 16, width + 16, m.GRAVEL)
            barn = site.plots([centre], [angle], [length], [width], [5.0], m.WALL_METAL, [(0.28, 0.20, 0.14)], m.ROOF_METAL, [(0.34, 0.30, 0.28)])
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
    table = rng.choice([m.CROP, m.PLOUGHED, m.RIPE, m.LAWN, m.MEADOW], (97,), p=[0.26 * share / 0.75, 0.2, 0.2, 0.1, 0.5 - 0.26 * share / 0.75])
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
    track = _lane(rng, np.array([-half - 20, rng.uniform(-0.5, 0.5) * half]), rng.normal(0, 0.3), site.size_m * 1.3, 0.13)
    noise = Relief(rng, site.size_m, 2.0)
    _woods(site, noise, threshold=0.05, spacing=5.2)
    painter.path(track, 3.0, m.DIRT)
    lone = site.inside(24)
    on_meadow = painter.kind_at(lone) == m.MEADOW
    site.plant(lone[on_meadow & (rng.random(len(lone)) < 0.22)], (4, 13), conifers=0.2)
    shrubs = site.inside(10)
    site.bushes(shrubs[(painter.kind_at(shrubs) == m.MEADOW) & (rng.random(len(shrubs)) < 0.10)])
    _barns(site, 1)
