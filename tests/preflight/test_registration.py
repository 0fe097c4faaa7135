"""What a check foretells about the images that will be placed."""

import numpy as np
import pytest

from overfly.preflight.images import Look
from overfly.preflight.registration import chances, facing, placed_chances, usable_shares


def line(count: int, *, gap_after: int | None = None, overlap: float = 0.6) -> np.ndarray:
    """Overlaps of images along one line [count, count], without any across ``gap_after``."""
    apart = np.abs(np.arange(count)[:, None] - np.arange(count))
    overlaps = np.clip(1 - (1 - overlap) * apart, 0, 1)
    if gap_after is not None:
        side = np.arange(count) > gap_after
        overlaps[side[:, None] != side] = 0
    return overlaps


def test_a_line_with_overlap_is_placed_and_one_without_is_not():
    usable = np.ones(6)
    assert chances(line(6), usable).min() > 0.99
    assert chances(line(6, overlap=0.05), usable).max() < 0.05


def test_only_the_larger_part_counts_across_a_gap():
    found = chances(line(8, gap_after=4), np.ones(8))
    assert (found[:5] > 0.99).all()
    assert (found[5:] < 0.01).all()


def test_an_image_of_no_use_is_lost_and_breaks_a_line_of_little_overlap():
    usable = np.where(np.arange(7) == 3, 0.0, 1.0)
    dense, sparse = chances(line(7, overlap=0.8), usable), chances(line(7, overlap=0.5), usable)
    assert dense[3] < 0.01
    assert np.delete(dense, 3).min() > 0.99
    assert (sparse[:3] < 0.01).all() or (sparse[4:] < 0.01).all()


def test_usable_is_what_is_textured_lit_and_sharp():
    good = {"dark": 0.0, "bright": 0.0, "flat": 0.0}
    looks = [Look(**good), Look(**good | {"flat": 0.5}), Look(**good | {"dark": 0.9}), Look(**good), Look(error="cut")]
    usable = usable_shares(looks, np.array([1.0, 1.0, np.nan, 0.05, np.nan]))
    assert usable == pytest.approx([1, 0.5, 0.1, 0.2, 0])


def test_an_image_without_a_position_overlaps_as_the_others_do():
    names = ["a", "b", "c", "d"]
    assert placed_chances(names, np.ones(4), ["a", "b", "d"], line(3)).min() > 0.99
    assert placed_chances(names, np.array([1, 1, 0.01, 1]), ["a", "b", "d"], line(3))[2] < 0.05
    assert placed_chances(names, np.ones(4), [], None).min() > 0.99


def test_views_from_far_apart_do_not_match():
    down, tilted, oblique = [0, 0, -1], [0.1908, 0, -0.9816], [-0.6428, 0, -0.766]  # 0, 11 and -40 degrees
    found = facing(np.array([down, tilted, oblique]))
    assert found[0, 1] == pytest.approx(1, abs=0.01)
    assert found[1, 2] == 0
    assert found[0, 2] == pytest.approx(1 / 3, abs=0.01)
