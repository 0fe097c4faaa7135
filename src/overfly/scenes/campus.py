"""A campus: large buildings with wings on lawns, paths, covered walkways, car parks."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from overfly.scenes import materials as m
from overfly.scenes.builder import Array
from overfly.scenes.buildings import flat, roof_boxes, solar
from overfly.scenes.cover import along
from overfly.scenes.site import BRICK, FLAT_ROOF, PLASTER, Site
from overfly.scenes.streets import cells, street_grid


def campus(site: Site) -> None:
    """Large buildings with wings on lawns, joined by footpaths and covered walkways; car parks and a sports ground."""
    rng, painter = site.rng, site.painter
    xs, ys, lines = street_grid(site, (120, 165), (120, 165), (3.5, 4.0))
    parts: list[tuple[Array, float, float, float, float, int]] = []
    for low, high in cells(xs, ys, site, 8, -30):
        middle = (low + high) / 2
        halves = [(low, np.array([middle[0], high[1]])), (np.array([middle[0], low[1]]), high)]
        doors: list[Array] = []
        for a, b in halves:
            for part in range(2):
                c = np.array([a[0], a[1] + part * (b[1] - a[1]) / 2])
                d = np.array([b[0], c[1] + (b[1] - a[1]) / 2])
                at, room = (c + d) / 2, d - c
                odds = rng.random()
                if odds < 0.72:
                    doors.append(at)
                    parts += _college(rng, at, room * 0.72)
                elif odds < 0.80:
                    site.parking(site.world(at), room * 0.8, 0.55)
                elif odds < 0.88:
                    painter.area(site.world(at), site.heading, room * 0.85, int(rng.choice([m.LAWN, m.DIRT])))
        for start, end in zip(doors, doors[1:] + doors[:1]):
            painter.path(site.world([start, end]), 3.0, m.PAVING)
            painter.path(site.world(np.array([start, (start[0], low[1] - 4)])), 2.4, m.PAVING)
        for start, end in pairwise(doors):
            if rng.random() < 0.75:
                site.walkway(site.world(start), site.world(end))
    if parts:
        n = len(parts)
        centre = site.world([p[0] for p in parts])
        length, width, height, turn = (np.array([p[i] for p in parts]) for i in (1, 2, 3, 4))
        keep = site.inner(centre, 12) & site.fits(centre, turn + site.heading, length, width)
        length, width, height, turn = length[keep], width[keep], height[keep], turn[keep]
        group = np.array([p[5] for p in parts])[keep]
        centre, n = centre[keep], int(keep.sum())
        shade = rng.random(1000)[group % 1000]
        wall = np.array([m.WALL_RIBBON, m.WALL_GLASS, m.WALL_WINDOWS, m.WALL_BRICK])[(shade * 4).astype(int)]
        palette = np.concatenate([PLASTER[:2], BRICK[:2], FLAT_ROOF[:1]])
        color = palette[(shade * 997).astype(int) % len(palette)]
        roof = np.array([m.ROOF_GRAVEL, m.ROOF_PLAIN, m.ROOF_GREEN])[(shade * 331).astype(int) % 3]
        roof_color = np.where((roof == m.ROOF_GREEN)[:, None], [0.10, 0.13, 0.05], site.choose(FLAT_ROOF, n))
        plots = site.plots(centre, turn + site.heading, length, width, height, wall, color, roof, roof_color)
        flat(site.builder, plots, parapet=0.8, storey=3.6, bay=3.4)
        roof_boxes(site.builder, plots, rng, 1 / 90)
        panels = rng.random(n) < 0.2
        solar(site.builder, plots[panels], rng)
    for line in lines:
        site.park(line, 2.6, 0.15)
        for side in (-1, 1):
            xy, angle = along(line, 11)
            site.plant(xy + side * 8.0 * np.stack([-np.sin(angle), np.cos(angle)], -1), (7, 14), conifers=0)
    spots = site.inside(13)
    on_lawn = spots[(painter.kind_at(spots) == m.LAWN) & (rng.random(len(spots)) < 0.6)]
    site.plant(on_lawn, (5, 17), conifers=0.2)
    spots = site.inside(9)
    site.bushes(spots[(painter.kind_at(spots) == m.LAWN) & (rng.random(len(spots)) < 0.10)])


def _college(rng: np.random.Generator, at: Array, room: Array) -> list[tuple[Array, float, float, float, float, int]]:
    """A building of one to four wings: slab, L, U or a closed court."""
    form = int(rng.integers(0, 4))
    depth = float(rng.uniform(13, 18))
    height = float(rng.integers(2, 6)) * 3.6
    group = int(rng.integers(0, 1_000_000))
    a, b = room / 2
    wings = [(np.array([0.0, -b + depth / 2]), 2 * a, depth, height, 0.0, group)]
    if form >= 1:
        wings.append(
            (
                np.array([-a + depth / 2, depth / 2]),
                2 * b - depth,
                depth,
                height - 3.6 * (rng.random() < 0.5),
                np.pi / 2,
                group,
            )
        )
    if form >= 2:
        wings.append((np.array([a - depth / 2, depth / 2]), 2 * b - depth, depth, height, np.pi / 2, group))
    if form == 3:
        wings.append((np.array([0.0, b - depth / 2]), 2 * a - 2 * depth, depth, height - 3.6, 0.0, group))
    quarter = float(rng.choice([0, np.pi]))
    c, s = np.cos(quarter), np.sin(quarter)
    return [
        (at + np.array([w[0][0] * c - w[0][1] * s, w[0][0] * s + w[0][1] * c]), *w[1:4], w[4] + quarter, w[5])
        for w in wings
    ]
