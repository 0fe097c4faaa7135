"""Which sparse points tell how deep the surface lies."""

from __future__ import annotations

import numpy as np

from overfly.mapping.depth_ranges import beside_others


def test_points_far_below_or_above_those_around_them_are_left_out() -> None:
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(0, 200, (400, 2)), rng.normal(10, 3, 400)])
    tower = np.column_stack([rng.uniform(90, 95, (30, 2)), rng.uniform(0, 60, 30)])
    wrong = np.column_stack([rng.uniform(0, 200, (8, 2)), [-900, -80, -60, 75, 90, -50, -300, 2000]])
    wrong[0, 0], wrong[6, 0] = 900, -2000  # with nothing around them
    centres = np.array([[x, 100, 110.0] for x in range(0, 200, 40)])
    good = beside_others(np.concatenate([points, tower, wrong]), centres)
    assert good[:400].all()
    assert good[400:430].mean() > 0.9
    assert not good[430:].any()
    assert beside_others(points[:5], centres).all()
    together = np.array([2000.0, 0, -1500]) + np.random.default_rng(1).uniform(-20, 20, (12, 3))
    crowd = np.concatenate([np.repeat(points, 8, axis=0), together])  # a hundredth at the most
    good = beside_others(crowd, centres)
    assert good[:-12].all()
    assert not good[-12:].any()
