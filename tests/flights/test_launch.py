"""Whole synthetic flights: the folder is complete, repeatable, resumable, and its images agree with its cameras."""

from __future__ import annotations

import json

import numpy as np
import pytest

from overfly.cloud import read_cloud
from overfly.errors import InputError
from overfly.flights import fly, read_flight
from overfly.flights.cameras import camera_preset
from overfly.flights.launch import default_area
from overfly.flights.reference import seen
from overfly.geodesy import enu_from_geodetic

SMALL = {"width": 96, "altitude": 60, "frames": 6, "overlap": 60, "reference_points": 3000, "supersample": 1}


@pytest.fixture(scope="module")
def scene():
    from overfly.scenes import make_scene

    return make_scene("suburb", 1, size_m=200)


@pytest.fixture(scope="module")
def flown(scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("fly") / "flight"
    plan, frames = fly(scene, out=out, seed=5, **SMALL)
    return out, plan, frames


def test_the_folder_is_a_flight(flown):
    out, plan, frames = flown
    flight = read_flight(out)
    assert len(flight) == len(plan) == len(frames) == 6
    assert flight.warnings == []
    assert flight.facts["flight_path"] == "grid"
    assert flight.facts["measured_overlap"] == pytest.approx(60, abs=0.5)
    assert flight.facts["camera"] == "p4p"
    assert flight.frames[0].model == "FC6310"
    assert flight.frames[0].focal_mm == 8.8
    for frame, pose in zip(flight.frames, plan.world_from_camera, strict=True):
        assert np.allclose(frame.world_from_camera, pose, atol=1e-12)
        place = [[frame.gps.latitude, frame.gps.longitude, frame.gps.altitude]]
        assert np.allclose(enu_from_geodetic(place, flight.origin)[0], pose[:3, 3], atol=2e-3)
        assert frame.relative_altitude == pytest.approx(60, abs=1e-3)
        assert frame.image().std() > 5
    assert not list(out.glob("**/.*"))


def test_reference_points_are_surface_that_a_frame_sees(flown, scene):
    from overfly.scenes import Renderer

    out, plan, _ = flown
    cloud = read_cloud(out / "reference.laz")
    assert 1500 < len(cloud) <= 3000
    assert cloud.colors is not None
    renderer = Renderer(scene)
    times = sum(
        seen(cloud.points, renderer.depth(plan.camera, p), plan.camera, p).astype(int) for p in plan.world_from_camera
    )
    assert (times > 0).mean() > 0.99  # LAZ rounds to millimetres


def test_the_same_call_renders_nothing_and_finishes_what_is_missing(flown, scene):
    out, _, frames = flown
    stamps = {f.path: f.path.stat().st_mtime_ns for f in frames}
    kept = frames[2].path.read_bytes()
    frames[2].path.unlink()
    whole = frames[4].path.read_bytes()
    frames[4].path.write_bytes(whole[:-100])
    (out / "transforms.json").unlink()
    leftover = out / "images" / ".frame_0003.jpg.abc"
    leftover.mkdir()
    (leftover / "frame_0003.jpg").write_bytes(b"half")
    fly(scene, out=out, seed=5, **SMALL)
    assert frames[2].path.read_bytes() == kept
    assert frames[4].path.read_bytes() == whole
    assert not leftover.exists()
    untouched = [f.path for i, f in enumerate(frames) if i not in (2, 4)]
    assert all(p.stat().st_mtime_ns == stamps[p] for p in untouched)
    assert len(read_flight(out)) == 6


def test_a_folder_with_something_else_is_left_alone(flown, scene, tmp_path):
    out, _, _ = flown
    with pytest.raises(InputError, match="holds another flight"):
        fly(scene, out=out, seed=6, **SMALL)
    (tmp_path / "mine.txt").write_text("precious")
    with pytest.raises(InputError, match="is not empty"):
        fly(scene, out=tmp_path, **SMALL)
    with pytest.raises(InputError, match="is a file"):
        fly(scene, out=tmp_path / "mine.txt", **SMALL)


def test_noise_goes_to_the_metadata_only(scene, tmp_path):
    options = SMALL | {"frames": 3, "reference_points": 0}
    plan, _ = fly(scene, out=tmp_path / "n", noise="gps", seed=2, **options)
    flight = read_flight(tmp_path / "n")
    assert flight.reference is None
    for frame, pose in zip(flight.frames, plan.world_from_camera, strict=True):
        assert np.allclose(frame.world_from_camera, pose, atol=1e-12)
        place = [[frame.gps.latitude, frame.gps.longitude, frame.gps.altitude]]
        assert 0.1 < np.linalg.norm(enu_from_geodetic(place, flight.origin)[0] - pose[:3, 3]) < 60
    assert json.loads((tmp_path / "n" / "transforms.json").read_text())["overfly"]["noise"]["horizontal_m"] == 1.0


@pytest.mark.slow
def test_two_processes_write_the_same_bytes(flown, scene, tmp_path):
    _, _, frames = flown
    _, again = fly(scene, out=tmp_path / "two", seed=5, processes=2, **SMALL)
    assert [f.path.read_bytes() for f in again] == [f.path.read_bytes() for f in frames]


def test_default_area_gives_five_by_five_frames():
    camera = camera_preset("p4p", 800)
    east, north = default_area("grid", camera, 150, 50, 50, 0)
    assert (east, north) == pytest.approx((225 * 3, 150 * 3), rel=0.01)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"overlap": 120}, "overlap=120 is not allowed"),
        ({"altitude": -5}, "altitude=-5 is not allowed"),
        ({"flight_path": "zigzag"}, "'zigzag' is unknown"),
        ({"camera": "gopro"}, "'gopro' is unknown"),
        ({"noise": "loud"}, "'loud' is unknown"),
        ({"seed": -1}, "seed=-1"),
        ({"processes": 0}, "processes=0"),
        ({"area_m": 0}, "area_m=0"),
        ({"scene": "moon"}, "'moon' is unknown"),
    ],
)
def test_bad_input_leaves_no_folder(tmp_path, change, sentence):
    options = {"scene": "suburb", "out": tmp_path / "flight"} | change
    with pytest.raises(InputError, match=sentence):
        fly(options.pop("scene"), **options)
    assert not (tmp_path / "flight").exists()


def test_the_reference_has_a_point_for_each_ground_pixel_within_limits(tmp_path, scene, monkeypatch):
    wanted = []
    monkeypatch.setattr("overfly.flights.launch.write_reference", lambda *arguments: wanted.append(arguments[3]))
    monkeypatch.setattr("overfly.flights.launch.REFERENCE", (10, 10_000_000))
    options = SMALL | {"frames": 3, "reference_points": None}
    fly(scene, out=tmp_path / "a", seed=3, **options)
    assert 96 * 72 < wanted[0] < 3 * 96 * 72  # three images of that size, which overlap
    monkeypatch.setattr("overfly.flights.launch.REFERENCE", (10, 500))
    fly(scene, out=tmp_path / "b", seed=3, **options)
    assert wanted[1] == 500
