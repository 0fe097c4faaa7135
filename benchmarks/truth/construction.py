"""A building under construction: slabs and columns, half the walls, scaffolding, a crane, stacks and huts."""

from __future__ import annotations

import numpy as np

from overfly.scenes import Scene
from overfly.scenes import materials as m
from overfly.scenes.builder import Array, boxes
from overfly.scenes.buildings import flat, roof_boxes
from overfly.scenes.cover import Painter
from overfly.scenes.site import BRICK, FLAT_ROOF, PLASTER, Site
from overfly.scenes.terrain import Relief

STOREY_M, SLAB_M, BAY_M = 3.2, 0.3, 6.0
LENGTH_M, WIDTH_M = 36.0, 18.0
CONCRETE, STEEL, WOOD = (0.46, 0.45, 0.42), (0.30, 0.31, 0.33), (0.36, 0.24, 0.13)


def construction_site(*, storeys: int = 5, walled: int = 3, seed: int = 0, size_m: float = 260.0) -> Scene:
    """A site with one building in the middle.

    Args:
        storeys: of slabs and columns that stand already.
        walled: of these, from below, that have their walls; the next one has half of them.
        seed: of everything that is strewn about.
        size_m: width of the landscape, metres.
    """
    rng = np.random.default_rng([seed, storeys, walled])
    painter = Painter(size_m, 0.2, m.MEADOW, pavement=2.0, marked=True, wild=m.MEADOW)
    site = Site(f"construction-{storeys}-{walled}-{seed}", seed, rng, size_m, Relief(rng, size_m, 2.0), painter)
    painter.area((0, 0), site.heading, (90, 70), m.DIRT, take=True)
    painter.street(site.world([(-size_m / 2, -48), (size_m / 2, -48)]), 3.5)
    floor = float(site.field(site.world([(0, 0)]))[0]) + 0.2
    _frame(site, floor, storeys, walled)
    _scaffold(site, floor, walled * STOREY_M + STOREY_M)
    _crane(site, floor, storeys * STOREY_M + 14.0)
    _stacks(site, rng)
    _neighbours(site, rng)
    site.plant(site.inside(14), (5, 12))
    return site.scene()


def _boxes(
    site: Site, centre: Array, size: Array, low: Array, color: tuple[float, float, float], material: int = m.PAINT
) -> None:
    """Upright boxes in the layout's axes: centre [n, 2], size [n, 3], low [n]."""
    n = len(centre)
    tone = 1 + 0.12 * site.rng.standard_normal((n, 1))
    paint = np.c_[np.clip(np.tile(color, (n, 1)) * tone, 0.02, 0.85), site.rng.random(n)]
    boxes(site.builder, site.world(centre), np.full(n, site.heading), size, low, paint, material)


def _frame(site: Site, floor: float, storeys: int, walled: int) -> None:
    """Slabs on columns; the lowest storeys between brick walls, the next one between half of them."""
    x = np.arange(-LENGTH_M / 2, LENGTH_M / 2 + 0.1, BAY_M)
    y = np.arange(-WIDTH_M / 2, WIDTH_M / 2 + 0.1, BAY_M)
    columns = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2) * 0.97
    for k in range(storeys):
        low = floor + k * STOREY_M
        one = np.zeros((1, 2))
        _boxes(site, one, np.array([[LENGTH_M + 0.6, WIDTH_M + 0.6, SLAB_M]]), np.array([low]), CONCRETE, m.WALL_PLAIN)
        n = len(columns)
        # On the topmost slab columns stand as far as they are poured.
        tall = STOREY_M - SLAB_M if k < storeys - 1 else site.rng.choice([0.9, STOREY_M - SLAB_M], n)
        size = np.stack(np.broadcast_arrays(np.full(n, 0.45), 0.45, tall), -1)
        _boxes(site, columns, size, np.full(n, low + SLAB_M), CONCRETE, m.WALL_PLAIN)
        if k <= walled:
            _walls(site, low + SLAB_M, columns if k < walled else columns[columns[:, 0] < 0])


