"""A model with a frame and a scale of its own comes to where its images' GPS says they were, or is levelled."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from overfly.errors import InputError
from overfly.flights.colmap import read_colmap_points
from overfly.flights.folder import read_flight
from overfly.geodesy import Origin, enu_from_geodetic, geodetic_from_enu
from overfly.geometry import Array, Camera, invert, pose, rotation_from_gimbal

CAMERA = Camera(64, 48, 50.0, 50.0, 32.0, 24.0)
ORIGIN = Origin(46.0, 8.0, 450.0)
SCALE, TURN = 0.02, Rotation.from_euler("xyz", [160, 25, 40], degrees=True).as_matrix()


def stood(line: bool) -> list[Array]:
    """Poses of eight cameras 100 m over the ground, on a grid or a line, looking down and a little ahead."""
    places = [[30.0 * i, 0, 100] if line else [30.0 * (i % 4), 40.0 * (i // 4), 100 + 2 * (i % 3)] for i in range(8)]
    return [pose(rotation_from_gimbal(10.0 * i, -85), place) for i, place in enumerate(places)]


def model(root: Path, poses: list[Array], gps: bool, points: bool = False, turn: Array = TURN) -> None:
    """The flight's folder with a COLMAP model in another frame, and geo.txt."""
    (root / "sparse").mkdir(parents=True)
    p = CAMERA
    (root / "sparse" / "cameras.txt").write_text(f"1 PINHOLE {p.width} {p.height} {p.fx} {p.fy} {p.cx} {p.cy}\n")
    rows, geo = [], ["EPSG:4326"]
    for i, at in enumerate(poses):
        Image.fromarray(np.full((48, 64, 3), 40 * (i % 4), np.uint8)).save(root / f"im{i}.png")
        inverse = invert(pose(turn @ at[:3, :3], SCALE * turn @ at[:3, 3] + [1, 2, 3]))
        x, y, z, w = Rotation.from_matrix(inverse[:3, :3]).as_quat()
        rows += [" ".join(map(str, [i + 1, w, x, y, z, *inverse[:3, 3], 1, f"im{i}.png"])), ""]
        latitude, longitude, height = geodetic_from_enu([at[:3, 3]], ORIGIN)[0]
        geo.append(f"im{i}.png {longitude:.9f} {latitude:.9f} {height:.4f}")
    (root / "sparse" / "images.txt").write_text("\n".join(rows))
    if gps:
        (root / "geo.txt").write_text("\n".join(geo))
    if points:
        rng = np.random.default_rng(0)
        ground = np.column_stack([rng.uniform(-20, 120, (200, 2)), rng.normal(0, 0.2, 200)])
        inside = SCALE * ground @ turn.T + [1, 2, 3]
        lines = [" ".join(map(str, [i, *p, 0, 0, 0, 0.5, 1, 0, 2, 0])) for i, p in enumerate(inside)]
        (root / "sparse" / "points3D.txt").write_text("# comment\n" + "\n".join(lines))


@pytest.mark.parametrize("line", [False, True])
def test_gps_brings_a_model_to_metres(line: bool, tmp_path: Path) -> None:
    poses = stood(line)
    model(tmp_path, poses, gps=True)
    if line:  # only angles tell how it rolled about the line; a pitch of 0 looks down
        rows = (tmp_path / "geo.txt").read_text().splitlines()
        rows[1:] = [f"{row} {10 * i} 5 0" for i, row in enumerate(rows[1:])]
        (tmp_path / "geo.txt").write_text("\n".join(rows))
    flight = read_flight(tmp_path)
    assert flight.origin is not None
    found = np.stack([np.asarray(frame.world_from_camera) for frame in flight.frames])
    expected = np.stack(poses)
    places = enu_from_geodetic(geodetic_from_enu(expected[:, :3, 3], ORIGIN), flight.origin)
    assert np.abs(found[:, :3, 3] - places).max() < (2.0 if line else 0.1)
    turns = Rotation.from_matrix(np.einsum("nij,nik->njk", found[:, :3, :3], expected[:, :3, :3])).magnitude()
    assert np.rad2deg(turns).max() < (1.0 if line else 0.1)
    told = flight.facts["located"]
    assert "The cameras of sparse were brought to the images' GPS" in told
    assert "one of its units is 50 m" in told


