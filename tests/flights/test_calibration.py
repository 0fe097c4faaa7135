"""Calibrated cameras: from the files of other programs and of a map, to the frames that they fit."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from overfly.errors import InputError
from overfly.flights import Flight, Frame, read_calibration, with_calibration, write_transforms
from overfly.geometry import Camera, project

LENS = Camera(1600, 1200, 1100.0, 1102.0, 807.0, 596.0, -0.1, 0.02, 0.001, -0.002, 0.003)
POSE = np.eye(4)


def frames(*sizes: tuple[int, int]) -> Flight:
    return Flight(Path(), [Frame(f"{i}.jpg", Path(f"{i}.jpg"), *size) for i, size in enumerate(sizes)])


def written(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def test_the_cameras_of_a_map_whose_images_are_gone(tmp_path: Path) -> None:
    known = [
        Frame(f"{i}.jpg", tmp_path / "gone" / f"{i}.jpg", 1600, 1200, camera=camera, world_from_camera=POSE)
        for i, camera in enumerate((LENS, replace(LENS, fx=900.0), LENS))
    ]
    write_transforms(tmp_path / "map" / "transforms.json", known[:1], None)
    assert read_calibration(tmp_path / "map") == [LENS]
    write_transforms(tmp_path / "two.json", known, None)
    assert read_calibration(tmp_path / "two.json") == [LENS, replace(LENS, fx=900.0)]


def test_files_of_other_programs_hold_the_same_camera(tmp_path: Path) -> None:
    alone = {"fl_x": 1100, "fl_y": 1102, "cx": 807, "cy": 596, "w": 1600, "h": 1200}
    alone |= {"k1": -0.1, "k2": 0.02, "p1": 0.001, "p2": -0.002, "k3": 0.003}
    odm = {"projection_type": "brown", "width": 1600, "height": 1200, "focal_x": 1100 / 1600, "focal_y": 1102 / 1600}
    odm |= {"c_x": 7 / 1600, "c_y": -4 / 1600, "k1": -0.1, "k2": 0.02, "p1": 0.001, "p2": -0.002, "k3": 0.003}
    colmap = "# comment\n1 FULL_OPENCV 1600 1200 1100 1102 807 596 -0.1 0.02 0.001 -0.002 0.003 0 0 0\n"
    for file in (
        written(tmp_path / "camera.json", json.dumps(alone)),
        written(tmp_path / "odm" / "cameras.json", json.dumps({"v2 dji": odm})),
        written(tmp_path / "sfm" / "reconstruction.json", json.dumps([{"cameras": {"v2 dji": odm}, "shots": {}}])),
        written(tmp_path / "model" / "sparse" / "0" / "cameras.txt", colmap),
    ):
        for given in {file, tmp_path / "odm", tmp_path / "sfm", tmp_path / "model"} & {file, *file.parents}:
            (camera,) = read_calibration(given)
            assert np.allclose(list(camera.to_dict().values()), list(LENS.to_dict().values())), given


def test_a_camera_is_scaled_to_the_images(tmp_path: Path) -> None:
    flight = with_calibration(frames((800, 600), (1600, 1200)), [LENS], "x")
    assert flight.frames[0].calibration == LENS.resized(800, 600)
    assert flight.frames[1].calibration == LENS


def test_straight_pixels_are_those_of_a_pinhole() -> None:
    (frame,) = with_calibration(frames((1600, 1200)), [LENS], "x").frames
    points = np.array([[0.3, 0.2, 1.0], [-0.5, 0.4, 1.0], [0.0, 0.0, 1.0]])
    assert frame.pinhole is not None
    bent, straight = (project(points, camera, POSE)[0] for camera in (LENS, frame.pinhole))
    assert np.abs(bent - straight).max() > 5
    assert np.allclose(frame.straight(bent), straight, atol=1e-6)
    (plain,) = frames((1600, 1200)).frames
    assert np.array_equal(plain.straight(bent), bent)


@pytest.mark.parametrize(
    ("size", "cameras", "sentence"),
    [
        ((1600, 900), [LENS], "another shape"),
        ((800, 600), [LENS, replace(LENS, fx=900.0)], "2 different cameras"),
    ],
)
def test_a_camera_that_does_not_fit_is_refused(size: tuple[int, int], cameras: list[Camera], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        with_calibration(frames(size), cameras, "x")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("{", "not valid JSON"),
        ("{}", "holds no camera"),
        ('{"fl_x": 900}', "no image size"),
        ('{"fl_x": 900, "w": 1600, "h": 1200, "k1": -0.9}', "no inverse at the border"),
        ('{"a": {"projection_type": "fisheye", "width": 4, "height": 3, "focal": 1}}', "fisheye"),
    ],
)
def test_a_file_without_a_usable_camera_is_refused(tmp_path: Path, text: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        read_calibration(written(tmp_path / "camera.json", text))


def test_nothing_there_is_said(tmp_path: Path) -> None:
    for path, sentence in (
        (written(tmp_path / "empty" / "notes.txt", "").parent, "holds no cameras"),
        (tmp_path / "absent.json", "does not exist"),
        (written(tmp_path / "cloud.laz", "LASF"), "is no file of cameras"),
        (written(tmp_path / "map.json", '{"seconds": {"dense": 1.0}, "images": 9}'), "holds no camera"),
        (written(tmp_path / "cameras.txt", "1 SIMPLE_RADIAL 480 320 -100 240 160 0\n"), "focal length -100"),
    ):
        with pytest.raises(InputError, match=sentence) as told:
            read_calibration(path)
        assert "-100" in str(told.value) or "cameras.txt or .bin" in str(told.value)
