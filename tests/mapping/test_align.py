"""Cameras found from images alone, with GPS, and with too little of either."""

from __future__ import annotations

import shutil
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from conftest import bar
from overfly.errors import InputError
from overfly.flights import Flight, Frame, read_flight
from overfly.geodesy import Origin, enu_from_geodetic, geodetic_from_enu
from overfly.geometry import fit_similarity, transform
from overfly.mapping import normal_equations
from overfly.mapping.align import align
from overfly.mapping.database import focal_px
from overfly.mapping.features import image_pairs

pytestmark = pytest.mark.usefixtures("few_features")


def centre_errors(block, poses) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Distances [n] of the block's cameras from the truth after a similarity."""
    truth = np.array([p[:3, 3] for p in poses])
    found = block.poses[:, :3, 3]
    return np.linalg.norm(transform(fit_similarity(found, truth), found) - truth, axis=1)


@pytest.fixture(scope="module")
def strip_flight(hill, strips, camera, tmp_path_factory) -> Flight:  # type: ignore[no-untyped-def]
    return hill.flight(tmp_path_factory.mktemp("strips"), camera, strips)


@pytest.fixture(scope="module")
def work(tmp_path_factory) -> Path:  # type: ignore[no-untyped-def]
    return Path(tmp_path_factory.mktemp("work"))


@pytest.fixture(scope="module")
def block(strip_flight, work):  # type: ignore[no-untyped-def]
    return align(strip_flight, workdir=work, seed=0, bar=bar)


@pytest.fixture
def kept(block, work, tmp_path: Path) -> Path:  # type: ignore[no-untyped-def]
    """A work folder that holds the features and matches of the strips already."""
    return Path(shutil.copytree(work, tmp_path / "work"))


@pytest.mark.parametrize("size", [(800, 600), (600, 800), (5472, 3648), (1600, 900)])
def test_an_image_of_another_shape_than_the_sensor_is_a_part_of_it(size: tuple[int, int]) -> None:
    """4:3 cut out of a 3:2 sensor must not count as its full width: 11 % of the focal length bend the whole block."""
    frame = Frame("a", Path("a"), *size, model="FC6310", focal_mm=8.8)
    across, down = (max(size) / 13.2, min(size) / 8.8)
    assert focal_px(frame) == pytest.approx(8.8 * max(across, down))
    assert focal_px(replace(frame, focal_mm=17.6)) == pytest.approx(2 * 8.8 * max(across, down))


def test_all_frames_are_placed_where_they_were(block, strips, camera) -> None:  # type: ignore[no-untyped-def]
    assert len(block.frames) == 8
    assert block.reprojection_px < 0.3
    assert centre_errors(block, strips).max() < 0.4
    assert block.cameras[0].fx == pytest.approx(camera.fx, rel=0.02)


def test_a_position_that_is_far_off_does_not_make_all_of_them_look_bad(block) -> None:  # type: ignore[no-untyped-def]
    before = block.gps_rms()
    assert block.gps_far_off() == []
    gps = block.frames[2].gps
    frames = list(block.frames)
    frames[2] = replace(frames[2], gps=replace(gps, latitude=gps.latitude + 0.005))  # 560 m
    wrong = replace(block, frames=frames)
    assert wrong.gps_far_off() == [frames[2].name]
    assert wrong.gps_rms()["horizontal_m"] == pytest.approx(before["horizontal_m"], abs=0.1)


def test_gps_makes_it_metres_east_north_up(block, strips, hill) -> None:  # type: ignore[no-untyped-def]
    assert block.metric
    rms = block.gps_rms()
    assert rms is not None
    assert rms["horizontal_m"] < 0.3
    assert rms["vertical_m"] < 0.3
    # The origin is the flight's own: the ground lies where it does on the Earth.

    points = enu_from_geodetic(
        geodetic_from_enu(block.points, block.origin), Origin(52.2, 21.0, 100.0)
    )  # as in conftest.py
    assert np.median(np.abs(hill.off(points))) < 0.5


