"""What real flights get wrong: GPS, altitudes, focal lengths, antennas, gaps; the cameras must be right regardless."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from conftest import ORIGIN, bar, nadir
from overfly.flights import Flight, Gps
from overfly.geodesy import enu_from_geodetic, geodetic_from_enu
from overfly.geometry import fit_similarity, transform
from overfly.mapping.align import align

pytestmark = pytest.mark.usefixtures("few_features")


@pytest.fixture(scope="module")
def flight(hill, strips, camera, tmp_path_factory) -> Flight:  # type: ignore[no-untyped-def]
    return hill.flight(tmp_path_factory.mktemp("strips"), camera, strips)


@pytest.fixture(scope="module")
def work(flight, tmp_path_factory) -> Path:  # type: ignore[no-untyped-def]
    folder = Path(tmp_path_factory.mktemp("work"))
    align(flight, workdir=folder, seed=0, bar=bar)
    return folder


@pytest.fixture
def kept(work, tmp_path: Path) -> Path:  # type: ignore[no-untyped-def]
    return Path(shutil.copytree(work, tmp_path / "work"))


def fix(position) -> Gps:  # type: ignore[no-untyped-def]
    latitude, longitude, height = geodetic_from_enu(position, ORIGIN)[0]
    return Gps(float(latitude), float(longitude), float(height))


def told(flight: Flight, away) -> Flight:  # type: ignore[no-untyped-def]
    """The flight with GPS positions that are ``away`` [n, 3] metres from the truth."""
    frames = []
    for frame, off in zip(flight.frames, away, strict=True):
        g = frame.gps
        position = enu_from_geodetic([[g.latitude, g.longitude, g.altitude]], ORIGIN)[0]
        frames.append(replace(frame, gps=fix(position + off)))
    return replace(flight, frames=frames)


def errors(block, poses) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Distances [n] of the cameras from the truth as they stand on the Earth, metres."""
    found = enu_from_geodetic(geodetic_from_enu(block.poses[:, :3, 3], block.origin), ORIGIN)
    return np.linalg.norm(found - np.array([p[:3, 3] for p in poses]), axis=1)


