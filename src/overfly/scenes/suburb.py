"""A suburb: detached houses along bent streets, gardens, hedges, pools."""

from __future__ import annotations

import numpy as np

from overfly.scenes import materials as m
from overfly.scenes.builder import Array, boxes
from overfly.scenes.cover import along
from overfly.scenes.homes import homes, sheds
from overfly.scenes.site import Site
from overfly.scenes.vehicles import cars


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
    drives, huts, turns = [], [], []
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
                    painter.area(
                        centre + normal * (width / 2 + 6),
                        turn,
                        (rng.uniform(12, 17), 9),
                        int(rng.choice([m.LAWN, m.GARDEN, m.LAWN])),
                    )
                    if rng.random() < 0.5:
                        drives.append((*(p + door + normal * rng.uniform(6, 8)), a + np.pi / 2))
                    if rng.random() < 0.6:
                        huts.append(centre + normal * (width / 2 + rng.uniform(5, 10)) + tangent * rng.uniform(-6, 6))
                        turns.append(turn)
    if spots:
        homes(site, spots, steep=0.75, hips=0.4, storeys=(1, 2))
    fit = [i for i in range(len(huts)) if site.inner(huts[i], 5) and painter.free(huts[i], 3.2)]
    sheds(site, np.array([huts[i] for i in fit]).reshape(-1, 2), np.array([turns[i] for i in fit]))
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
