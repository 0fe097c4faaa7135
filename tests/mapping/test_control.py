"""Ground control holds the map, check points tell its accuracy, and what is wrong in the file is named and left out."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from conftest import ORIGIN, bar
from overfly.flights import ControlPoint, Flight
from overfly.geodesy import crs_from_enu, enu_from_geodetic, geodetic_from_enu
from overfly.geometry import fit_similarity, project, transform
from overfly.mapping.align import align
from overfly.mapping.block import read_block, write_block
from overfly.mapping.control import checks_of, consistent

pytestmark = pytest.mark.usefixtures("few_features")

CRS = "EPSG:32634"
ZONE = replace(ORIGIN, epsg=32634)
SHIFT = np.array([2.0, -1.0, -40.0])
"""Of the controls against GPS, metres."""

PLACES = np.array([[-30.0, -30], [30, -30], [30, 30], [-30, 30], [0, 5], [10, -20], [-12, 22], [22, 8]])


@pytest.fixture(scope="module")
def ruled(hill, strips, camera, tmp_path_factory) -> Flight:  # type: ignore[no-untyped-def]
    """The strips with eight exact control points, whose heights are 40 m below those of the GPS."""
    flight = hill.flight(tmp_path_factory.mktemp("ruled"), camera, strips)
    places = np.column_stack([PLACES, hill.height(PLACES)])
    surveyed = crs_from_enu(places, ZONE) + SHIFT
    points = []
    for i, (place, told) in enumerate(zip(places, surveyed, strict=True)):
        pixels = {}
        for frame, pose in zip(flight.frames, strips, strict=True):
            (u, v), _ = (a[0] for a in project(place[None], camera, pose))
            if np.isfinite(u) and 3 < u < camera.width - 3 and 3 < v < camera.height - 3:
                pixels[frame.name] = (float(u), float(v))
        points.append(ControlPoint(f"p{i}", tuple(told.tolist()), CRS, pixels))
    return replace(flight, gcps=points)


@pytest.fixture(scope="module")
def work(ruled, tmp_path_factory) -> Path:  # type: ignore[no-untyped-def]
    folder = Path(tmp_path_factory.mktemp("work"))
    align(ruled, workdir=folder, seed=0, bar=bar, control="none")
    return folder


@pytest.fixture
def kept(work, tmp_path: Path) -> Path:  # type: ignore[no-untyped-def]
    return Path(shutil.copytree(work, tmp_path / "work"))


def centre_errors(block, poses) -> np.ndarray:  # type: ignore[no-untyped-def]
    truth = np.array([p[:3, 3] for p in poses])
    found = block.poses[:, :3, 3]
    return np.linalg.norm(transform(fit_similarity(found, truth), found) - truth, axis=1)


def changed(flight: Flight, number: int, **changes) -> Flight:  # type: ignore[no-untyped-def]
    gcps = [replace(p, **changes) if i == number else p for i, p in enumerate(flight.gcps)]
    return replace(flight, gcps=gcps)


def test_controls_place_the_block_and_check_points_tell_how_well(ruled, strips, kept, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    block = align(ruled, workdir=kept, seed=0, bar=bar)
    assert block.survey is not None
    controls, checks = block.survey.rms("control"), block.survey.rms("check")
    assert controls is not None
    assert checks is not None
    assert (controls["points"], checks["points"]) == (6, 2)
    assert max(checks["x_m"], checks["y_m"]) < 0.05
    assert checks["z_m"] < 0.15
    assert block.survey.gps_shift_m is not None
    east, north, up = block.survey.gps_shift_m
    assert (east, north) == pytest.approx((-2, 1), abs=0.15)
    assert up == pytest.approx(40, abs=0.7)  # half a percent of focal length is 0.4 m of the cameras' height
    assert any("m above the controls" in w for w in block.warnings)
    assert block.origin is not None
    assert block.origin.crs_epsg == 32634  # the controls' own
    found = crs_from_enu(block.poses[:, :3, 3], block.origin)
    truth = crs_from_enu(np.array([p[:3, 3] for p in strips]), ZONE) + SHIFT
    assert np.linalg.norm(found - truth, axis=1).max() < 0.7
    rms = block.gps_rms()
    assert rms is not None
    assert rms["horizontal_m"] < 0.2  # the common shift is not in it
    write_block(block, tmp_path)
    again = read_block(tmp_path, ruled)
    assert again.survey == block.survey
    assert again.precision is not None
    assert block.precision is not None
    np.testing.assert_array_equal(again.precision.position_m, block.precision.position_m)
    assert again.links == block.links


def test_without_gps_three_controls_make_it_metric(ruled, strips, kept) -> None:  # type: ignore[no-untyped-def]
    blind = replace(ruled, frames=[replace(f, gps=None) for f in ruled.frames], gcps=ruled.gcps[:3])
    block = align(blind, workdir=kept, seed=0, bar=bar)
    assert block.metric
    assert block.origin is not None
    found = crs_from_enu(block.poses[:, :3, 3], block.origin)
    truth = crs_from_enu(np.array([p[:3, 3] for p in strips]), ZONE) + SHIFT
    assert np.linalg.norm(found - truth, axis=1).max() < 1.0
    assert any("nothing checks it" in w for w in block.warnings)
    two = replace(blind, gcps=ruled.gcps[:2])
    block = align(two, workdir=kept, seed=0, bar=bar)
    assert not block.metric


def test_controls_from_a_map_hold_the_block_but_do_not_bend_it(ruled, strips, kept) -> None:  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(4)
    noisy = [replace(p, position=tuple((np.array(p.position) + rng.normal(0, 1, 3)).tolist())) for p in ruled.gcps]
    block = align(replace(ruled, gcps=noisy), workdir=kept, seed=0, bar=bar, control="all")
    assert block.survey is not None
    assert block.survey.sigma_m is not None
    assert 0.4 < block.survey.sigma_m[0] < 2  # as it is
    assert centre_errors(block, strips).max() < 0.3
    controls = block.survey.rms("control")
    assert controls is not None
    assert controls["points"] == 8


def test_a_wrong_point_a_wrong_click_and_an_absent_image_are_named_and_not_used(ruled, kept) -> None:  # type: ignore[no-untyped-def]
    east, north, up = ruled.gcps[4].position
    flight = changed(ruled, 4, position=(east + 3, north, up))
    most = max(ruled.gcps[5].pixels)
    u, v = ruled.gcps[5].pixels[most]
    flight = changed(flight, 5, pixels={**ruled.gcps[5].pixels, most: (u + 40, v)})
    flight = changed(flight, 6, pixels={**ruled.gcps[6].pixels, "nowhere.jpg": (5.0, 5.0)})
    flight = changed(flight, 7, pixels={**ruled.gcps[7].pixels, ruled.frames[0].name: (900.0, 5.0)})
    block = align(flight, workdir=kept, seed=0, bar=bar, control="all")
    assert block.survey is not None
    assert [p.name for p in block.survey.points if p.role == "unused"] == ["p4"]
    told = " ".join(block.warnings)
    for words in ("p4 contradicts", "One click of p5", "nowhere.jpg", "p7 in"):
        assert words in told
    controls = block.survey.rms("control")
    assert controls is not None
    assert max(controls["x_m"], controls["y_m"]) < 0.05


def test_two_points_are_not_used_and_said_so(ruled, strips, kept) -> None:  # type: ignore[no-untyped-def]
    block = align(replace(ruled, gcps=ruled.gcps[:2]), workdir=kept, seed=0, bar=bar)
    assert any("three are needed" in w for w in block.warnings)
    assert block.survey is not None
    assert block.survey.rms("control") is None
    assert block.origin is not None
    found = enu_from_geodetic(geodetic_from_enu(block.poses[:, :3, 3], block.origin), ORIGIN)
    assert np.linalg.norm(found - [p[:3, 3] for p in strips], axis=1).max() < 0.5  # by GPS


def test_checks_lie_between_the_controls_and_one_blunder_in_five_is_found() -> None:
    places = np.column_stack([PLACES, np.zeros(8)])
    check = checks_of(places)
    assert check.sum() == 2
    assert not check_holds_the_corners(check)
    assert checks_of(places[:3]).sum() == 0
    assert checks_of(places[:4]).sum() == 1
    rng = np.random.default_rng(0)
    target = places[:5] + rng.normal(0, 0.05, (5, 3))
    source = transform(fit_similarity(places[:3], 3 * places[:3, [1, 0, 2]] * [1, -1, 1]), places[:5])
    assert consistent(source, target, metric=False).all()
    target[3] += [5.0, 0, 0]
    np.testing.assert_array_equal(consistent(source, target, metric=False), [True, True, True, False, True])


def check_holds_the_corners(check: np.ndarray) -> bool:
    """Whether more than one of the four corners is left to the checks."""
    return bool(check[:4].sum() > 1)
