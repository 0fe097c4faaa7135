"""The flight folder: order, odd files, and one clear sentence for each kind of bad input."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from PIL import Image
from small_flight import ORIGIN, textured

from overfly.cloud import Cloud
from overfly.errors import InputError
from overfly.flights.exif import exif_bytes
from overfly.flights.flight import Gps
from overfly.flights.folder import read_flight
from overfly.flights.write import FIRST_FRAME_TIME
from overfly.geodesy import enu_from_geodetic
from overfly.geometry import gimbal_from_rotation


def save(path, seed=0, size=(48, 64), **more):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(textured(seed, *size)).save(path, **more)
    return path


def edit(root, change):
    path = root / "transforms.json"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def test_a_written_flight_is_read_back(make_flight):
    points = np.random.default_rng(0).normal(size=(50, 3))
    facts = {"altitude": 100.0, "scene": "suburb-0"}
    root, written = make_flight(5, facts=facts, reference=Cloud(points), ground_height=-3.0)
    flight = read_flight(root)
    assert flight.cameras_from == "transforms.json"
    assert flight.warnings == []
    assert flight.has_cameras
    assert flight.reference == root / "reference.laz"
    assert flight.facts["scene"] == "suburb-0"
    assert (flight.origin.latitude, flight.origin.height, flight.origin.epsg) == (46.0, 450.0, 32632)
    for frame, truth in zip(flight.frames, written, strict=True):
        assert frame.name == truth.name
        assert frame.camera == truth.camera
        assert np.allclose(frame.world_from_camera, truth.world_from_camera, atol=1e-12)
        enu = enu_from_geodetic([[frame.gps.latitude, frame.gps.longitude, frame.gps.altitude]], ORIGIN)[0]
        assert np.allclose(enu, truth.world_from_camera[:3, 3], atol=2e-3)
        assert frame.relative_altitude == pytest.approx(truth.world_from_camera[2, 3] + 3, abs=1e-3)
        truth_gimbal = gimbal_from_rotation(truth.world_from_camera[:3, :3])
        assert (np.array(frame.gimbal) - truth_gimbal + 180) % 360 - 180 == pytest.approx(0, abs=1e-3)
        assert frame.focal_px == pytest.approx(50, rel=1e-4)
        assert frame.image().shape == (48, 64, 3)


def test_plain_folder_in_natural_order_with_all_endings(tmp_path):
    for i, name in enumerate(["p10.JPG", "p9.jpeg", "p1.png", "p2.TIF", "p3.tiff"]):
        save(tmp_path / name, i)
    (tmp_path / "notes.txt").write_text("not an image")
    save(tmp_path / "._p1.png")
    save(tmp_path / "orthophoto.tif")
    flight = read_flight(tmp_path)
    assert [f.name for f in flight.frames] == ["p1.png", "p2.TIF", "p3.tiff", "p9.jpeg", "p10.JPG"]
    assert (flight.cameras_from, flight.origin, flight.has_cameras) == (None, None, False)
    assert all(f.image().shape == (48, 64, 3) for f in flight.frames)


def test_time_orders_before_names(tmp_path):
    for name, second in (("a.jpg", 3), ("b.jpg", 1), ("c.jpg", 2)):
        exif = exif_bytes(
            make="x", model="y", time=FIRST_FRAME_TIME.replace(second=second), focal_mm=5, focal35_mm=24, focal_px=50,
            size=(64, 48), gps=None,
        )  # fmt: skip
        save(tmp_path / "images" / name, exif=exif)
    assert [f.name for f in read_flight(tmp_path).frames] == ["b.jpg", "c.jpg", "a.jpg"]
    save(tmp_path / "images" / "d.jpg")  # one without a time: names decide
    assert [f.name for f in read_flight(tmp_path).frames] == ["a.jpg", "b.jpg", "c.jpg", "d.jpg"]


def test_truncated_images_are_skipped_named_and_counted(make_flight):
    root, frames = make_flight(4)
    broken = frames[1].path
    broken.write_bytes(broken.read_bytes()[:-500])
    flight = read_flight(root)
    assert [f.name for f in flight.frames] == ["frame_0001.jpg", "frame_0003.jpg", "frame_0004.jpg"]
    assert list(flight.skipped) == ["frame_0002.jpg"]
    assert len(flight.warnings) == 1
    assert "1 of 4 images cannot be used and are skipped: frame_0002.jpg" in flight.warnings[0]


def test_damage_inside_shows_when_the_image_is_loaded(tmp_path):
    save(tmp_path / "a.png"), save(tmp_path / "b.png", 1)
    data = bytearray((tmp_path / "a.png").read_bytes())
    data[len(data) // 2 : len(data) // 2 + 300] = bytes(300)
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(InputError, match=r"a\.png cannot be decoded"):
        read_flight(tmp_path).frames[0].image()


def test_orientation_is_not_applied_and_said_once(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    for i in range(3):
        save(tmp_path / f"{i}.png", i, exif=exif)
    flight = read_flight(tmp_path)
    assert np.array_equal(flight.frames[0].image(), textured(0))
    assert [w for w in flight.warnings if "Orientation tag (6)" in w and "3 of 3" in w] == flight.warnings


def test_mixed_sizes_and_cameras_are_grouped(tmp_path):
    for i in range(4):
        save(tmp_path / f"{i}.jpg", i, size=(48, 64) if i < 3 else (50, 80))
    flight = read_flight(tmp_path)
    assert sorted(flight.camera_groups().values()) == [[0, 1, 2], [3]]


def test_gray_sixteen_bit_and_alpha_images_become_rgb(tmp_path):
    Image.fromarray(np.full((8, 8), 40_000, np.uint16)).save(tmp_path / "a.tif")
    Image.fromarray(np.full((8, 8), 7, np.uint8)).save(tmp_path / "b.png")
    Image.fromarray(np.full((8, 8, 4), 9, np.uint8)).save(tmp_path / "c.png")
    values = [f.image() for f in read_flight(tmp_path).frames]
    assert [v.shape for v in values] == [(8, 8, 3)] * 3
    assert [int(v[0, 0, 0]) for v in values] == [156, 7, 9]


def test_gps_remarks(tmp_path):
    places = [Gps(46, 8, -6.0), Gps(46.001, 8, -5.0), Gps(46.002, 8, None), None]
    for i, gps in enumerate(places):
        exif = exif_bytes(
            make="x", model="y", time=FIRST_FRAME_TIME.replace(second=i), focal_mm=5, focal35_mm=24, focal_px=50,
            size=(64, 48), gps=gps,
        )  # fmt: skip
        save(tmp_path / f"{i}.jpg", i, exif=exif)
    flight = read_flight(tmp_path)
    text = " ".join(flight.warnings)
    assert "2 of 4 images is below sea level (-6.0 to -5.0 m" in text
    assert "1 of 4 images has no altitude: 2.jpg" in text
    assert "1 of 4 images have no GPS position: 3.jpg" in text
    assert flight.frames[0].gps.altitude == pytest.approx(-6)
    assert flight.gps_origin().latitude == pytest.approx(46.001)


def test_relative_altitude_that_disagrees_is_said(make_flight):
    root, _ = make_flight(4)
    (root / "geo.txt").write_text(
        "EPSG:4326\n" + "".join(f"frame_{i:04d}.jpg 8.0 46.0 {1000 * i}\n" for i in range(1, 5))
    )
    assert any("varies by" in w for w in read_flight(root).warnings)
    assert any("AbsoluteAltitude differ" in w for w in read_flight(root).warnings)


def test_missing_empty_and_single(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        read_flight(tmp_path / "nowhere")
    with pytest.raises(InputError, match="holds no images"):
        read_flight(tmp_path)
    file = save(tmp_path / "one" / "a.jpg")
    with pytest.raises(InputError, match="is a file"):
        read_flight(file)
    with pytest.raises(InputError, match="only one usable image"):
        read_flight(tmp_path / "one")
    with pytest.raises(InputError, match=r"1 images lie in .*one: give that folder"):
        read_flight(tmp_path)
    (tmp_path / "one" / "b.jpg").write_bytes(b"\xff\xd8\xff")
    with pytest.raises(InputError, match=r"only one usable image \(b.jpg: truncated JPEG\)"):
        read_flight(tmp_path / "one")


def no_rotation(data):
    data["frames"][2]["transform_matrix"][0][0] = 2.5


def nan(data):
    data["frames"][1]["transform_matrix"][1][3] = float("nan")


def absent(data):
    data["frames"][0]["file_path"] = "images/gone.jpg"


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (no_rotation, r"Frame 2 \(images/frame_0003.jpg\).*not a rotation"),
        (nan, r"Frame 1 \(images/frame_0002.jpg\).*NaN or infinity"),
        (absent, r"Frame 0 \(images/gone.jpg\).*does not exist: put it there, or remove this frame"),
        (lambda d: d.update(camera_model="FISHEYE"), r"camera_model 'FISHEYE' is unknown.*PINHOLE"),
        (lambda d: d.update(fl_x=float("nan")), r"fl_x=nan must be a finite number"),
        (lambda d: d.update(fl_x="50"), r"fl_x='50' must be a finite number"),
        (lambda d: d.pop("fl_x"), r"no focal length: give fl_x"),
        (lambda d: d.update(frames=[]), r"holds no frames"),
        (lambda d: d["frames"][1].pop("transform_matrix"), r"Frame 1 .*must be 4 x 4"),
        (lambda d: d["frames"][1].pop("file_path"), r"Frame 1 .*has no file_path"),
        (lambda d: d["frames"].append(d["frames"][0]), r"Frame 4 .*an earlier frame names too"),
        (lambda d: d["overfly"]["origin"].update(latitude=99.0), r"latitude 99.0"),
        (lambda d: d["overfly"]["origin"].update(latitude="x"), r"origin .* as numbers"),
        (lambda d: d.update(w=640, h=640), r"has 640 x 640 pixels, the image has 64 x 48"),
    ],
)
def test_broken_transforms(make_flight, change, sentence):
    root, _ = make_flight(4)
    edit(root, change)
    with pytest.raises(InputError, match=sentence):
        read_flight(root)


def test_transforms_that_are_no_json(make_flight):
    root, _ = make_flight(2)
    (root / "transforms.json").write_text("{frames: oops")
    with pytest.raises(InputError, match="not valid JSON"):
        read_flight(root)


def test_images_without_cameras_and_cameras_of_skipped_images(make_flight):
    root, frames = make_flight(4)
    edit(root, lambda d: d["frames"].pop(3))
    frames[0].path.write_bytes(b"")
    flight = read_flight(root)
    assert [f.camera is None for f in flight.frames] == [False, False, True]
    assert any("1 of 3 images have no camera in transforms.json: frame_0004.jpg" in w for w in flight.warnings)
    assert not any("not here" in w for w in flight.warnings)


def test_images_in_other_folders_named_by_transforms(make_flight):
    root, _ = make_flight(3)
    shutil.move(root / "images", root / "rgb")
    edit(root, lambda d: [f.update(file_path=f["file_path"].replace("images/", "./rgb/")[:-4]) for f in d["frames"]])
    flight = read_flight(root)
    assert [f.name for f in flight.frames] == [f"rgb/frame_000{i}.jpg" for i in (1, 2, 3)]
    assert flight.has_cameras
    assert flight.warnings == []


def test_smaller_images_scale_their_cameras(make_flight):
    root, frames = make_flight(3)
    for frame in frames:
        Image.open(frame.path).resize((32, 24)).save(frame.path)
    flight = read_flight(root)
    assert flight.frames[0].camera.fx == 25
    assert sum("another size" in w for w in flight.warnings) == 1