def test_the_same_seed_gives_the_same_cameras_and_kept_matches_are_reused(  # type: ignore[no-untyped-def]
    block, strip_flight, tmp_path: Path
) -> None:
    first = align(strip_flight, workdir=tmp_path, seed=0, bar=bar)
    np.testing.assert_array_equal(first.poses, block.poses)  # to the last bit
    stamps = {p: p.stat().st_mtime_ns for p in (tmp_path / "features").iterdir()}
    matches: list[int] = []

    @contextmanager
    def watched(step: str, what: str):  # type: ignore[no-untyped-def]
        yield lambda done, total: matches.append(total) if step == "matches" else None

    again = align(strip_flight, workdir=tmp_path, seed=0, bar=watched)
    np.testing.assert_array_equal(again.poses, block.poses)
    assert stamps == {p: p.stat().st_mtime_ns for p in (tmp_path / "features").iterdir()}
    assert matches


def test_long_flights_solve_sparse_equations_and_find_the_same(block, strip_flight, kept, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    """Flights of some hundred images do not fit a full matrix: the same equations are solved another way."""
    monkeypatch.setattr(normal_equations, "MOST_DENSE", 0)
    monkeypatch.setattr(normal_equations, "POINTS_AT_ONCE", 500)
    sparse = align(strip_flight, workdir=kept, seed=0, bar=bar)
    np.testing.assert_allclose(sparse.poses, block.poses, atol=1e-4)
    assert sparse.cameras[0].fx == pytest.approx(block.cameras[0].fx, rel=1e-6)
    assert sparse.precision.summary() == block.precision.summary()


def test_without_gps_it_is_levelled_and_not_metric(strip_flight, strips, kept) -> None:  # type: ignore[no-untyped-def]
    flight = replace(strip_flight, frames=[replace(f, gps=None) for f in strip_flight.frames])
    block = align(flight, workdir=kept, seed=0, bar=bar)
    assert len(block.frames) == 8
    assert not block.metric
    assert block.origin is None
    assert centre_errors(block, strips).max() < 0.5
    up = np.mean([p[:3, 2] for p in block.poses], axis=0)
    assert up[2] < -0.99
    assert np.median(block.poses[:, 2, 3] - np.median(block.points[:, 2])) == pytest.approx(100, rel=0.1)


def test_a_constant_error_of_the_altitude_moves_the_block_and_bends_nothing(strip_flight, strips, kept) -> None:  # type: ignore[no-untyped-def]
    frames = [replace(f, gps=replace(f.gps, altitude=f.gps.altitude - 60)) for f in strip_flight.frames]
    block = align(replace(strip_flight, frames=frames), workdir=kept, seed=0, bar=bar)
    assert block.metric
    assert centre_errors(block, strips).max() < 0.4
    assert np.ptp(block.poses[:, 2, 3]) < 15


def test_altitudes_that_are_missing_leave_scale_and_heading(strip_flight, strips, kept) -> None:  # type: ignore[no-untyped-def]
    frames = [replace(f, gps=replace(f.gps, altitude=None)) for f in strip_flight.frames]
    block = align(replace(strip_flight, frames=frames), workdir=kept, seed=0, bar=bar)
    assert block.metric
    truth = np.array([p[:3, 3] for p in strips])
    spread = np.linalg.norm(truth - truth.mean(0), axis=1)
    found = block.poses[:, :3, 3]
    np.testing.assert_allclose(np.linalg.norm(found - found.mean(0), axis=1), spread, rtol=0.05, atol=0.5)


def test_a_wrong_gps_position_is_named_and_not_used(strip_flight, strips, kept) -> None:  # type: ignore[no-untyped-def]
    frames = list(strip_flight.frames)
    fix = frames[2].gps
    assert fix is not None
    frames[2] = replace(frames[2], gps=replace(fix, latitude=fix.latitude + 0.002))
    block = align(replace(strip_flight, frames=frames), workdir=kept, seed=0, bar=bar)
    assert any(frames[2].name in warning for warning in block.warnings)
    assert centre_errors(block, strips).max() < 0.5


def test_a_single_strip_is_levelled_about_its_line(hill, strips, camera, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    poses = [p.copy() for p in strips[:4]]
    for p in poses:
        p[0, 3], p[2, 3] = 0.0, 80.0
    frames = [replace(f, gimbal=(0.0, -90.0, 0.0)) for f in hill.frames(tmp_path, camera, poses, known=False)]
    block = align(Flight(tmp_path, frames), workdir=tmp_path / "work", seed=0, bar=bar)
    assert len(block.frames) == 4
    assert block.metric
    slope = np.polyfit(block.points[:, 0], hill.off(block.points), 1)[0]
    assert abs(slope) < 0.06


def test_two_images_are_enough(hill, strips, camera, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    flight = hill.flight(tmp_path, camera, strips[:2], gps=False)
    block = align(flight, workdir=tmp_path / "work", seed=0, bar=bar)
    assert len(block.frames) == 2
    assert block.cameras[0].fx == pytest.approx(camera.fx * 1.01)  # too few to calibrate


def test_images_that_do_not_match_are_refused_with_the_way_out(camera, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(0)
    frames = []
    for i in range(3):
        path = tmp_path / f"{i}.png"
        cv2.imwrite(str(path), rng.integers(0, 255, (120, 160, 3), dtype=np.uint8))
        frames.append(Frame(path.name, path, 160, 120, focal_px=160.0))
    with pytest.raises(InputError, match="overlap by 30 %"):
        align(Flight(tmp_path, frames), workdir=tmp_path / "work", seed=0, bar=bar)
    with pytest.raises(InputError, match="two or more"):
        align(Flight(tmp_path, frames[:1]), workdir=tmp_path / "work", seed=0, bar=bar)


def test_focal_length_by_data_sheet_tags_or_film(tmp_path: Path) -> None:
    frame = Frame("a.jpg", tmp_path / "a.jpg", 4000, 3000, model="FC300S", focal_mm=3.61, focal35_mm=20.0)
    assert focal_px(frame) == pytest.approx(3.61 / 6.16 * 4000)
    assert focal_px(replace(frame, model="unheard of")) == pytest.approx(20 / 43.267 * 5000)
    assert focal_px(replace(frame, model=None, focal_px=3000.0)) == 3000
    assert focal_px(Frame("a.jpg", tmp_path / "a.jpg", 40, 30)) is None


def test_pairs_join_strips_with_gps_and_alike_images_without() -> None:
    rng = np.random.default_rng(0)
    positions = np.array([[30.0 * (i % 10), 50.0 * (i // 10), 0] for i in range(40)])
    blank = [np.zeros((0, 128), np.uint8)] * 40
    pairs = image_pairs(positions, blank)
    assert all(i < j for i, j in pairs)
    assert (5, 15) in pairs  # the neighbouring strip
    assert len(pairs) < 40 * 39 / 4
    shared = rng.integers(0, 120, (60, 128), dtype=np.uint8)
    features = [rng.integers(0, 120, (200, 128), dtype=np.uint8) for _ in range(12)]
    features[1][:60], features[9][:60] = shared, shared
    assert (1, 9) in image_pairs(None, features)
    assert (1, 6) not in image_pairs(None, features)


def test_frames_without_gps_join_those_that_have_it() -> None:
    rng = np.random.default_rng(0)
    positions = np.array([[30.0 * i, 0, 0] for i in range(12)])
    positions[7] = np.nan
    features = [rng.integers(0, 120, (200, 128), dtype=np.uint8) for _ in range(12)]
    features[2][:60] = features[7][:60]
    assert (2, 7) in image_pairs(positions, features)


def test_an_interrupted_matching_goes_on_with_the_same_pairs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the second ring had matched before the kill must not decide which of its pairs are asked for."""
    from overfly.mapping import matches

    positions = np.array([[30.0 * (i % 5), 40.0 * (i // 5), 0] for i in range(15)])
    flight = Flight(tmp_path, [Frame(f"{i}.jpg", tmp_path / f"{i}.jpg", 400, 300) for i in range(15)])
    features = [(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8))] * 15
    pairs = image_pairs(positions, [d for _, d in features])
    told: list[set[tuple[int, int]]] = []

    def asked_with(kept: list[tuple[int, int]]) -> tuple[list[list[tuple[int, int]]], int]:
        calls: list[list[tuple[int, int]]] = []
        rows = {pair: np.zeros((0, 2), np.uint32) for pair in kept}
        monkeypatch.setattr(matches, "match_pairs", lambda *args, **_: calls.append(args[2]))
        monkeypatch.setattr(matches, "read_verified", lambda *_: rows | dict.fromkeys(calls[0], rows[kept[0]]))

        def apart(asked: list, *given: Any) -> set[tuple[int, int]]:
            told.append(set(given[2]))
            return set(asked[::2])

        monkeypatch.setattr(matches, "cannot_overlap", apart)
        progress: list[tuple[int, int]] = []
        matches._match(tmp_path / "db", flight, positions, pairs, features, 0, lambda *at: progress.append(at))
        assert progress[-1] == (len(pairs), len(pairs))
        return calls, len(pairs)

    (first, rest), _ = asked_with([(0, 2)])
    assert not set(first) & set(rest)
    assert 0 < len(rest) < len(set(pairs) - set(first))
    assert {(i, i + 1) for i in range(14)} <= set(first)
    assert not {(i, i + 2) for i in range(13)} & set(first)  # the next of a line lies between them
    again, _ = asked_with(rest)
    assert again == [first, rest]
    assert told[0] == told[1] == set(first)


def test_half_of_brighton_at_half_size(shared_data, tmp_path: Path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    """The real trap: 30 % overlap, a focal length that EXIF tells 15 % wrong."""
    monkeypatch.setattr("overfly.mapping.features.FEATURES", 5000)
    flight = read_flight(shared_data("brighton_beach"))
    frames = []
    for frame in flight.frames[::2]:
        path = tmp_path / frame.name
        cv2.imwrite(str(path), cv2.resize(frame.image()[..., ::-1], (800, 450), interpolation=cv2.INTER_AREA))
        focal = None if frame.focal_px is None else frame.focal_px / 2
        frames.append(replace(frame, path=path, width=800, height=450, focal_px=focal))
    block = align(replace(flight, root=tmp_path, frames=frames), workdir=tmp_path / "work", seed=0, bar=bar)
    assert len(block.frames) == 9
    rms = block.gps_rms()
    assert rms is not None
    assert rms["horizontal_m"] < 1.0
    assert rms["vertical_m"] < 0.4


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "count", "focal"), [("warsaw_ochota_low", 39, 1316), ("tampa_sheffield_cross", 60, 475)]
)
def test_real_flights_register_completely(shared_data, name, count, focal, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    block = align(read_flight(shared_data(name)), workdir=tmp_path, seed=0, bar=bar)
    assert len(block.frames) == count
    assert block.cameras[0].fx == pytest.approx(focal, rel=0.02)
    shutil.rmtree(tmp_path)


def test_two_positions_near_each_other_do_not_tell_the_scale_and_that_is_said(strip_flight, kept) -> None:  # type: ignore[no-untyped-def]
    frames = [replace(f, gps=f.gps if i in (0, 1) else None) for i, f in enumerate(strip_flight.frames)]
    block = align(replace(strip_flight, frames=frames), workdir=kept, seed=0, bar=bar)
    assert any("The scale is known to about" in words and "2 GPS positions within" in words for words in block.warnings)
