"""Cars, lorries, trailers and containers."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from overfly.scenes import materials as m
from overfly.scenes.builder import Builder, boxes

PAINTS = np.array(
    [
        (0.75, 0.75, 0.74),
        (0.62, 0.63, 0.65),
        (0.04, 0.04, 0.045),
        (0.02, 0.02, 0.025),
        (0.22, 0.23, 0.25),
        (0.35, 0.04, 0.03),
        (0.04, 0.08, 0.25),
        (0.30, 0.27, 0.20),
    ]
)

CONTAINERS = np.array(
    [
        (0.33, 0.08, 0.05),
        (0.05, 0.12, 0.28),
        (0.10, 0.22, 0.13),
        (0.45, 0.42, 0.38),
        (0.40, 0.20, 0.05),
        (0.6, 0.6, 0.6),
    ]
)


def cars(builder: Builder, xy: ArrayLike, angle: ArrayLike, ground: ArrayLike, rng: np.random.Generator) -> None:
    """n cars: a body, and a narrower cabin of dark glass with a roof of the car's colour."""
    xy, angle, ground = (np.asarray(v, float) for v in (xy, angle, ground))
    n = len(angle)
    if not n:
        return
    paint = np.c_[PAINTS[rng.integers(0, len(PAINTS), n)], rng.random(n)]
    length, width, height = rng.uniform(3.9, 4.9, n), rng.uniform(1.7, 1.9, n), rng.uniform(1.4, 1.75, n)
    shift = np.stack([np.cos(angle), np.sin(angle)], -1) * (-0.06 * length)[:, None]
    size = np.stack([length, width, 0.58 * height], -1)
    boxes(builder, xy, angle, size, ground + 0.22, paint)
    glass = np.c_[np.tile([0.025, 0.03, 0.035], (n, 1)), rng.random(n)]
    cabin = np.stack([length * 0.62, width * 0.94, 0.36 * height], -1)
    boxes(builder, xy + shift, angle, cabin, ground + 0.22 + size[:, 2], glass, taper=0.82)
    lid = np.stack([length * 0.62 * 0.8, width * 0.94 * 0.84, np.full(n, 0.05)], -1)
    boxes(builder, xy + shift, angle, lid, ground + 0.2 + size[:, 2] + cabin[:, 2], paint)


def lorries(builder: Builder, xy: ArrayLike, angle: ArrayLike, ground: ArrayLike, rng: np.random.Generator) -> None:
    """n lorries: a cab and a long box."""
    xy, angle, ground = (np.asarray(v, float) for v in (xy, angle, ground))
    n = len(angle)
    if not n:
        return
    forward = np.stack([np.cos(angle), np.sin(angle)], -1)
    length = rng.uniform(7.0, 13.5, n)
    box = np.stack([length, np.full(n, 2.5), np.full(n, 2.7)], -1)
    pale = rng.uniform(0.45, 0.8, n)
    boxes(builder, xy, angle, box, ground + 1.1, np.c_[pale, pale, pale * 0.98, rng.random(n)])
    cab = np.tile([2.2, 2.4, 2.6], (n, 1))
    paint = np.c_[PAINTS[rng.integers(0, len(PAINTS), n)], rng.random(n)]
    boxes(builder, xy + forward * (length / 2 + 1.5)[:, None], angle, cab, ground + 0.5, paint)


def containers(builder: Builder, xy: ArrayLike, angle: ArrayLike, ground: ArrayLike, rng: np.random.Generator) -> None:
    """n stacks of one to three containers."""
    xy, angle, ground = (np.asarray(v, float) for v in (xy, angle, ground))
    levels = rng.integers(1, 4, len(angle))
    for level in range(3):
        here = levels > level
        n = int(here.sum())
        if n:
            paint = np.c_[CONTAINERS[rng.integers(0, len(CONTAINERS), n)], rng.random(n)]
            size = np.tile([12.2, 2.44, 2.58], (n, 1))
            boxes(builder, xy[here], angle[here], size, ground[here] + level * 2.6, paint, material=m.PAINT)