@pytest.mark.parametrize(("points", "most"), [(True, 2.0), (False, 10.0)])
def test_without_gps_a_model_is_levelled(points: bool, most: float, tmp_path: Path) -> None:
    """By its points; without any by the mean view of its cameras, which look 5 degrees ahead to all sides."""
    model(tmp_path, stood(False), gps=False, points=points)
    flight = read_flight(tmp_path)
    assert flight.origin is None
    views = np.stack([np.asarray(frame.world_from_camera)[:3, 2] for frame in flight.frames])
    true = np.stack([at[:3, 2] for at in stood(False)])
    turn, _ = Rotation.align_vectors(views, true)
    assert np.rad2deg(np.arccos(turn.as_matrix()[2, 2])) < most
    assert "located" not in flight.facts


def test_a_model_that_is_level_keeps_its_frame(tmp_path: Path) -> None:
    """Its ground may slope: who has levelled it knows better."""
    lean = Rotation.from_euler("x", 12, degrees=True).as_matrix()
    model(tmp_path, stood(False), gps=False, points=True, turn=lean)
    found = read_flight(tmp_path).frames[3].world_from_camera
    assert found is not None
    np.testing.assert_allclose(np.asarray(found)[:3, 3], SCALE * lean @ stood(False)[3][:3, 3] + [1, 2, 3], atol=1e-9)


def test_gps_that_tells_no_scale_is_not_followed(tmp_path: Path) -> None:
    """All fixes within a metre, as some receivers write where they have lost their satellites."""
    model(tmp_path, stood(False), gps=True, points=True)
    rows = (tmp_path / "geo.txt").read_text().splitlines()
    rng = np.random.default_rng(2)
    rows[1:] = [
        f"im{i}.png {8 + 1e-5 * a:.9f} {46 + 1e-5 * b:.9f} 550" for i, (a, b) in enumerate(rng.normal(size=(8, 2)))
    ]
    (tmp_path / "geo.txt").write_text("\n".join(rows))
    flight = read_flight(tmp_path)
    assert flight.origin is None
    assert "located" not in flight.facts


def test_an_oblique_model_that_is_level_keeps_its_frame_without_points(tmp_path: Path) -> None:
    poses = [pose(rotation_from_gimbal(0, -40), [20.0 * i, 5.0 * (i % 2), 80]) for i in range(6)]
    model(tmp_path, poses, gps=False, turn=np.eye(3))
    np.testing.assert_allclose(read_flight(tmp_path).frames[2].world_from_camera[:3, :3], poses[2][:3, :3], atol=1e-9)  # type: ignore[index]


def test_a_model_beside_a_reference_cloud_stays_in_its_frame(tmp_path: Path) -> None:
    model(tmp_path, stood(False), gps=True)
    (tmp_path / "reference.ply").touch()
    assert read_flight(tmp_path).origin is None


def test_points_of_a_binary_model(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    theirs = pycolmap.Reconstruction()
    places = np.random.default_rng(1).normal(size=(5, 3))
    for place in places:
        theirs.add_point3D(place, pycolmap.Track(), np.zeros(3, np.uint8))
    theirs.write_binary(str(tmp_path))
    np.testing.assert_allclose(read_colmap_points(tmp_path), places)
    (tmp_path / "points3D.bin").write_bytes((tmp_path / "points3D.bin").read_bytes()[:60])
    with pytest.raises(InputError, match="is broken"):
        read_colmap_points(tmp_path)
    assert read_colmap_points(tmp_path / "nothing").shape == (0, 3)
