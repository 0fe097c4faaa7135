"""Cameras that the folder holds, and what ground control makes of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from overfly.flights import ControlPoint, Flight, Frame
from overfly.flights.georeference import moved_poses
from overfly.geodesy import Origin, crs_from_enu, geodetic_from_enu
from overfly.geometry import Array, Camera, pose, project, rotation_from_gimbal
from overfly.mapping.block import Block, read_block, write_block
from overfly.mapping.given import given_block

CAMERA = Camera(800, 600, 600.0, 610.0, 395.0, 305.0, k1=-0.1, k2=0.02)
ORIGIN = Origin(46.0, 8.0, 450.0, 32632)
POSES = np.stack([pose(rotation_from_gimbal(5.0 * i, -85), [20.0 * i, 15.0 * (i % 2), 90]) for i in range(6)])
PLACES = np.array([[10.0, -20, 3], [80, 30, 1], [40, 30, -2], [20, 25, 0], [70, -25, 4], [50, 0, 0]])
FREE = np.eye(4)
FREE[:3, :3] = 0.03 * Rotation.from_euler("xyz", [160, 20, 70], degrees=True).as_matrix()
FREE[:3, 3] = 1, 2, 3


def flight(matrix: Array, origin: Origin | None, facts: dict[str, str], wrong: float = 0.0) -> Flight:
    """Six images of six control points, the cameras moved by ``matrix``; the second point is surveyed so wrong."""
    frames = [
        Frame(f"{i}.png", Path(f"{i}.png"), 800, 600, camera=CAMERA, world_from_camera=moved)
        for i, moved in enumerate(moved_poses(matrix, POSES))
    ]
    surveyed = crs_from_enu(PLACES, ORIGIN)
    surveyed[1, 2] += wrong
    points = []
    for i, (place, told) in enumerate(zip(PLACES, surveyed, strict=True)):
        pixels = {}
        for frame, at in zip(frames, POSES, strict=True):
            (u, v), _ = (a[0] for a in project(place[None], CAMERA, at))
            if np.isfinite(u) and 0 < u < 800 and 0 < v < 600:
                pixels[frame.name] = (float(u), float(v))
        points.append(ControlPoint(f"p{i}", tuple(told.tolist()), "EPSG:32632", pixels))
    return Flight(Path("f"), frames, origin=origin, cameras_from="sparse/0", gcps=points, facts=facts)


def stands(block: Block) -> Array:
    assert block.origin is not None
    return geodetic_from_enu(block.poses[:, :3, 3], block.origin)


@pytest.mark.parametrize("located", [False, True])
def test_controls_place_a_model_that_stands_nowhere_or_by_gps_alone(located: bool, tmp_path: Path) -> None:
    shifted = np.eye(4)
    shifted[:3, 3] = 3, -2, 5
    found = flight(shifted, ORIGIN, {"located": "By GPS."}) if located else flight(FREE, None, {})
    block = given_block(found, "split")
    assert block.metric
    assert block.origin is not None
    assert block.origin.epsg == 32632
    off = (stands(block) - geodetic_from_enu(POSES[:, :3, 3], ORIGIN)) * [111_200, 77_000, 1]
    assert np.abs(off).max() < 0.01
    assert block.survey is not None
    assert [p.role for p in block.survey.points].count("check") == 2
    checks = block.survey.rms("check")
    assert checks is not None
    assert max(checks["x_m"], checks["y_m"], checks["z_m"]) < 0.01
    write_block(block, tmp_path)
    np.testing.assert_allclose(read_block(tmp_path, found).poses, block.poses)
    assert given_block(found, "none").survey is None


def test_cameras_that_stand_on_the_earth_are_checked_and_stay() -> None:
    shifted = np.eye(4)
    shifted[:3, 3] = 0.5, 0, -1.5
    found = flight(shifted, ORIGIN, {})
    block = given_block(found, "split")
    np.testing.assert_array_equal(block.poses, given_block(found, "none").poses)
    assert block.survey is not None
    assert {p.role for p in block.survey.points} == {"check"}
    for point in block.survey.points:
        np.testing.assert_allclose(point.residual, (0.5, 0, -1.5), atol=0.01)  # type: ignore[arg-type]
    assert any("all 6 points that two images see check it" in words for words in block.warnings)


def test_one_wrong_control_of_four_does_not_tilt_cameras_that_gps_has_placed() -> None:
    found = flight(np.eye(4), ORIGIN, {"located": "By GPS."}, wrong=30.0)
    block = given_block(replace(found, gcps=found.gcps[:4]), "all")
    assert any("p1 contradicts the others" in words for words in block.warnings)
    off = (stands(block) - geodetic_from_enu(POSES[:, :3, 3], ORIGIN)) * [111_200, 77_000, 1]
    assert np.abs(off).max() < 0.05
    assert "By GPS." not in block.warnings  # the controls hold it now
    assert "By GPS." in given_block(found, "none").warnings


def test_a_wrong_point_is_named_and_too_few_place_nothing() -> None:
    block = given_block(flight(FREE, None, {}, wrong=12.0), "all")
    assert any("p1 contradicts the others" in words for words in block.warnings)
    assert any("nothing checks it" in words for words in block.warnings)
    found = flight(FREE, None, {})
    for gcps, words in ((found.gcps[:2], "2 points cannot place the cameras"), (found.gcps[:3], None)):
        block = given_block(replace(found, gcps=gcps), "split")
        assert block.metric == (words is None)
        assert words is None or any(words in sentence for sentence in block.warnings)
    blind = [replace(point, pixels=dict(list(point.pixels.items())[:1])) for point in found.gcps]
    block = given_block(replace(found, gcps=blind), "split")
    assert not block.metric
    assert any("0 of 6 points are seen in two or more images" in sentence for sentence in block.warnings)
