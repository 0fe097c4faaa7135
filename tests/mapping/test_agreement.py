"""Pairs whose matches contradict GPS and gimbals, and pairs that only these show to be right."""

from __future__ import annotations

import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from two_lines import CAMERA, Block

from overfly.flights import Flight
from overfly.geometry import pose, project, rotation_from_gimbal
from overfly.mapping.agreement import agreement, rewritten
from overfly.mapping.database import read_matches, read_verified, write_matches
from overfly.mapping.overlays import Prior

FALSE, WEAK = (0, 7), (1, 5)


class Matched(Block):
    """The block with a database: one pair has matches of a wrong pose, one few right among many wrong ones."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        rng = np.random.default_rng(1)
        self.names = [frame.name for frame in self.frames]
        matches = self.common(80)
        beside = pose(rotation_from_gimbal(180, -90), self.places[FALSE[0]] + [20.0, 30.0, 0.0])
        shown, depth = project(self.ground[self.seen[FALSE[0]]], CAMERA, beside)
        rows = np.flatnonzero((depth > 0) & ((shown > 0) & (shown < (800, 600))).all(1))[:60]
        pixels, looks = self.features[FALSE[1]]
        self.features[FALSE[1]] = np.concatenate([pixels, shown[rows]]), looks
        rows = np.column_stack([rows, len(pixels) + np.arange(len(rows))])
        wrong = np.column_stack([rng.permutation(250)[:100], rng.permutation(250)[:100]])
        matches[FALSE] = np.concatenate([rows, wrong[~np.isin(wrong[:, 0], rows[:, 0])]]).astype(np.uint32)
        wrong = np.column_stack([rng.permutation(250)[:150], rng.permutation(250)[:150]])
        wrong = wrong[~np.isin(wrong[:, 0], matches[WEAK][:20, 0])]
        matches[WEAK] = np.concatenate([matches[WEAK][:20], wrong]).astype(np.uint32)
        self.database = folder / "matches.db"
        flight = Flight(folder, self.frames)
        write_matches(self.database, flight, [(p.astype(np.float32), d) for p, d in self.features], matches, seed=0)

    def priors(self, told: np.ndarray) -> list[Prior | None]:
        turns = [rotation_from_gimbal(*(frame.gimbal or (0, 0, 0))) for frame in self.frames]
        return [Prior(CAMERA, pose(turn, place)) for turn, place in zip(turns, told, strict=True)]


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory) -> Matched:
    return Matched(tmp_path_factory.mktemp("matched"))


def right_share(block: Matched, rows: np.ndarray) -> float:
    """Of the weak pair's rows, those that show one point of the ground."""
    return float((block.seen[WEAK[0]][rows[:, 0]] == block.seen[WEAK[1]][rows[:, 1]]).mean())


def test_a_false_pair_is_dropped_and_a_weak_one_put_right(block: Matched) -> None:
    before = {pair: rows for pair, rows in read_verified(block.database, block.names).items() if len(rows)}
    assert FALSE in before
    assert right_share(block, before[WEAK]) < 0.8, "among so many wrong matches the right ones are not told"
    found = agreement(block.database, block.names, block.priors(block.told), 0)
    assert set(found.dropped + found.added) == {FALSE, WEAK}
    copy = rewritten(block.database, block.names, found, 0)
    after = {pair: rows for pair, rows in read_verified(copy, block.names).items() if len(rows)}
    assert set(after) == set(before) - {FALSE}
    assert len(after[WEAK]) >= 15
    assert right_share(block, after[WEAK]) > 0.9
    assert all(np.array_equal(after[pair], rows) for pair, rows in before.items() if pair not in (FALSE, WEAK))
    assert len(read_matches(block.database, block.names)[FALSE]) >= 60, "the database itself stays"


def test_nothing_is_held_against_priors_that_strong_pairs_contradict(block: Matched) -> None:
    """The wrong GPS of one image drops none of its pairs, and does not keep those of the others."""
    told = block.told.copy()
    told[3] += [300.0, -200.0, 0.0]
    found = agreement(block.database, block.names, block.priors(told), 0)
    assert FALSE in found.dropped
    assert not any(3 in pair for pair in found.dropped + found.added)
    kept = read_verified(block.database, block.names)
    mine = [pair for pair in kept if 3 in pair and len(kept[pair])]
    assert len(mine) >= 2
    assert all(np.array_equal(found.verified[pair], kept[pair]) for pair in mine)


@pytest.mark.parametrize("wrong", ["headings of a line", "all headings", "take-off", "focal length"])
def test_priors_that_are_wrong_as_a_whole_drop_nothing(block: Matched, wrong: str) -> None:
    """One line's compass reversed, or all; the take-off 60 m above the ground; a focal length of other images."""
    stand = []
    for k, (frame, place) in enumerate(zip(block.frames, block.told, strict=True)):
        turned = wrong == "all headings" or (wrong == "headings of a line" and k < 4)
        yaw, pitch, roll = frame.gimbal or (0, 0, 0)
        lower = np.array([0, 0, 60.0 if wrong == "take-off" else 0.0])
        camera = CAMERA if wrong != "focal length" else replace(CAMERA, fx=1500.0, fy=1500.0)
        stand.append(Prior(camera, pose(rotation_from_gimbal(yaw + 180 * turned, pitch, roll), place - lower)))
    found = agreement(block.database, block.names, stand, 0)
    right = [pair for pair in found.dropped if pair not in (FALSE, WEAK)]
    assert not right


def test_a_hovering_drone_contradicts_nothing(tmp_path: Path) -> None:
    """Two photos from one place: GPS does not tell in which direction one stands from the other."""
    matched = Matched(tmp_path)
    told = matched.told.copy()
    told[1] = told[0] + [0.3, -0.2, 0.1]
    found = agreement(matched.database, matched.names, matched.priors(told), 0)
    assert (0, 1) not in found.dropped
    kept = read_verified(matched.database, matched.names)
    assert np.array_equal(found.verified[0, 1], kept[0, 1])


def test_what_a_killed_run_left_does_not_reach_the_copy(block: Matched) -> None:
    found = agreement(block.database, block.names, block.priors(block.told), 0)
    first = rewritten(block.database, block.names, found, 0)
    content = {pair: rows.tolist() for pair, rows in read_verified(first, block.names).items()}
    with sqlite3.connect(first) as killed:
        killed.execute("pragma journal_mode=wal")
        killed.execute("delete from two_view_geometries")
        killed.commit()
        assert first.with_name(first.name + "-wal").is_file()
        again = rewritten(block.database, block.names, found, 0)
    assert {pair: rows.tolist() for pair, rows in read_verified(again, block.names).items()} == content


def test_without_priors_matches_stay_as_they_were_verified(block: Matched) -> None:
    priors: list[Prior | None] = [None] * 8
    found = agreement(block.database, block.names, priors, 0)
    assert not found.dropped
    assert not found.added
    assert FALSE in found.verified
