"""A camera that was calibrated before is kept, whatever lens it has, and tells what a flight alone does not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from conftest import ORIGIN, bar, nadir
from overfly.errors import InputError
from overfly.flights import ControlPoint, Flight, with_calibration, write_transforms
from overfly.geodesy import crs_from_enu
from overfly.geometry import Array, Camera, distort, pixel_grid, project, rays
from overfly.mapping.align import align
from overfly.mapping.calibration import KEPT, UNTOLD, composed, source_remarks
from overfly.mapping.map import align_flight

pytestmark = pytest.mark.usefixtures("few_features")

LENS = Camera(320, 240, 318.0, 322.0, 166.0, 115.0, k1=-0.09, k2=0.02, p1=0.002, p2=-0.001)
POSES = [nadir(0, y, 80, yaw=2 * y) for y in (-33, -11, 11, 33)]
"""One line at one height, over which no flight can tell a focal length."""


@pytest.fixture(scope="module")
def line(hill, tmp_path_factory) -> Flight:  # type: ignore[no-untyped-def]
    flight = hill.flight(tmp_path_factory.mktemp("line"), LENS, POSES)
    return replace(flight, frames=[replace(f, focal_px=1.08 * LENS.fx) for f in flight.frames])


def heights_above(block, hill) -> tuple[float, float]:  # type: ignore[no-untyped-def]
    """Median and 90 % of how far the sparse points lie from the ground, their median shift apart, metres."""
    off = hill.off(block.points)
    return tuple(np.quantile(np.abs(off - np.median(off)), [0.5, 0.9]).tolist())


def test_what_the_flight_cannot_tell_the_calibration_does(hill, line, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    guessed = align(line, workdir=tmp_path / "guessed", seed=0, bar=bar)
    known = align(with_calibration(line, [LENS], "x"), workdir=tmp_path / "known", seed=0, bar=bar)
    assert known.cameras == [LENS] * 4
    assert known.reprojection_px < 0.2
    assert np.abs(known.poses[:, 2, 3] - 80 - np.median(known.poses[:, 2, 3] - 80)).max() < 0.2
    assert heights_above(known, hill)[1] < 0.2
    assert heights_above(known, hill)[1] < 0.5 * heights_above(guessed, hill)[1]
    assert not any("focal length" in warning for warning in known.warnings)


def test_clicks_of_controls_are_straightened_too(hill, line, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    plan = np.array([[-20.0, -30], [20, -30], [20, 30], [-20, 30], [3, 0]])
    places = np.column_stack([plan, hill.height(plan)])
    points = []
    for i, (place, told) in enumerate(zip(places, crs_from_enu(places, replace(ORIGIN, epsg=32634)), strict=True)):
        pixels = {}
        for frame, pose in zip(line.frames, POSES, strict=True):
            (u, v), _ = (a[0] for a in project(place[None], LENS, pose))
            if 0 < u < LENS.width and 0 < v < LENS.height:
                pixels[frame.name] = (float(u), float(v))
        points.append(ControlPoint(f"p{i}", tuple(told.tolist()), "EPSG:32634", pixels))
    block = align(
        with_calibration(replace(line, gcps=points), [LENS], "x"), workdir=tmp_path, seed=0, bar=bar, control="all"
    )
    assert block.cameras == [LENS] * 4
    assert block.survey is not None
    found = block.survey.rms("control")
    assert found is not None
    assert found["points"] == 5
    assert max(found["x_m"], found["y_m"], found["z_m"]) < 0.1
    assert found["pixels"] < 0.5


def test_a_flight_with_cameras_of_its_own_does_not_ask_for_a_calibration(hill, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    folder = tmp_path / "flight"
    folder.mkdir()
    write_transforms(folder / "transforms.json", hill.frames(folder, LENS, POSES, known=True), ORIGIN)
    with pytest.raises(InputError, match="--cameras estimate"):
        align_flight(folder, out=tmp_path / "map", dense="stereo", calibration=str(folder), progress=False)
    _, block = align_flight(
        folder, out=tmp_path / "map", dense="stereo", cameras="estimate", calibration=str(folder), progress=False
    )
    assert block.cameras == [LENS] * 4


def test_given_cameras_and_a_calibration_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="leave one of them out"):
        align_flight(tmp_path, out=tmp_path / "map", dense="stereo", cameras="given", calibration="x", progress=False)


RAW = Camera(320, 240, 250.0, 250.5, 161.0, 122.0, k1=-0.26, k2=0.11, p1=1e-4, p2=-3e-4, k3=-0.03)
"""As survey drones store images: nothing straightened."""

WARM = replace(RAW, fx=1.002 * RAW.fx, fy=1.002 * RAW.fy, k1=-0.255)
"""The same lens on a hot day."""


def bent(lens: Camera, frame, residual: Camera, points: Array) -> Array:  # type: ignore[no-untyped-def]
    """Pixels of ideal coordinates [k, 2] by a lens and what was found on top of it."""
    straight = distort(points, residual) * residual.fx / frame.pinhole.fx
    return distort(straight, lens) * [lens.fx, lens.fy] + [lens.cx, lens.cy]


def test_a_lens_and_what_was_found_on_top_of_it_are_one_camera(line) -> None:  # type: ignore[no-untyped-def]
    frame = replace(line.frames[0], lens=RAW)
    assert composed(RAW, frame.pinhole) == RAW
    residual = replace(frame.pinhole, fx=frame.pinhole.fx * 1.01, fy=frame.pinhole.fy * 1.01, k1=0.004, k2=-0.003)
    points = rays(pixel_grid(320, 240)[::20, ::20], RAW)[..., :2].reshape(-1, 2)
    whole = composed(RAW, residual)
    found = distort(points, whole) * [whole.fx, whole.fy] + [whole.cx, whole.cy]
    inside = ((found > 0) & (found < [320, 240])).all(1)
    assert np.abs(found - bent(RAW, frame, residual, points))[inside].max() < 0.02


def test_the_lens_in_the_photos_is_where_the_calibration_starts(hill, strips, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "flight").mkdir()
    flight = hill.flight(tmp_path / "flight", WARM, strips)
    told = replace(flight, frames=[replace(f, lens=RAW, focal_px=None) for f in flight.frames])
    block = align(told, workdir=tmp_path / "told", seed=0, bar=bar)
    assert len(block.frames) == 8
    assert block.reprojection_px < 0.3
    truth = np.array([pose[:3, 3] for pose in strips])
    assert np.abs(block.poses[:, :3, 3] - truth - np.median(block.poses[:, :3, 3] - truth, axis=0)).max() < 0.3
    points = rays(pixel_grid(320, 240)[::20, ::20], WARM)[..., :2].reshape(-1, 2)
    pixels = [distort(points, c) * [c.fx, c.fy] + [c.cx, c.cy] for c in (block.cameras[0], WARM)]
    assert np.median(np.linalg.norm(pixels[0] - pixels[1], axis=1)) < 0.5
    assert not any("focal length" in warning for warning in block.warnings)
    doubled = replace(RAW, fx=2 * RAW.fx, fy=2 * RAW.fy)
    cut = replace(flight, frames=[replace(f, lens=doubled) for f in flight.frames])
    block = align(cut, workdir=tmp_path / "cut", seed=0, bar=bar)
    assert any("DewarpData" in warning and "was not used" in warning for warning in block.warnings)


def test_a_calibration_tells_what_its_map_doubted_also_over_two_maps(tmp_path: Path) -> None:
    told = tmp_path / "map.json"
    for said, remarks in ((f'["{UNTOLD}: ..."]', 1), (f'["{KEPT} (x): ..."]', 1), ('["else"]', 0), ("null", 0)):
        told.write_text(f'{{"warnings": {said}}}')
        for path in (tmp_path, tmp_path / "transforms.json"):
            assert len(source_remarks(path)) == remarks
    assert source_remarks(tmp_path / "elsewhere" / "cameras.txt") == []


def test_a_calibration_of_another_camera_is_held_against_the_photos_data(hill, line, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    other = replace(LENS, fx=2 * LENS.fx, fy=2 * LENS.fy)
    block = align(with_calibration(line, [other], "x"), workdir=tmp_path, seed=0, bar=bar)
    assert any("The calibration has a focal length of 640 px, the photos' data say 343" in w for w in block.warnings)
