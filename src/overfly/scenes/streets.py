"""Streets on a grid, and the blocks between them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from overfly.scenes.builder import Array
from overfly.scenes.site import Site


def street_grid(
    site: Site, pitch_x: tuple[float, float], pitch_y: tuple[float, float], half_width: tuple[float, ...]
) -> tuple[Array, Array, list[Array]]:
    """Streets along both axes of the layout; returns their places on x and on y, and their lines in the world."""
    reach = site.size_m * 0.75
    rng = site.rng

    def places(pitch: tuple[float, float]) -> Array:
        steps = rng.uniform(*pitch, int(2 * reach / pitch[0]) + 2)
        at = np.cumsum(steps) - reach - rng.uniform(0, pitch[0])
        return at[at < reach]

    xs, ys = places(pitch_x), places(pitch_y)
    lines = [site.world([(x, -reach), (x, reach)]) for x in xs] + [site.world([(-reach, y), (reach, y)]) for y in ys]
    widths = rng.choice(half_width, len(lines))
    for line, width in zip(lines, widths):
        site.painter.street(line, float(width))
    wider = np.maximum(*np.meshgrid(widths[: len(xs)], widths[len(xs) :]))
    site.painter.crossings(site.world(np.stack(np.meshgrid(xs, ys), -1)), wider)
    return xs, ys, lines


def cells(xs: Array, ys: Array, site: Site, inset: float, margin: float) -> list[tuple[Array, Array]]:
    """The blocks between streets whose middle lies in the landscape: low and high corner in layout coordinates."""
    cells = []
    for x0, x1 in pairwise(xs):
        for y0, y1 in pairwise(ys):
            low, high = np.array([x0 + inset, y0 + inset]), np.array([x1 - inset, y1 - inset])
            middle = site.world((low + high) / 2)
            if (high - low > 18).all() and np.abs(middle).max() < site.size_m / 2 - margin:
                cells.append((low, high))
    return cells
