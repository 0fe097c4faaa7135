"""The six procedural landscapes (first version)."""

from __future__ import annotations

import numpy as np

from overfly.scenes import materials as m
from overfly.scenes.builder import Builder, boxes
from overfly.scenes.scene import STYLES, Scene
from overfly.scenes.terrain import Relief, heightfield


def build(style: str, seed: int, size_m: float, relief: float | None) -> Scene:
    rng = np.random.default_rng([STYLES.index(style), seed])
    field = heightfield(Relief(rng, size_m, 8.0 if relief is None else relief), size_m)
    builder = Builder()
    vertices, faces = field.mesh()
    builder.add(vertices, faces, field.normals(), m.GROUND, (0, 0, 0, 0))
    n = int(size_m**2 / 1200)
    centre = (rng.random((n, 2)) - 0.5) * (size_m - 30)
    size = rng.uniform(6, 20, (n, 3))
    boxes(builder, centre, rng.random(n) * 3, size, field(centre) - 2, np.c_[rng.random((n, 3)), rng.random(n)])
    half = size_m / 2
    return Scene(
        name=f"{style}-{seed}", terrain=field, extent=(-half, -half, half, half), seed=seed, **builder.arrays()
    )