def turns(block, poses) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Angles [n] of the cameras from the truth, degrees."""
    cosines = [(np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2 for a, b in zip(block.poses, poses, strict=True)]
    return np.rad2deg(np.arccos(np.clip(cosines, -1, 1)))


def test_two_of_eight_positions_wrong_by_15_m(flight, strips, kept) -> None:  # type: ignore[no-untyped-def]
    away = np.zeros((8, 3))
    away[2], away[5] = [15, 0, 0], [0, -12, 9]
    block = align(told(flight, away), workdir=kept, seed=0, bar=bar)
    assert errors(block, strips).max() < 0.5
    assert turns(block, strips).max() < 0.5
    assert any("02.png" in w and "05.png" in w and "far off" in w for w in block.warnings)


def test_three_altitudes_above_another_level(flight, strips, kept) -> None:  # type: ignore[no-untyped-def]
    away = np.zeros((8, 3))
    away[5:, 2] = 60
    block = align(told(flight, away), workdir=kept, seed=0, bar=bar)
    assert errors(block, strips).max() < 0.5
    assert turns(block, strips).max() < 0.5
    assert any("altitude of 3 images" in w and "60 m" in w for w in block.warnings)


def test_altitudes_with_the_wrong_sign_are_left_out_and_said_so(flight, strips, kept) -> None:  # type: ignore[no-untyped-def]
    heights = np.array([p[2, 3] for p in strips])
    away = np.zeros((8, 3))
    away[:, 2] = -2 * heights
    block = align(told(flight, away), workdir=kept, seed=0, bar=bar)
    assert any("sign is wrong" in w for w in block.warnings)
    found = enu_from_geodetic(geodetic_from_enu(block.poses[:, :3, 3], block.origin), ORIGIN)
    rises = found[:, 2] - heights
    assert np.ptp(rises) < 1.0  # shape kept; the height as a whole is lost
    assert block.precision is not None
    assert block.precision.why_not is not None


def test_noisy_gps_bends_nothing(flight, strips, kept) -> None:  # type: ignore[no-untyped-def]
    away = np.random.default_rng(2).normal(0, 1.5, (8, 3))
    block = align(told(flight, away), workdir=kept, seed=0, bar=bar)
    found, truth = block.poses[:, :3, 3], np.array([p[:3, 3] for p in strips])
    left = np.linalg.norm(transform(fit_similarity(found, truth), found) - truth, axis=1)
    assert np.median(left) < 0.12  # half a pixel on the ground
    assert block.precision is not None
    assert block.precision.position_m is not None
    assert (block.precision.position_m > 0.1).all()  # the noise of GPS is in it


def test_gps_that_some_frames_lack(flight, strips, kept) -> None:  # type: ignore[no-untyped-def]
    frames = [replace(f, gps=None) if i in (1, 4, 7) else f for i, f in enumerate(flight.frames)]
    block = align(replace(flight, frames=frames), workdir=kept, seed=0, bar=bar)
    assert len(block.frames) == 8
    assert errors(block, strips).max() < 0.6


def test_an_antenna_that_is_not_at_the_camera(flight, strips, kept) -> None:  # type: ignore[no-untyped-def]
    """Survey-grade GPS half a metre ahead of the camera, on lines flown to and fro."""
    arm = np.array([0.0, -0.5, 0.0])  # camera axes: up in the image is ahead
    moved = told(flight, [p[:3, :3] @ arm for p in strips])
    frames = [replace(f, gps=replace(f.gps, horizontal_m=0.02, vertical_m=0.03)) for f in moved.frames]
    block = align(replace(moved, frames=frames), workdir=kept, seed=0, bar=bar)
    assert errors(block, strips).max() < 0.25


def test_a_focal_length_8_percent_off_gives_way_to_strong_geometry(flight, strips, camera, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    frames = [replace(f, focal_px=camera.fx * 1.08) for f in flight.frames]
    block = align(replace(flight, frames=frames), workdir=tmp_path, seed=0, bar=bar)
    assert block.cameras[0].fx == pytest.approx(camera.fx, rel=0.03)
    assert not any("do not tell the focal length" in warning for warning in block.warnings)


def test_a_focal_length_holds_where_the_images_cannot_tell(hill, camera, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    """One nadir line at 50 %: height and focal length are one unknown."""
    poses = [nadir(0, (i - 1.5) * 30) for i in range(4)]
    frames = hill.frames(tmp_path, camera, poses, known=False)
    frames = [replace(f, focal_px=camera.fx, gimbal=(0.0, -90.0, 0.0)) for f in frames]
    block = align(Flight(tmp_path, frames), workdir=tmp_path / "work", seed=0, bar=bar)
    assert block.cameras[0].fx == pytest.approx(camera.fx, rel=0.02)
    assert any("do not tell the focal length" in warning for warning in block.warnings)
    spacing = np.linalg.norm(np.diff(block.poses[:, :3, 3], axis=0), axis=1)
    np.testing.assert_allclose(spacing, 30, rtol=0.02)


def test_parts_without_common_points_are_placed_by_their_own_gps(hill, camera, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(5)
    poses = [
        nadir(x + rng.normal(0, 1), (i - (n - 1) / 2) * 22, 80 + rng.normal(0, 1), roll=rng.normal(0, 1))
        for x, n in ((-65.0, 5), (65.0, 4))
        for i in range(n)
    ]
    frames = [replace(f, gimbal=(0.0, -90.0, 0.0)) for f in hill.frames(tmp_path, camera, poses, known=False)]
    block = align(Flight(tmp_path, frames), workdir=tmp_path / "work", seed=0, bar=bar)
    assert len(block.frames) == 9
    assert block.held_by_gps == [f"{i:02d}.png" for i in range(5, 9)]
    assert any("held by GPS only" in w for w in block.warnings)
    assert errors(block, poses).max() < 1.0
    assert np.median(np.abs(hill.off(enu_from_geodetic(geodetic_from_enu(block.points, block.origin), ORIGIN)))) < 1.0
