"""The real image sets: metadata as their tables state, cameras of another program, the traps they are known for."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from overfly.flights.colmap import read_colmap
from overfly.flights.folder import read_flight
from overfly.geodesy import Origin, enu_from_geodetic
from overfly.geometry import project

SETS = {"brighton_beach": 18, "warsaw_ochota_low": 39, "tampa_sheffield_cross": 60, "boruszyn_kap": 28}


@pytest.mark.parametrize(("name", "count"), SETS.items())
def test_metadata_equal_the_table(shared_data, name, count):
    flight = read_flight(shared_data(name))
    assert len(flight) == count
    assert flight.skipped == {}
    with (flight.root / "images.csv").open() as file:
        table = {row["file"]: row for row in csv.DictReader(file)}
    assert {f.name for f in flight.frames} == set(table)
    for frame in flight.frames:
        row = table[frame.name]
        assert (frame.width, frame.height) == (int(row["width"]), int(row["height"]))
        assert (frame.make, frame.model) == (row["make"], row["model"])
        assert frame.focal_mm == float(row["focal_mm"])
        assert frame.focal35_mm == (float(row["focal35_mm"]) if row["focal35_mm"] else None)
        assert f"{frame.time:%Y:%m:%d %H:%M:%S}" == row["time"]
        if row["lat"]:
            expected = [float(row[k]) for k in ("lat", "lon", "alt_m")]
            found = [frame.gps.latitude, frame.gps.longitude, frame.gps.altitude]
            assert found == pytest.approx(expected, abs=1e-9)
        else:
            assert frame.gps is None
        if row["rel_alt_m"]:
            assert frame.relative_altitude == float(row["rel_alt_m"])
            pitch_yaw = (float(row["gimbal_pitch_deg"]), float(row["gimbal_yaw_deg"]))
            assert (frame.gimbal[1], frame.gimbal[0]) == pitch_yaw
    times = [f.time for f in flight.frames]
    assert times == sorted(times)


def test_known_traps_are_said(shared_data):
    warsaw = read_flight(shared_data("warsaw_ochota_low"))
    assert any("Orientation tag (6)" in w for w in warsaw.warnings)
    assert warsaw.frames[0].image().shape == (1200, 1600, 3)
    tampa = read_flight(shared_data("tampa_sheffield_cross"))
    assert any("below sea level" in w for w in tampa.warnings)
    assert len(tampa.gcps) == 5
    assert sum(len(p.pixels) for p in tampa.gcps) == 25
    assert read_flight(shared_data("brighton_beach")).warnings == []


@pytest.mark.parametrize(("name", "count"), SETS.items())
def test_reference_cameras_can_be_read(shared_data, name, count):
    cameras = read_colmap(shared_data(name) / "reference_colmap")
    assert len(cameras.poses) == count
    assert all(c.width in (800, 1600) for c in cameras.cameras.values())


@pytest.mark.parametrize("name", ["brighton_beach", "tampa_sheffield_cross"])
def test_reference_cameras_and_our_gps_agree(shared_data, name):
    """The stated similarity takes COLMAP's centres to ENU metres: they must lie at the GPS positions that we read."""
    root = shared_data(name)
    cameras, flight = read_colmap(root / "reference_colmap"), read_flight(root)
    lines = (root / "reference_colmap" / "colmap_to_enu_4x4.txt").read_text().splitlines()
    latitude, longitude = (float(lines[0].split(key)[1].split()[0].rstrip(",")) for key in ("lat ", "lon "))
    matrix = np.array([[float(v) for v in line.split()] for line in lines[1:5]])
    origin = Origin(latitude, longitude, 0.0)
    errors = []
    for frame in flight.frames:
        centre = matrix[:3] @ [*cameras.poses[frame.name][:3, 3], 1]
        enu = enu_from_geodetic([[frame.gps.latitude, frame.gps.longitude, 0.0]], origin)[0]
        errors.append(np.linalg.norm(centre[:2] - enu[:2]))
    assert np.sqrt(np.mean(np.square(errors))) < 0.6


def test_ground_control_points_are_seen_where_the_reference_cameras_say(shared_data):
    """Triangulated from their pixels, the control points of the set must reproject within a pixel."""
    root = shared_data("tampa_sheffield_cross")
    cameras, flight = read_colmap(root / "reference_colmap"), read_flight(root)
    for point in flight.gcps:
        rows = []
        for name, pixel in point.pixels.items():
            camera = cameras.cameras[name].undistorted()
            matrix = camera.matrix() @ np.linalg.inv(cameras.poses[name])[:3]
            rows += [pixel[0] * matrix[2] - matrix[0], pixel[1] * matrix[2] - matrix[1]]
        solution = np.linalg.svd(np.array(rows))[2][-1]
        place = solution[:3] / solution[3]
        for name, pixel in point.pixels.items():
            found, _ = project(place, cameras.cameras[name], cameras.poses[name])
            assert np.linalg.norm(found - pixel) < 1.5
