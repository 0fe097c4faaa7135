"""Dense styles: inner-city blocks, a campus, an industrial estate."""

from __future__ import annotations

import numpy as np

from overfly.scenes import materials as m
from overfly.scenes.buildings import Plots, chimneys, flat, pitched, roof_boxes, solar
from overfly.scenes.builder import Array, lifted, turned
from overfly.scenes.builder import cylinders
from overfly.scenes.cover import along
from overfly.scenes.site import BRICK, FLAT_ROOF, PLASTER, TILE, Site, street_grid
from overfly.scenes.vegetation import scatter
from overfly.scenes.vehicles import cars, containers, lorries

FLAT_KINDS = np.array([m.ROOF_GRAVEL, m.ROOF_PLAIN, m.ROOF_PLAIN, m.ROOF_GREEN])
WALLS = np.array([m.WALL_WINDOWS, m.WALL_WINDOWS, m.WALL_WINDOWS, m.WALL_RIBBON, m.WALL_BRICK])


def _cells(xs: Array, ys: Array, site: Site, inset: float, margin: float) -> list[tuple[Array, Array]]:
    """The blocks between streets whose middle lies in the landscape: low and high corner in layout coordinates."""
    cells = []
    for x0, x1 in zip(xs[:-1], xs[1:]):
        for y0, y1 in zip(ys[:-1], ys[1:]):
            low, high = np.array([x0 + inset, y0 + inset]), np.array([x1 - inset, y1 - inset])
            middle = site.world((low + high) / 2)
            if (high - low > 18).all() and np.abs(middle).max() < site.size_m / 2 - margin:
                cells.append((low, high))
    return cells


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
    roof = np.where(is_flat, FLAT_KINDS[rng.integers(0, 4, n)], np.where(rng.random(n) < 0.8, m.ROOF_TILES, m.ROOF_METAL))
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
        for a, b in zip(edges[:-1], edges[1:]):
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
    for low, high in _cells(xs, ys, site, 10.5, -20):
        middle, size = (low + high) / 2, high - low
        odds = rng.random()
        centre = site.world(middle)
        if odds < 0.68:
            houses += _perimeter(rng, low, high)
            yard = size - 28
            if (yard > 6).all():
                painter.area(centre, site.heading, *yard, int(rng.choice([m.GARDEN, m.LAWN, m.PAVING, m.ASPHALT, m.GRAVEL])))
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
            painter.area(centre, site.heading, *(size + 4), m.LAWN)
            painter.path(site.world([low, high]), 2.5, m.GRAVEL)
            painter.path(site.world([(low[0], high[1]), (high[0], low[1])]), 2.5, m.GRAVEL)
            spots = site.world(scatter(rng, low, high, 9))
            site.plant(spots[painter.kind_at(spots) == m.LAWN], (8, 18), conifers=0.1)
        else:
            site.parking(centre, *size, 0.7)
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
        centre, np.full(n, site.heading), length, width, height, wall, site.choose(PLASTER, n), roof, site.choose(FLAT_ROOF, n)
    )
    flat(site.builder, plots, parapet=1.1, storey=3.4, bay=3.6)
    roof_boxes(site.builder, plots, rng, 1 / 45)


def campus(site: Site) -> None:
    """Large buildings with wings on lawns, joined by footpaths and covered walkways; car parks and a sports ground."""
    rng, painter = site.rng, site.painter
    xs, ys, lines = street_grid(site, (120, 165), (120, 165), (3.5, 4.0))
    parts: list[tuple[Array, float, float, float, float, int]] = []
    for low, high in _cells(xs, ys, site, 8, -30):
        middle, size = (low + high) / 2, high - low
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
                    site.parking(site.world(at), *(room * 0.8), 0.55)
                elif odds < 0.88:
                    painter.area(site.world(at), site.heading, *(room * 0.85), int(rng.choice([m.LAWN, m.DIRT])))
        for start, end in zip(doors, doors[1:] + doors[:1]):
            painter.path(site.world([start, end]), 3.0, m.PAVING)
            painter.path(site.world([start, (start[0], low[1] - 4)]), 2.4, m.PAVING)
        for start, end in zip(doors[:-1], doors[1:]):
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
        wings.append((np.array([-a + depth / 2, depth / 2]), 2 * b - depth, depth, height - 3.6 * (rng.random() < 0.5), np.pi / 2, group))
    if form >= 2:
        wings.append((np.array([a - depth / 2, depth / 2]), 2 * b - depth, depth, height, np.pi / 2, group))
    if form == 3:
        wings.append((np.array([0.0, b - depth / 2]), 2 * a - 2 * depth, depth, height - 3.6, 0.0, group))
    quarter = float(rng.choice([0, np.pi]))
    c, s = np.cos(quarter), np.sin(quarter)
    return [(at + np.array([w[0][0] * c - w[0][1] * s, w[0][0] * s + w[0][1] * c]), *w[1:4], w[4] + quarter, w[5]) for w in wings]


