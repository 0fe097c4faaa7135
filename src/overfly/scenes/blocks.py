"""A dense inner city: blocks of town houses round courtyards, towers, squares, parks."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from overfly.scenes import materials as m
from overfly.scenes.builder import Array
from overfly.scenes.buildings import chimneys, flat, pitched, roof_boxes
from overfly.scenes.cover import along
from overfly.scenes.site import BRICK, FLAT_ROOF, PLASTER, TILE, Site
from overfly.scenes.streets import cells, street_grid
from overfly.scenes.vegetation import scatter

FLAT_KINDS = np.array([m.ROOF_GRAVEL, m.ROOF_PLAIN, m.ROOF_PLAIN, m.ROOF_GREEN])
WALLS = np.array([m.WALL_WINDOWS, m.WALL_WINDOWS, m.WALL_WINDOWS, m.WALL_RIBBON, m.WALL_BRICK])


def _city_houses(site: Site, rows: list[tuple[float, float, float, float, float]]) -> None:
    """Town houses from (x, y, turn, length, depth) in layout coordinates: flat or pitched, each of its own height."""
    if not rows:
        return
    rng = site.rng
    data = np.array(rows)
    n = len(data)
    centre = site.world(data[:, :2])
    keep = site.inner(centre, 8)
    data, centre, n = data[keep], centre[keep], int(keep.sum())
    storeys = np.clip(rng.normal(5, 1.2, n).round(), 3, 8)
    brick = rng.random(n) < 0.25
    colors = np.where(brick[:, None], site.choose(BRICK, n), site.choose(PLASTER, n))
    wall = np.where(brick, m.WALL_BRICK, WALLS[rng.integers(0, 4, n)])
    is_flat = rng.random(n) < 0.5
    roof = np.where(
        is_flat, FLAT_KINDS[rng.integers(0, 4, n)], np.where(rng.random(n) < 0.8, m.ROOF_TILES, m.ROOF_METAL)
    )
    roof_color = np.where(is_flat[:, None], site.choose(FLAT_ROOF, n), site.choose(TILE, n))
    roof_color[roof == m.ROOF_GREEN] = (0.10, 0.13, 0.05)
    plots = site.plots(
        centre, data[:, 2] + site.heading, data[:, 3], data[:, 4], storeys * 3.1, wall, colors, roof, roof_color
    )
    flat(site.builder, plots[is_flat], parapet=rng.uniform(0.4, 1.0, int(is_flat.sum())))
    roof_boxes(site.builder, plots[is_flat], rng, 1 / 60)
    steep = plots[~is_flat]
    rise = steep.width * rng.uniform(0.28, 0.45, len(steep))
    pitched(site.builder, steep, rise, np.zeros(len(steep)), overhang=0.25, pitch_m=0.35)
    for _ in range(2):
        chimneys(site.builder, steep, rise, rng)


def _perimeter(rng: np.random.Generator, low: Array, high: Array) -> list[tuple[float, float, float, float, float]]:
    """Houses round a courtyard."""
    rows = []
    depth = float(rng.uniform(10.5, 13.5))
    width, height = high - low
    for side in range(4):
        horizontal = side % 2 == 0
        length = (width if horizontal else height - 2 * depth) + (0 if horizontal else 0.1)
        count = max(1, round(length / rng.uniform(14, 24)))
        edges = np.linspace(0, length, count + 1)
        edges[1:-1] += rng.uniform(-3, 3, count - 1)
        for a, b in pairwise(edges):
            if rng.random() < 0.05:
                continue  # a gap, a gateway
            at = (a + b) / 2
            if horizontal:
                y = low[1] + depth / 2 if side == 0 else high[1] - depth / 2
                rows.append((low[0] + at, y, 0.0 if side == 0 else np.pi, b - a, depth))
            else:
                x = high[0] - depth / 2 if side == 1 else low[0] + depth / 2
                rows.append((x, low[1] + depth + at, np.pi / 2 if side == 1 else -np.pi / 2, b - a, depth))
    return rows


def blocks(site: Site) -> None:
    """A dense inner city: perimeter blocks with courtyards, towers, squares and parks."""
    rng, painter = site.rng, site.painter
    xs, ys, lines = street_grid(site, (68, 105), (62, 90), (4.5, 5.5, 7.5))
    houses: list[tuple[float, float, float, float, float]] = []
    towers: list[tuple[Array, float, float, float]] = []
    for low, high in cells(xs, ys, site, 10.5, -20):
        middle, size = (low + high) / 2, high - low
        odds = rng.random()
        centre = site.world(middle)
        if odds < 0.68:
            houses += _perimeter(rng, low, high)
            yard = size - 28
            if (yard > 6).all():
                painter.area(
                    centre, site.heading, yard, int(rng.choice([m.GARDEN, m.LAWN, m.PAVING, m.ASPHALT, m.GRAVEL]))
                )
                spots = site.world(scatter(rng, middle - yard / 2, middle + yard / 2, 9))
                site.plant(spots[rng.random(len(spots)) < 0.5], (5, 12), conifers=0.05)
                if (yard > 16).all():
                    shed = float(rng.uniform(8, 14))
                    houses.append((middle[0], middle[1], float(rng.choice([0, np.pi / 2])), shed, 7.0))
        elif odds < 0.84:
            foot = np.minimum(size * 0.5, rng.uniform(20, 30, 2))
            tall = float(rng.choice([rng.uniform(24, 40), rng.uniform(40, 75)]))
            towers.append((middle, foot[0], foot[1], tall))
            base = size * [0.86, 0.8]
            if rng.random() < 0.5:
                towers.append((middle, base[0], base[1], float(rng.uniform(5, 11))))
            else:
                spots = site.world(scatter(rng, low, high, 11))
                site.take(centre, site.heading, foot[0] + 4, foot[1] + 4)
                site.plant(spots[rng.random(len(spots)) < 0.5], (5, 9), conifers=0)
        elif odds < 0.93:
            painter.area(centre, site.heading, size + 4, m.LAWN)
            painter.path(site.world([low, high]), 2.5, m.GRAVEL)
            painter.path(site.world([(low[0], high[1]), (high[0], low[1])]), 2.5, m.GRAVEL)
            spots = site.world(scatter(rng, low, high, 9))
            site.plant(spots[painter.kind_at(spots) == m.LAWN], (8, 18), conifers=0.1)
        else:
            site.parking(centre, size - 1.5, 0.7)
    _city_houses(site, houses)
    _towers(site, towers)
    for line in lines:
        site.park(line, 3.6, 0.45)
        for side in (-1, 1):
            xy, angle = along(line, 13, float(rng.uniform(0, 13)))
            spots = xy + side * 8.6 * np.stack([-np.sin(angle), np.cos(angle)], -1)
            site.plant(spots[rng.random(len(spots)) < 0.5], (6, 11), conifers=0, margin=0.5)


def _towers(site: Site, towers: list[tuple[Array, float, float, float]]) -> None:
    if not towers:
        return
    rng, n = site.rng, len(towers)
    centre = site.world([t[0] for t in towers])
    keep = site.inner(centre, 14)
    length, width, height = (np.array([t[i] for t in towers]) for i in (1, 2, 3))
    centre, length, width, height, n = centre[keep], length[keep], width[keep], height[keep], int(keep.sum())
    wall = rng.choice([m.WALL_GLASS, m.WALL_RIBBON, m.WALL_WINDOWS], n)
    roof = rng.choice([m.ROOF_GRAVEL, m.ROOF_PLAIN], n)
    plots = site.plots(
        centre,
        np.full(n, site.heading),
        length,
        width,
        height,
        wall,
        site.choose(PLASTER, n),
        roof,
        site.choose(FLAT_ROOF, n),
    )
    flat(site.builder, plots, parapet=1.1, storey=3.4, bay=3.6)
    roof_boxes(site.builder, plots, rng, 1 / 45)