def _walls(site: Site, low: float, columns: Array) -> None:
    """Panels of brick between the outer columns."""
    for axis, edge in ((0, WIDTH_M / 2), (1, LENGTH_M / 2)):
        along = np.unique(columns[:, axis].round(3))
        middle = (along[1:] + along[:-1]) / 2
        for sign in (-1, 1):
            outside = np.full(len(middle), sign * edge * 0.97)
            reached = np.abs(columns[:, 1 - axis] - sign * edge * 0.97).min() < 0.1
            if not reached:
                continue
            centre = np.stack([middle, outside] if axis == 0 else [outside, middle], -1)
            size = np.tile([BAY_M * 0.9, 0.24, 2.7] if axis == 0 else [0.24, BAY_M * 0.9, 2.7], (len(middle), 1))
            _boxes(site, centre, size, np.full(len(middle), low), tuple(BRICK[1]), m.WALL_BRICK)


def _scaffold(site: Site, floor: float, height: float) -> None:
    """Poles and planks before one long wall and one short one."""
    for start, end in (((-18, -10.6), (18, -10.6)), ((19.6, -9), (19.6, 9))):
        line = np.linspace(start, end, int(np.hypot(end[0] - start[0], end[1] - start[1]) / 2.5) + 1)
        n = len(line)
        _boxes(site, line, np.tile([0.14, 0.14, height], (n, 1)), np.full(n, floor), STEEL)
        middle, along = line.mean(0, keepdims=True), np.abs(line[-1] - line[0])
        plank = np.maximum(along, 0.9)
        for z in np.arange(2.0, height, 2.0):
            _boxes(site, middle, np.array([[plank[0], plank[1], 0.12]]), np.array([floor + z]), WOOD)


def _crane(site: Site, floor: float, height: float) -> None:
    """A tower crane: mast, jib, counterweight."""
    at = np.array([[-26.0, 4.0]])
    yellow = (0.62, 0.45, 0.05)
    _boxes(site, at, np.array([[1.6, 1.6, height]]), np.array([floor]), yellow)
    _boxes(site, at + np.array([14.0, 0]), np.array([[40.0, 1.2, 1.4]]), np.array([floor + height]), yellow)
    _boxes(site, at - np.array([7.0, 0]), np.array([[3.0, 2.2, 2.6]]), np.array([floor + height - 1.0]), CONCRETE)


def _stacks(site: Site, rng: np.random.Generator) -> None:
    """Huts, pallets, heaps of boards and steel all over the yard."""
    n = 70
    centre = rng.uniform((-43, -33), (43, 33), (n, 2))
    centre = centre[(np.abs(centre[:, 0]) > 23) | (np.abs(centre[:, 1]) > 15)]
    n = len(centre)
    ground = site.field(site.world(centre)) - 0.1
    for color, part in zip((WOOD, STEEL, tuple(BRICK[0])), np.array_split(np.arange(n), 3)):
        size = rng.uniform((0.8, 0.6, 0.3), (3.5, 2.2, 1.4), (len(part), 3))
        _boxes(site, centre[part], size, ground[part], color)
    huts = np.array([[-36.0, -26 + 3.2 * k] for k in range(4)] + [[34.0, 24.0], [34.0, 27.5]])
    _boxes(site, huts, np.tile([6.0, 2.5, 2.6], (len(huts), 1)), site.field(site.world(huts)), (0.10, 0.20, 0.34))


def _neighbours(site: Site, rng: np.random.Generator) -> None:
    """Finished buildings around the site."""
    half = site.size_m / 2 - 15
    places = [(x, y) for x in np.arange(-half, half, 32) for y in (-72, 62, 92) if abs(x) < half and abs(y) < half]
    centre = site.world(np.array(places) + rng.uniform(-3, 3, (len(places), 2)))
    n = len(centre)
    wall = rng.choice([m.WALL_WINDOWS, m.WALL_BRICK], n)
    plots = site.plots(
        centre, np.full(n, site.heading), rng.uniform(14, 24, n), rng.uniform(10, 14, n), rng.integers(2, 5, n) * 3.0,
        wall, site.choose(PLASTER, n), m.ROOF_GRAVEL, site.choose(FLAT_ROOF, n),
    )  # fmt: skip
    flat(site.builder, plots)
    roof_boxes(site.builder, plots, rng)
