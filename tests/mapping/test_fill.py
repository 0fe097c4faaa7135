"""Colours of cells that no photograph sees."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from overfly.mapping.fill import FILL, fill

STEP = np.float32(0.5)


def filled(hole: slice, depth: float, size: int = 96) -> tuple[NDArray[np.bool_], NDArray[np.uint8]]:
    """What is filled, and the colours, of a grey plain with a square that nobody sees, so many metres deep."""
    heights, worth = np.zeros((size, size), np.float32), np.ones((size, size), np.float32)
    rgb = np.full((3, size, size), 90, np.uint8)
    heights[hole, hole], worth[hole, hole], rgb[:, hole, hole] = -depth, 0, 0
    return fill(rgb, worth, heights, STEP), rgb


@pytest.mark.parametrize(
    ("side", "depth", "reach"), [(10, 9, 5), (16, 9, 8), (17, 9, 0), (20, 9, 0), (40, 0, 2 * FILL)]
)
def test_a_colour_is_carried_as_far_as_it_may(side: int, depth: float, reach: int) -> None:
    """``reach``: rings of the square that get one: in pits all or none, on level ground the outer."""
    hole = slice(30, 30 + side)
    done, rgb = filled(hole, depth)
    inside = np.zeros(done.shape, bool)
    inside[hole, hole] = True
    deep = np.zeros_like(inside)
    deep[30 + reach : 30 + side - reach, 30 + reach : 30 + side - reach] = True
    np.testing.assert_array_equal(done, inside & ~deep)
    assert (rgb[:, done] == 90).all()
    assert not rgb[:, deep].any()


def test_a_part_of_the_plan_is_filled_as_the_whole() -> None:
    rng = np.random.default_rng(4)
    size, margin = 192, 48
    heights = np.where(rng.random((size // 8, size // 8)) < 0.3, 5, 0).repeat(8, 0).repeat(8, 1).astype(np.float32)
    unseen = (rng.random((size // 12, size // 12)) < 0.4).repeat(12, 0).repeat(12, 1)
    worth = np.where(unseen, 0, rng.choice([0.01, 0.5], (size, size))).astype(np.float32)
    colours = rng.integers(0, 255, (3, size, size), np.uint8)
    whole = colours.copy()
    done = fill(whole, worth, heights, STEP)
    assert 0 < done.sum() < unseen.sum()
    part, core = slice(0, 2 * margin + 24), slice(margin, margin + 24)
    own = colours[:, part, part].copy()
    again = fill(own, worth[part, part], heights[part, part], STEP)
    np.testing.assert_array_equal(own[:, core, core], whole[:, core, core])
    np.testing.assert_array_equal(again[core, core], done[core, core])
