"""Pairs that cannot see common ground: told where the geometry is clear, and only there."""

from __future__ import annotations

import numpy as np
import pytest

from overfly.geometry import Array
from overfly.mapping.apart import cannot_overlap

SIZE = (800, 600)
GSD = 0.25


def pixels(ground: Array, place: Array, heading: float) -> Array:
    """Where a nadir frame of 200 x 150 m shows points of level ground; y downwards."""
    turn = np.array([[np.cos(heading), np.sin(heading)], [np.sin(heading), -np.cos(heading)]])
    return (ground - place) @ turn.T / GSD + np.array(SIZE) / 2


@pytest.fixture
def block() -> tuple[Array, list[float]]:
    """Three lines of five frames, every other one flown back: 100 m apart along, 140 m across."""
    places = [(140.0 * line, 100.0 * (i if line % 2 == 0 else 4 - i)) for line in range(3) for i in range(5)]
    # The image's x axis points across the line, to the right of the flight's direction.
    return np.array(places), [0.0 if k // 5 % 2 == 0 else np.pi for k in range(15)]


def common(places: Array, headings: list[float], rng: np.random.Generator) -> dict:  # type: ignore[type-arg]
    """Common points of every two frames that overlap."""
    ground, found = rng.uniform(-150, 600, (6000, 2)), {}
    for i in range(len(places)):
        for j in range(i + 1, len(places)):
            a, b = (pixels(ground, places[k], headings[k]) for k in (i, j))
            inside = ((a > 0) & (a < SIZE) & (b > 0) & (b < SIZE)).all(1)
            if inside.any():
                found[i, j] = a[inside], b[inside]
    return found


def test_frames_that_show_no_common_ground_are_told(block: tuple[Array, list[float]]) -> None:
    places, headings = block
    rng = np.random.default_rng(0)
    matched = common(places, headings, rng)
    told = places + rng.normal(0, 2, places.shape)
    pairs = [(i, j) for i in range(15) for j in range(i + 1, 15)]
    apart = cannot_overlap(pairs, told, [SIZE] * 15, matched)
    assert not apart & set(matched)
    away = np.abs(places[:, None] - places[None])
    far = {(i, j) for i, j in pairs if away[i, j, 0] > 270 or away[i, j, 1] > 210}
    assert far <= apart


def test_images_that_fit_no_plane_map_tell_nothing(block: tuple[Array, list[float]]) -> None:
    """Oblique images: what a pair has in common says little of where the other camera stands."""
    places, headings = block
    rng = np.random.default_rng(1)
    matched = {
        pair: (rng.uniform(0, 600, a.shape), rng.uniform(0, 600, b.shape))
        for pair, (a, b) in common(places, headings, rng).items()
    }
    assert not cannot_overlap([(0, 4), (0, 14)], places, [SIZE] * 15, matched)


def test_frames_without_partners_or_positions_are_kept(block: tuple[Array, list[float]]) -> None:
    places, headings = block
    matched = common(places, headings, np.random.default_rng(2))
    alone = {pair: both for pair, both in matched.items() if 4 not in pair}
    assert (0, 4) not in cannot_overlap([(0, 4)], places, [SIZE] * 15, alone)
    assert (0, 4) in cannot_overlap([(0, 4)], places, [SIZE] * 15, matched)
    places[4] = np.nan
    assert not cannot_overlap([(0, 4)], places, [SIZE] * 15, matched)
    assert not cannot_overlap([(0, 4)], places, [SIZE] * 15, {})
    few = {pair: (a[:5], b[:5]) for pair, (a, b) in matched.items()}
    assert not cannot_overlap([(0, 14)], places, [SIZE] * 15, few)


def test_copies_of_a_photo_spoil_nothing(block: tuple[Array, list[float]]) -> None:
    """Two images with all points in common from one place tell no scale."""
    places, headings = block
    rng = np.random.default_rng(3)
    matched = common(places, headings, rng)
    same = rng.uniform(0, 600, (100, 2))
    apart = [(0, 4), (0, 14)]
    twice = np.concatenate([places, [[5000.0, 5000.0], [5000.0, 5000.0]]])
    assert not cannot_overlap(apart, twice, [SIZE] * 17, {(15, 16): (same, same)})
    found = cannot_overlap([*apart, (15, 16)], twice, [SIZE] * 17, matched | {(15, 16): (same, same)})
    assert (15, 16) not in found
