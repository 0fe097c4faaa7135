"""An industrial estate: halls, saw-tooth roofs, tanks, containers, yards."""

from __future__ import annotations

import numpy as np

from overfly.scenes import materials as m
from overfly.scenes.builder import Array, cylinders, lifted, turned
from overfly.scenes.buildings import Plots, flat, pitched, roof_boxes
from overfly.scenes.cover import along
from overfly.scenes.site import FLAT_ROOF, Site
from overfly.scenes.streets import cells, street_grid
from overfly.scenes.vehicles import cars, containers, lorries


def industrial(site: Site) -> None:
    """Halls with flat, low-pitched and saw-tooth roofs, tanks, containers, yards, a siding."""
    rng, painter = site.rng, site.painter
    xs, ys, lines = street_grid(site, (130, 190), (90, 140), (4.0, 5.0))
    reach = site.size_m
    siding = site.world([(-reach, ys[len(ys) // 2] + 20), (reach, ys[len(ys) // 2] + 20)])
    halls: list[tuple[Array, float, float, float, int]] = []
    for low, high in cells(xs, ys, site, 9, -30):
        middle, size = (low + high) / 2, high - low
        odds = rng.random()
        centre = site.world(middle)
        if odds < 0.67:
            count = int(rng.integers(1, 4))
            for i in range(count):
                room = np.array([size[0] / count - 10, size[1] * rng.uniform(0.55, 0.85)])
                at = np.array([low[0] + (i + 0.5) * size[0] / count, middle[1] + rng.uniform(-0.06, 0.06) * size[1]])
                if min(room) > 12:
                    halls.append((at, room[0], room[1], float(rng.uniform(6.5, 14)), int(rng.integers(0, 4))))
        elif odds < 0.76:
            _tank_farm(site, low, high)
        elif odds < 0.88:
            painter.area(centre, site.heading, size * 0.95, int(rng.choice([m.GRAVEL, m.ASPHALT])))
            x, y = np.meshgrid(np.arange(low[0] + 10, high[0] - 8, 13.5), np.arange(low[1] + 6, high[1] - 4, 3.0))
            rows = np.stack([x.ravel(), y.ravel()], -1)
            stacked = (np.arange(len(rows)) // x.shape[1]) % 6 < 4  # every sixth row is a lane
            filled = stacked & (rng.random(len(rows)) < 0.6)
            spots = site.world(rows[filled])
            spots = spots[site.inner(spots, 7)]
            containers(site.builder, spots, np.full(len(spots), site.heading), site.field(spots), rng)
            site.take(centre, site.heading, *size)
        else:
            site.parking(centre, size * 0.9, 0.6)
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
    metal = np.array(
        [(0.55, 0.57, 0.58), (0.30, 0.36, 0.42), (0.62, 0.60, 0.54), (0.20, 0.24, 0.27), (0.45, 0.18, 0.12)]
    )
    roof = np.where(form == 1, m.ROOF_METAL, rng.choice([m.ROOF_PLAIN, m.ROOF_GRAVEL, m.ROOF_METAL], n))
    wall = np.where(rng.random(n) < 0.75, m.WALL_METAL, m.WALL_BRICK)
    plots = site.plots(
        centre,
        np.full(n, site.heading),
        length,
        width,
        height,
        wall,
        site.choose(metal, n),
        roof,
        site.choose(FLAT_ROOF, n),
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

        def place(
            local: list[tuple[Array | float, float]], height: list[float], pick: Array = pick, z: float = z
        ) -> Array:
            xy = np.stack([np.stack(np.broadcast_arrays(a, b), -1) for a, b in local], 1)
            return lifted(turned(xy, plots.angle[pick], plots.centre[pick]), z + np.array(height))

        a, b = x + 0.3, x + step - 0.05
        slope = place([(a, -half), (b, -half), (b, half), (a, half)], [0.0, rise, rise, 0.0])
        glass = place([(b, -half), (b, half), (b, half), (b, -half)], [0.0, 0.0, rise, rise])
        ends = np.concatenate(
            [
                place([(a, -half), (b, -half), (b, -half)], [0, 0, rise]),
                place([(b, half), (a, half), (b, half)], [0, 0, rise]),
            ]
        )
        along_ridge = (np.cos(plots.angle[i]), np.sin(plots.angle[i]), 0.6, 0)
        site.builder.polygons(slope, m.ROOF_METAL, plots.roof_paint[i], along_ridge)
        start = -half * 1.0
        site.builder.polygons(glass, m.WALL_GLASS, plots.wall_paint[i], (start, z, rise, 1.6))
        site.builder.polygons(ends, m.WALL_PLAIN, plots.wall_paint[i], (0, z, 3, 3))


def _tank_farm(site: Site, low: Array, high: Array) -> None:
    """Round tanks on gravel, a chimney."""
    rng = site.rng
    size = high - low
    site.painter.area(site.world((low + high) / 2), site.heading, size, m.GRAVEL)
    pitch = float(rng.uniform(17, 27))
    x, y = np.meshgrid(
        np.arange(low[0] + pitch / 2, high[0] - 4, pitch), np.arange(low[1] + pitch / 2, high[1] - 4, pitch)
    )
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
        cylinders(
            site.builder,
            stack,
            [1.9],
            site.field(stack) - 1,
            site.field(stack) + rng.uniform(25, 50),
            [(0.42, 0.25, 0.19, 0.5)],
            top=0.6,
        )