def industrial(site: Site) -> None:
    """Halls with flat, low-pitched and saw-tooth roofs, tanks, containers, yards, a siding."""
    rng, painter = site.rng, site.painter
    xs, ys, lines = street_grid(site, (130, 190), (90, 140), (4.0, 5.0))
    reach = site.size_m
    siding = site.world([(-reach, ys[len(ys) // 2] + 20), (reach, ys[len(ys) // 2] + 20)])
    halls: list[tuple[Array, float, float, float, int]] = []
    for low, high in _cells(xs, ys, site, 9, -30):
        middle, size = (low + high) / 2, high - low
        odds = rng.random()
        centre = site.world(middle)
        if odds < 0.60:
            count = int(rng.integers(1, 4))
            for i in range(count):
                room = np.array([size[0] / count - 10, size[1] * rng.uniform(0.55, 0.85)])
                at = np.array([low[0] + (i + 0.5) * size[0] / count, middle[1] + rng.uniform(-0.06, 0.06) * size[1]])
                if min(room) > 12:
                    halls.append((at, room[0], room[1], float(rng.uniform(6.5, 14)), int(rng.integers(0, 4))))
        elif odds < 0.74:
            _tank_farm(site, low, high)
        elif odds < 0.88:
            painter.area(centre, site.heading, *(size * 0.95), int(rng.choice([m.GRAVEL, m.ASPHALT])), take=False)
            x, y = np.meshgrid(np.arange(low[0] + 10, high[0] - 8, 13.5), np.arange(low[1] + 6, high[1] - 4, 3.0))
            rows = np.stack([x.ravel(), y.ravel()], -1)
            lane = (np.arange(len(rows)) // x.shape[1]) % 6 < 4
            used = lane & (rng.random(len(rows)) < 0.6)
            spots = site.world(rows[used])
            spots = spots[site.inner(spots, 7)]
            containers(site.builder, spots, np.full(len(spots), site.heading), site.field(spots), rng)
            site.take(centre, site.heading, *size)
        else:
            site.parking(centre, *(size * 0.9), 0.6)
    _halls(site, halls)
    painter.path(siding, 5.5, m.TRACK)
    for line in lines:
        for side in (-1, 1):
            xy, angle = along(line, 9)
            verge = xy + side * 7.5 * np.stack([-np.sin(angle), np.cos(angle)], -1)
            painter.path(verge[:: max(1, len(verge) - 1)], 3.0, m.MEADOW)
            site.plant(verge[rng.random(len(verge)) < 0.3], (5, 11), conifers=0.1)
            lane = xy + side * 2.0 * np.stack([-np.sin(angle), np.cos(angle)], -1)
            used = site.inner(lane, 8) & (rng.random(len(lane)) < 0.03)
            cars(site.builder, lane[used], angle[used] + (side > 0) * np.pi, site.field(lane[used]), rng)
    spots = site.inside(22)
    spots = spots[painter.free(spots, 9) & (rng.random(len(spots)) < 0.25)]
    lorries(site.builder, spots, np.full(len(spots), site.heading + np.pi / 2), site.field(spots), rng)


def _halls(site: Site, halls: list[tuple[Array, float, float, float, int]]) -> None:
    if not halls:
        return
    rng = site.rng
    centre = site.world([h[0] for h in halls])
    length, width, height, form = (np.array([h[i] for h in halls]) for i in (1, 2, 3, 4))
    keep = site.inner(centre, 20) & site.fits(centre, np.full(len(halls), site.heading), length, width)
    centre, length, width, height, form = centre[keep], length[keep], width[keep], height[keep], form[keep]
    n = len(centre)
    metal = np.array([(0.55, 0.57, 0.58), (0.30, 0.36, 0.42), (0.62, 0.60, 0.54), (0.20, 0.24, 0.27), (0.45, 0.18, 0.12)])
    roof = np.where(form == 1, m.ROOF_METAL, rng.choice([m.ROOF_PLAIN, m.ROOF_GRAVEL, m.ROOF_METAL], n))
    wall = np.where(rng.random(n) < 0.75, m.WALL_METAL, m.WALL_BRICK)
    plots = site.plots(
        centre, np.full(n, site.heading), length, width, height, wall, site.choose(metal, n), roof, site.choose(FLAT_ROOF, n)
    )
    level = (form == 0) | (form == 2)
    flat(site.builder, plots[level], parapet=0.4, storey=5, bay=6)
    roof_boxes(site.builder, plots[level], rng, 1 / 110)
    gable = plots[form == 1]
    pitched(site.builder, gable, gable.width * 0.09, np.zeros(len(gable)), overhang=0.2, storey=5, bay=6, pitch_m=0.5)
    _sawtooth(site, plots[form == 3])


def _sawtooth(site: Site, plots: Plots) -> None:
    """Halls whose roof is a row of sheds with glass towards one side."""
    flat(site.builder, plots, parapet=0.05, storey=5, bay=6)
    for i in range(len(plots)):
        count = max(2, round(plots.length[i] / 8.5))
        step, half, rise, z = plots.length[i] / count, plots.width[i] / 2 - 0.4, 3.0, plots.top[i] + 0.05
        x = np.arange(count) * step - plots.length[i] / 2
        pick = np.full(count, i)

        def place(local: list[tuple[Array | float, float]], height: list[float], pick: Array = pick, z: float = z) -> Array:
            xy = np.stack([np.stack(np.broadcast_arrays(a, b), -1) for a, b in local], 1)
            return lifted(turned(xy, plots.angle[pick], plots.centre[pick]), z + np.array(height))

        a, b = x + 0.3, x + step - 0.05
        slope = place([(a, -half), (b, -half), (b, half), (a, half)], [0.0, rise, rise, 0.0])
        glass = place([(b, -half), (b, half), (b, half), (b, -half)], [0.0, 0.0, rise, rise])
        ends = np.concatenate([place([(a, -half), (b, -half), (b, -half)], [0, 0, rise]), place([(b, half), (a, half), (b, half)], [0, 0, rise])])
        along_ridge = (np.cos(plots.angle[i]), np.sin(plots.angle[i]), 0.6, 0)
        site.builder.polygons(slope, m.ROOF_METAL, plots.roof_paint[i], along_ridge)
        start = -half * 1.0
        site.builder.polygons(glass, m.WALL_GLASS, plots.wall_paint[i], (start, z, rise, 1.6))
        site.builder.polygons(ends, m.WALL_PLAIN, plots.wall_paint[i], (0, z, 3, 3))


def _tank_farm(site: Site, low: Array, high: Array) -> None:
    """Round tanks on gravel, a chimney."""
    rng = site.rng
    size = high - low
    site.painter.area(site.world((low + high) / 2), site.heading, *size, m.GRAVEL)
    pitch = float(rng.uniform(17, 27))
    x, y = np.meshgrid(np.arange(low[0] + pitch / 2, high[0] - 4, pitch), np.arange(low[1] + pitch / 2, high[1] - 4, pitch))
    xy = site.world(np.stack([x.ravel(), y.ravel()], -1))
    xy = xy[site.inner(xy, 12) & site.painter.free(xy, 11) & (rng.random(len(xy)) < 0.8)]
    n = len(xy)
    if not n:
        return
    radius = pitch * rng.uniform(0.28, 0.42, n)
    ground = site.field(xy)
    pale = rng.uniform(0.5, 0.72, n)
    paint = np.c_[pale, pale, pale * 0.97, rng.random(n)]
    cylinders(site.builder, xy, radius, ground - 1, ground + rng.uniform(6, 14, n), paint, sides=28, cone=0.16)
    for i in range(n):
        site.painter.disc(xy[i], radius[i] + 1, m.GRAVEL, take=True)
    stack = site.world(low + 5)[None]
    if site.inner(stack, 5).all():
        cylinders(site.builder, stack, [1.9], site.field(stack) - 1, site.field(stack) + rng.uniform(25, 50), [(0.42, 0.25, 0.19, 0.5)], top=0.6)
