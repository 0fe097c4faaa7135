"""Camera formats: round trips, and files of other programs as those programs define them."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_flight import CAMERA, some_poses, textured

from overfly.errors import InputError
from overfly.flights.colmap import read_colmap
from overfly.flights.flight import Frame
from overfly.flights.folder import read_flight
from overfly.flights.odm import read_gcps, read_geo
from overfly.flights.transforms import read_transforms, write_transforms
from overfly.geodesy import Origin
from overfly.geometry import Camera, invert, project

LENS = Camera(64, 48, 50.0, 51.0, 31.0, 25.0, -0.1, 0.02, 0.001, -0.002, 0.003)


def image_files(folder, n):
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"im{i}.png" for i in range(n)]
    for i, path in enumerate(paths):
        Image.fromarray(textured(i)).save(path)
    return paths


@pytest.mark.parametrize("cameras", [[CAMERA] * 3, [LENS] * 3, [CAMERA, LENS, replace(LENS, k3=0.0)]])
def test_transforms_round_trip(tmp_path, cameras):
    poses = some_poses(3)
    frames = [
        Frame(name=p.name, path=p, width=64, height=48, camera=c, world_from_camera=pose)
        for p, c, pose in zip(image_files(tmp_path / "images", 3), cameras, poses, strict=True)
    ]
    write_transforms(tmp_path / "transforms.json", frames, Origin(1.0, 2.0, 3.0, 32631), {"altitude": 80})
    flight = read_flight(tmp_path)
    assert flight.origin == Origin(1.0, 2.0, 3.0, 32631)
    assert flight.facts["altitude"] == 80
    for frame, camera, pose in zip(flight.frames, cameras, poses, strict=True):
        assert frame.camera == camera
        assert np.allclose(frame.world_from_camera, pose, atol=1e-12)
    data = json.loads((tmp_path / "transforms.json").read_text())
    assert data["frames"][0]["file_path"] == "images/im0.png"
    assert ("fl_x" in data) == (len(set(cameras)) == 1)


def test_transforms_use_opengl_camera_axes(tmp_path):
    """With the identity the camera looks along -z with y up: a point ahead and above is in the upper half."""
    image_files(tmp_path, 2)
    entry = {"file_path": "im0.png", "transform_matrix": np.eye(4).tolist()}
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 1.0, "frames": [entry]}))
    cameras = read_transforms(tmp_path / "transforms.json")
    camera = cameras.cameras["im0.png"]
    assert camera.fx == pytest.approx(32 / np.tan(0.5))
    pixel, depth = project([0, 1.0, -5.0], camera, cameras.poses["im0.png"])
    assert depth == 5
    assert pixel[0] == 32
    assert pixel[1] < 24


MODELS = [
    ("SIMPLE_PINHOLE", [50, 31, 25]),
    ("PINHOLE", [50, 51, 31, 25]),
    ("SIMPLE_RADIAL", [50, 31, 25, -0.1]),
    ("RADIAL", [50, 31, 25, -0.1, 0.02]),
    ("OPENCV", [50, 51, 31, 25, -0.1, 0.02, 0.001, -0.002]),
    ("FULL_OPENCV", [50, 51, 31, 25, -0.1, 0.02, 0.001, -0.002, 0.003, 0, 0, 0]),
]


@pytest.mark.parametrize("ending", ["bin", "txt"])
def test_colmap_models_as_pycolmap_writes_them(tmp_path, ending):
    pycolmap = pytest.importorskip("pycolmap")
    poses = some_poses(len(MODELS))
    model = pycolmap.Reconstruction()
    for i, ((name, params), pose) in enumerate(zip(MODELS, poses, strict=True), start=1):
        camera = pycolmap.Camera(model=name, width=64, height=48, params=params, camera_id=i)
        model.add_camera_with_trivial_rig(camera)
        pixels = np.random.default_rng(i).uniform(0, 40, (i, 2))
        image = pycolmap.Image(name=f"im {i}.png", keypoints=pixels, camera_id=i, image_id=i)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(invert(pose)[:3]))
    (model.write_binary if ending == "bin" else model.write_text)(str(tmp_path))
    cameras = read_colmap(tmp_path)
    rng = np.random.default_rng(0)
    for i, ((name, _), pose) in enumerate(zip(MODELS, poses, strict=True), start=1):
        assert np.allclose(cameras.poses[f"im {i}.png"], pose, atol=1e-9), name
        local = rng.normal(size=(5, 3)) + np.array([0, 0, 6])
        theirs = np.array([model.cameras[i].img_from_cam(p) for p in local])
        ours, _ = project(local, cameras.cameras[f"im {i}.png"], np.eye(4))
        assert np.allclose(ours, theirs, atol=1e-9), name


def test_colmap_text_without_observation_lines_and_in_a_flight(tmp_path):
    image_files(tmp_path / "images", 3)
    model = tmp_path / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("# comment\n1 SIMPLE_RADIAL 64 48 50 32 24 0.01\n")
    rows = ["# comment"]
    for i, pose in enumerate(some_poses(3)):
        inverse = invert(pose)
        x, y, z, w = Rotation.from_matrix(inverse[:3, :3]).as_quat()
        rows.append(" ".join(map(str, [i + 1, w, x, y, z, *inverse[:3, 3], 1, f"im{i}.png"])))
        if i == 1:
            rows.append("1.5 2.5 -1 3.5 4.5 7 5.5 6.5 -1 1.5 2.5 -1")
    (model / "images.txt").write_text("\n".join(rows) + "\n")
    flight = read_flight(tmp_path)
    assert flight.cameras_from == "sparse/0"
    assert flight.origin is None
    for frame, pose in zip(flight.frames, some_poses(3), strict=True):
        assert np.allclose(frame.world_from_camera, pose, atol=1e-9)
        assert frame.camera.k1 == 0.01


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("1 OPENCV_FISHEYE 64 48 50 50 32 24 0 0 0 0", "'OPENCV_FISHEYE' is unknown"),
        ("1 PINHOLE 64 48 50", "is broken"),
        ("1 PINHOLE 64 48 nan 50 32 24", "NaN"),
        ("1 FULL_OPENCV 64 48 50 50 32 24 0 0 0 0 0 0.1 0 0", "k4, k5, k6"),
        ("oops", "is broken"),
    ],
)
def test_broken_colmap(tmp_path, line, sentence):
    (tmp_path / "cameras.txt").write_text(line + "\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n")
    with pytest.raises(InputError, match=sentence):
        read_colmap(tmp_path)


def test_colmap_truncated_binary_and_missing_files(tmp_path):
    with pytest.raises(InputError, match="no COLMAP model"):
        read_colmap(tmp_path)
    (tmp_path / "cameras.bin").write_bytes(b"\x05\0\0")
    (tmp_path / "images.bin").write_bytes(b"")
    with pytest.raises(InputError, match=r"cameras\.bin is broken"):
        read_colmap(tmp_path)


def reconstruction(poses, camera):
    shots = {}
    for i, pose in enumerate(poses):
        inverse = invert(pose)
        rotation = Rotation.from_matrix(inverse[:3, :3]).as_rotvec().tolist()
        shots[f"im{i}.png"] = {"rotation": rotation, "translation": inverse[:3, 3].tolist(), "camera": "c"}
    lla = {"latitude": 46.0, "longitude": 8.0, "altitude": 400.0}
    return [{"cameras": {"c": camera}, "shots": shots, "points": {}, "reference_lla": lla}, {"shots": {"x": {}}}]


def test_opensfm(tmp_path):
    image_files(tmp_path / "images", 3)
    brown = {"projection_type": "brown", "width": 64, "height": 48, "focal_x": 0.8, "focal_y": 0.9, "c_x": 0.01}
    brown |= {"c_y": -0.02, "k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4, "k3": 0.5}
    path = tmp_path / "reconstruction.json"
    path.write_text(json.dumps(reconstruction(some_poses(3), brown)))
    flight = read_flight(tmp_path)
    assert flight.cameras_from == "reconstruction.json"
    assert flight.origin == Origin(46.0, 8.0, 400.0)
    assert any("2 separate parts" in w for w in flight.warnings)
    for frame, pose in zip(flight.frames, some_poses(3), strict=True):
        assert np.allclose(frame.world_from_camera, pose, atol=1e-9)
    # OpenSfM: normalised = (pixel index + 0.5 - size / 2) / larger side; our first pixel's centre is 0.5.
    expected = Camera(64, 48, 51.2, 57.6, 32.64, 22.72, 0.1, 0.2, 0.3, 0.4, 0.5)
    assert flight.frames[0].camera.to_dict() == pytest.approx(expected.to_dict())
    simple = {"projection_type": "perspective", "width": 64, "height": 48, "focal": 0.8, "k1": 0.1, "k2": 0.0}
    path.write_text(json.dumps(reconstruction(some_poses(3), simple)))
    assert read_flight(tmp_path).frames[0].camera == Camera(64, 48, 51.2, 51.2, 32, 24, 0.1)


def test_broken_opensfm(tmp_path):
    image_files(tmp_path, 2)
    path = tmp_path / "reconstruction.json"
    fisheye = {"projection_type": "fisheye", "width": 64, "height": 48, "focal": 0.8}
    for data, sentence in (
        (reconstruction(some_poses(2), fisheye), "'fisheye' is unknown"),
        ([], "holds no shots"),
        ([{"cameras": {}, "shots": {"im0.png": {"camera": "c"}}}], "Shot im0.png .* is broken"),
    ):
        path.write_text(json.dumps(data))
        with pytest.raises(InputError, match=sentence):
            read_flight(tmp_path)


def test_cameras_come_from_the_first_format(make_flight):
    root, _ = make_flight(3)
    (root / "sparse" / "0").mkdir(parents=True)
    (root / "sparse" / "0" / "images.txt").write_text("")
    (root / "reconstruction.json").write_text("broken")
    assert read_flight(root).cameras_from == "transforms.json"


def test_geo_txt(tmp_path):
    path = tmp_path / "geo.txt"
    path.write_text("EPSG:4326\na.jpg -91.9942 46.8425 198.6\nb.jpg 8 46 500 45 20 1 0.02 0.05 note\nc.jpg 8 46\n")
    geo = read_geo(path)
    assert (geo["a.jpg"].gps.latitude, geo["a.jpg"].gps.longitude) == pytest.approx((46.8425, -91.9942))
    assert geo["a.jpg"].gps.altitude == 198.6
    assert geo["a.jpg"].gimbal is None
    assert geo["b.jpg"].gimbal == (45, -70, 1)
    assert (geo["b.jpg"].gps.horizontal_m, geo["b.jpg"].gps.vertical_m) == (0.02, 0.05)
    assert geo["c.jpg"].gps.altitude is None
    path.write_text("WGS84 UTM 32N\na.jpg 500000 5094000 10 0 0 0\n")
    assert read_geo(path)["a.jpg"].gps.longitude == pytest.approx(9.0)
    assert read_geo(path)["a.jpg"].gimbal is None
    path.write_text("+proj=utm +zone=32 +ellps=WGS84 +datum=WGS84 +units=m +no_defs\na.jpg 500000 5094000\n")
    assert read_geo(path)["a.jpg"].gps.longitude == pytest.approx(9.0)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "is empty"),
        ("EPSG:99999999\na.jpg 1 2 3\n", "must be a CRS"),
        ("EPSG:4326\na.jpg 1 north 3\n", "Line 2 .*'north' is not a number"),
        ("EPSG:4326\na.jpg 1\n", "Line 2 .*no position"),
    ],
)
def test_broken_geo_txt(tmp_path, text, sentence):
    path = tmp_path / "geo.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=sentence):
        read_geo(path)


def test_geo_txt_replaces_exif_and_must_fit(make_flight):
    root, _ = make_flight(2)
    (root / "geo.txt").write_text("EPSG:4326\nframe_0001.jpg 9.0 47.0 600\nother.jpg 9 47 600\n")
    flight = read_flight(root)
    assert flight.frames[0].gps.latitude == pytest.approx(47)
    assert flight.frames[1].gps.latitude == pytest.approx(46, abs=0.01)
    assert any("geo.txt names 1 images that are not here: other.jpg" in w for w in flight.warnings)
    (root / "geo.txt").write_text("EPSG:4326\nother.jpg 9 47 600\n")
    with pytest.raises(InputError, match="None of the image names"):
        read_flight(root)


def test_gcp_list(tmp_path):
    path = tmp_path / "gcp_list.txt"
    path.write_text("EPSG:32617\n1 2 3 10.5 20.5 a.jpg north\n1 2 3 11 21 b.jpg north\n4 5 6 7 8 a.jpg\n")
    points = read_gcps(path)
    assert [(p.name, p.position, p.crs) for p in points] == [
        ("north", (1, 2, 3), "EPSG:32617"),
        ("gcp2", (4, 5, 6), "EPSG:32617"),
    ]
    assert points[0].pixels == {"a.jpg": (10.5, 20.5), "b.jpg": (11, 21)}
    path.write_text("EPSG:32617\n1 2 3 4 5\n")
    with pytest.raises(InputError, match=r"Line 2 .*too short"):
        read_gcps(path)
