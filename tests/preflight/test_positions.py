"""Which positions a check calls wrong, by the track, by its lines and by the pictures, and which it must not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from flown import ALTITUDE, GSD, SPACING, STEP, grid, write

from overfly.flights import Gps, read_flight
from overfly.geometry import rotation_from_gimbal
from overfly.preflight.displacements import Displacements
from overfly.preflight.evidence import Evidence
from overfly.preflight.ground import place
from overfly.preflight.images import look_at_all
from overfly.preflight.positions import position_findings
from overfly.preflight.track import strays


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A flight of three lines and the look at it."""
    flight = read_flight(write(tmp_path_factory.mktemp("flown") / "flight", grid()))
    return flight, look_at_all([f.path for f in flight.frames])


def noisy(places: np.ndarray, seed: int) -> np.ndarray:
    return places + np.random.default_rng(seed).normal(size=places.shape)


def lines(counts: list[int], step: float = 41.0, spacing: float = 55.0) -> np.ndarray:
    """x, y of lines to the north and back of so many images each [n, 2]."""
    # The last line may stop early; the others end at the border, here or there.
    tops, places = [*counts[:-1], counts[-2] if counts[-2] - counts[-1] > 1 else counts[-1]], []
    for k, count in enumerate(counts):
        rows = np.arange(count) if k % 2 == 0 else tops[k] - 1 - np.arange(count)
        places += [(k * spacing, row * step) for row in rows]
    return np.array(places)


def off(flight, looks, changes):
    """Images of GPS findings after positions were moved east and north by metres."""
    frames = list(flight.frames)
    for i, (east, north) in changes.items():
        gps = frames[i].gps
        frames[i] = replace(frames[i], gps=Gps(gps.latitude + north / 111_200, gps.longitude + east / 77_400,
                                               gps.altitude))  # fmt: skip
    moved = replace(flight, frames=frames)
    found = position_findings(moved, place(moved, looks, None) if looks is not None else None, looks)
    return [name for finding in found if finding.topic == "gps" for name in finding.images]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("counts", [[6, 6, 6, 2], [6, 6, 6, 1], [8, 7, 6, 5, 4, 3, 2, 1], [7, 2], [2, 2, 2, 2, 2]])
def test_a_turn_to_the_next_line_is_no_fault_at_the_end_of_a_flight(counts, seed):
    assert strays(noisy(lines(counts), seed), None) == []
    assert strays(noisy(lines(counts)[::-1], seed), None) == []


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("count", [4, 5, 6, 7])
def test_every_second_image_missing_is_no_fault_of_positions(count, seed):
    assert strays(noisy(lines([count] * 4), seed)[::2], None) == []


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("last", [1, 2, 3, 5])
def test_lines_flown_in_two_directions_are_no_faults(last, seed):
    north, east = lines([5, 5, 5, 5]), lines([5, 5, last], spacing=60.0)[:, ::-1] + [-20, 40]
    assert strays(noisy(np.concatenate([north, east]), seed), None) == []
    wrong = noisy(np.concatenate([north, east]), seed)
    wrong[22] += [0, 44]
    assert [k for k, _ in strays(wrong, None)] == [22]


@pytest.mark.parametrize("i", [0, 1, 8, 9, 18, 19])
@pytest.mark.parametrize("away", [(30.0, 0.0), (0.0, 30.0), (-30.0, 20.0)])
def test_an_error_that_no_line_explains_is_told_on_short_lines(i, away):
    xy = noisy(lines([5, 5, 5, 5]), 3)
    xy[i] += away
    assert [k for k, _ in strays(xy, None)] == [i]


def test_ends_of_a_free_flight_may_turn_as_it_turns_elsewhere():
    rng = np.random.default_rng(0)
    headings = np.cumsum(rng.normal(0, 0.7, 40))
    for length in range(12, 40):
        xy = 90 * np.cumsum(np.column_stack([np.sin(headings), np.cos(headings)])[:length], axis=0)
        assert strays(noisy(xy, length), None) == []


def test_the_pictures_tell_the_way_between_two_images(flown):
    flight, looks = flown
    placed = place(flight, looks, None)
    told = Displacements(placed, looks)
    assert told.between(3, 4) == pytest.approx([0, STEP], abs=1.5)
    assert told.between(3, 5) == pytest.approx([0, 2 * STEP], abs=1.5)
    assert told.between(7, 8) == pytest.approx([SPACING, 0], abs=1.5)
    assert told.between(0, 15) == pytest.approx([SPACING, 0], abs=1.5)
    assert told.between(3, 3) is None  # a copy
    assert told.between(0, 23) is None  # nothing in common
    silent = replace(placed, frames=[replace(f, gimbal=None) for f in placed.frames])
    assert Displacements(silent, looks).between(3, 4) is None


