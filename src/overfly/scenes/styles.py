"""The six procedural landscapes: their numbers, and who builds them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from overfly.scenes import materials as m
from overfly.scenes.blocks import blocks
from overfly.scenes.campus import campus
from overfly.scenes.countryside import vegetation, village
from overfly.scenes.cover import Painter
from overfly.scenes.industrial import industrial
from overfly.scenes.scene import STYLES, Scene
from overfly.scenes.site import Site
from overfly.scenes.suburb import suburb
from overfly.scenes.terrain import Relief


@dataclass(frozen=True)
class Style:
    """What distinguishes a style before anything is built.

    Attributes:
        build: fills a site.
        relief: height range of the bare ground, metres.
        background: what covers the ground.
        pavement: width of the pavements, metres.
        marked: whether streets carry lane marks.
        wild: what lies beyond the landscape.
        pond: chance of a pond in 16 hectares.
    """

    build: Callable[[Site], None]
    relief: float
    background: int
    pavement: float
    marked: bool
    wild: int
    pond: float


TABLE = {
    "campus": Style(campus, 7.0, m.LAWN, 1.6, True, m.MEADOW, 0.8),
    "blocks": Style(blocks, 5.0, m.PAVING, 3.0, True, m.PAVING, 0.0),
    "suburb": Style(suburb, 8.0, m.GARDEN, 1.4, False, m.MEADOW, 0.2),
    "village": Style(village, 30.0, m.MEADOW, 0.0, False, m.MEADOW, 0.3),
    "industrial": Style(industrial, 3.0, m.ASPHALT, 0.0, True, m.MEADOW, 0.5),
    "vegetation": Style(vegetation, 55.0, m.MEADOW, 0.0, False, m.FOREST_FLOOR, 0.6),
}


def build(style: str, seed: int, size_m: float, relief: float | None) -> Scene:
    """The landscape of a style; see :func:`overfly.scenes.make_scene`."""
    facts = TABLE[style]
    rng = np.random.default_rng([STYLES.index(style), seed])
    ground = Relief(rng, size_m, facts.relief if relief is None else relief)
    heading = float(rng.uniform(-np.pi / 4, np.pi / 4))
    painter = Painter(size_m, heading, facts.background, pavement=facts.pavement, marked=facts.marked, wild=facts.wild)
    _ponds(rng, ground, painter, facts.pond)
    site = Site(f"{style}-{seed}", seed, rng, size_m, ground, painter)
    facts.build(site)
    return site.scene()


def _ponds(rng: np.random.Generator, ground: Relief, painter: Painter, odds: float) -> None:
    """Level, round-ish water in low places."""
    size = painter.size_m
    if size < 150:
        return
    for _ in range(rng.binomial(max(1, round(size**2 / 160_000)), odds)):
        candidates = rng.uniform(-0.38, 0.38, (12, 2)) * size
        centre = candidates[np.argmin(ground(candidates))]
        radius = float(rng.uniform(12, 26))
        ground.level(centre, radius * 1.25)
        for _ in range(5):
            painter.disc(
                centre + rng.normal(0, 0.3 * radius, 2), radius * float(rng.uniform(0.5, 0.8)), m.WATER, take=True
            )