def test_turned_and_tilted_views_tell_the_same_way(flown):
    """A picture turned by half is that of a camera that flies back; one of a tilted camera lies ahead of it."""
    flight, looks = flown
    turned = [replace(one, thumbnail=one.thumbnail[::-1, ::-1].copy()) if i == 4 else one
              for i, one in enumerate(looks)]  # fmt: skip
    placed = place(flight, looks, None)
    poses = placed.poses.copy()
    poses[4, :3, :3] = rotation_from_gimbal(180, -90)
    told = Displacements(replace(placed, poses=poses), turned).between(3, 4)
    assert told == pytest.approx([0, STEP], abs=1.5)


def test_a_look_at_the_images_is_not_changed_by_placing_them(flown):
    flight, looks = flown
    before = [one.thumbnail.copy() for one in looks]
    first = place(flight, looks, None).measured_altitude
    assert place(flight, looks, None).measured_altitude == first
    assert all(np.array_equal(a, one.thumbnail) for a, one in zip(before, looks, strict=True))


def test_featureless_pictures_tell_nothing(flown):
    flight, looks = flown
    rng = np.random.default_rng(0)
    blank = [replace(one, thumbnail=rng.normal(120, 1, one.thumbnail.shape).astype(np.float32)) for one in looks]
    told = Displacements(place(flight, looks, None), blank)
    assert [told.between(i, i + 1) for i in range(len(looks) - 1)] == [None] * 23


@pytest.mark.parametrize(
    ("i", "away"),
    [(7, (SPACING, 3)), (8, (0, -3.5 * STEP)), (7, (15, 0)), (12, (-SPACING, 20)), (23, (SPACING, -STEP))],
)
def test_pictures_accuse_what_the_track_allows(flown, i, away):
    flight, looks = flown
    assert off(flight, looks, {i: away}) == [flight.frames[i].name]


def test_pictures_accuse_a_few_images_in_a_row(flown):
    flight, looks = flown
    run = range(10, 13)
    assert sorted(off(flight, looks, dict.fromkeys(run, (0, 44)))) == [flight.frames[i].name for i in run]


def test_pictures_excuse_a_turn_that_nothing_else_explains(tmp_path):
    """After the only line the drone goes aside: by the positions alone a fault, by the pictures what happened."""
    places = np.concatenate([grid((0,), count=10), [[-SPACING + 15, 4.5 * STEP + 5]]])
    flight = read_flight(write(tmp_path / "flight", places))
    looks = look_at_all([f.path for f in flight.frames])
    assert off(flight, None, {}) == [flight.frames[10].name]
    assert off(flight, looks, {}) == []
    assert off(flight, looks, {10: (20, -15)}) == [flight.frames[10].name]


def test_a_good_flight_is_not_accused_where_height_and_terrain_are_wrong(flown):
    """Pictures of hills shift by other amounts than level ground at the told height does: 40 % here, and from place
    to place by a sixth."""
    flight, looks = flown
    high = replace(flight, frames=[replace(f, relative_altitude=ALTITUDE * 1.4) for f in flight.frames])
    assert off(high, looks, {}) == []
    assert off(high, looks, {7: (SPACING, 3)}) == [flight.frames[7].name]
    xy = grid()
    uneven = Evidence(xy, lambda i, j: (xy[j] - xy[i]) * (1.5 + 0.25 * np.sin(i)))
    assert uneven.scale == pytest.approx(1 / 1.5, rel=0.1)
    assert uneven.accused() == []


def test_one_wrong_match_of_pictures_accuses_nobody():
    xy = grid()
    for wrong in range(23):
        evidence = Evidence(xy, lambda i, j, k=wrong: np.array([30.0, 2.0]) if (i, j) == (k, k + 1) else xy[j] - xy[i])
        assert evidence.accused() == []


def test_where_few_pictures_can_be_compared_they_accuse_nobody():
    """Two wrong matches that agree by chance: told where the others agree with the positions, not where most do not."""
    xy = grid()
    wrong = {(9, 10): np.array([30.0, -9.0]), (10, 11): np.array([-30.0, -9.0])}
    sure = Evidence(xy, lambda i, j: wrong.get((i, j), xy[j] - xy[i] if j == i + 1 else None))
    unsure = Evidence(xy, lambda i, j: wrong.get((i, j), xy[j] - xy[i] if j == i + 1 < 8 else None))
    assert [i for i, _ in sure.accused()] == [10]
    assert unsure.scale == pytest.approx(1)
    assert unsure.accused() == []


def test_pictures_that_disagree_among_each_other_say_nothing():
    xy, rng = grid(), np.random.default_rng(0)
    evidence = Evidence(xy, lambda i, j: rng.uniform(-60, 60, 2))
    assert evidence.scale is None
    assert evidence.accused() == []
    assert evidence.excused([(3, 50.0)]) == set()
    assert Evidence(xy, lambda i, j: None).scale is None


def test_cells_are_coarser_than_pixels(flown):
    flight, looks = flown
    assert Displacements(place(flight, looks, None), looks).cell == pytest.approx(2 * GSD, rel=0.01)
