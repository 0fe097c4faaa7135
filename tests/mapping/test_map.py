"""The whole path on small flights whose ground is known: products, numbers, resume, and what is refused."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from overfly.cloud import Cloud, read_cloud
from overfly.errors import InputError
from overfly.geodesy import Origin, crs_from_enu
from overfly.geometry import OPENCV_FROM_OPENGL, Camera, on_plane, pixel_grid, pose, rotation_from_gimbal, transform
from overfly.mapping.map import map_flight
from overfly.mapping.settings import MapSettings
from overfly.mapping.tiles import write_tiles

CAMERA = Camera(96, 72, 80.0, 80.0, 49.0, 35.0)
ORIGIN = {"latitude": 46.84, "longitude": -91.99, "height": 150.0}
GROUND = 5.0


class Plane(torch.nn.Module):
    """Predicts a regular grid on the ground, window height 0."""

    def __init__(self) -> None:
        super().__init__()
        self.offset = torch.nn.Parameter(torch.zeros(1))

    def forward(self, batch: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        side = torch.linspace(-0.9, 0.9, 24)
        x, y = torch.meshgrid(side, side, indexing="ij")
        points = torch.stack([x.flatten(), y.flatten(), 0 * x.flatten()], -1) + self.offset
        return {"points": points.expand(len(batch["images"]), -1, -1)}


@pytest.fixture(autouse=True)
def quick_pictures(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing is tested in test_pictures and in the first test here; elsewhere it only takes time."""
    if "georeferenced" not in request.node.name:
        monkeypatch.setattr("overfly.mapping.pictures._drawn", lambda figure: np.zeros((8, 8, 3), np.uint8))


def run() -> Any:
    return SimpleNamespace(network=Plane().eval(), config={"frames": 2, "image_size": [48, 36]})


def paint(world_from_camera: np.ndarray, camera: Camera = CAMERA) -> np.ndarray:
    """A picture on the ground: red grows to the east, green to the north."""
    xy = on_plane(pixel_grid(camera.width, camera.height), camera, world_from_camera, GROUND)[..., :2]
    image = np.zeros((camera.height, camera.width, 3))
    image[..., 0] = 128 + xy[..., 0]
    image[..., 1] = 128 + xy[..., 1]
    return np.clip(image, 0, 255).astype(np.uint8)


def make_flight(root: Path, n: int = 4, *, block: dict[str, Any] | None = None, shift: float = 0.0) -> Path:
    """n nadir images along a line northwards, 55 m above the ground, with transforms.json."""
    (root / "images").mkdir(parents=True)
    frames = []
    for i in range(n):
        world_from_camera = pose(rotation_from_gimbal(0, -90), [shift, 25.0 * (i - (n - 1) / 2), GROUND + 55.0])
        Image.fromarray(paint(world_from_camera)).save(root / "images" / f"{i}.png")
        matrix = (world_from_camera @ OPENCV_FROM_OPENGL).tolist()
        frames.append({"file_path": f"images/{i}.png", "transform_matrix": matrix})
    data: dict[str, Any] = {
        "camera_model": "PINHOLE",
        "fl_x": 80.0,
        "fl_y": 80.0,
        "cx": 49.0,
        "cy": 35.0,
        "w": 96,
        "h": 72,
    }
    data["frames"] = frames
    data["overfly"] = {"altitude": 55.0} if block is None else block
    (root / "transforms.json").write_text(json.dumps(data))
    return root


def mapped(flight: Path, out: Path, **settings: Any) -> dict[str, Any]:
    return map_flight(flight, out=out, **({"network": run(), "progress": False} | settings))


def test_a_flight_with_an_origin_becomes_a_georeferenced_map(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flight = make_flight(tmp_path / "my_flight", block={"altitude": 55.0, "origin": ORIGIN})
    before = {p: p.stat().st_mtime_ns for p in flight.rglob("*")}
    summary = mapped(flight, tmp_path / "out", ply=True, progress=True)
    assert {p: p.stat().st_mtime_ns for p in flight.rglob("*")} == before
    out = tmp_path / "out"
    names = {p.name for p in out.iterdir()}
    assert names == {
        "cloud.laz", "cloud.ply", "dsm.tif", "dsm_source.tif", "orthophoto.tif", "transforms.json", "map.json",
        "report.html", "work",
    }  # fmt: skip
    assert json.loads((out / "map.json").read_text()) == summary
    assert {
        "images", "registered", "points", "measured", "predicted", "gsd_m", "crs", "cameras_from", "seconds",
        "peak_memory_mb", "warnings",
    } <= summary.keys()  # fmt: skip
    assert (summary["images"], summary["registered"], summary["crs"]) == (4, 4, "EPSG:32615")
    assert summary["cameras_from"] == "transforms.json"
    assert summary["gsd_m"] == pytest.approx(55 / 80, rel=0.02)
    assert summary["points"] == summary["measured"] + summary["predicted"]
    assert sum(summary["surface"].values()) == pytest.approx(1, abs=2e-4)
    assert "of the surface model measured" in (out / "report.html").read_text()
    assert {"cameras", "dense", "products", "report"} <= summary["seconds"].keys()
    cloud = read_cloud(out / "cloud.laz")
    assert cloud.epsg == 32615
    assert len(cloud) == summary["points"]
    origin = Origin(46.84, -91.99, 150.0)
    corner = crs_from_enu([[0, 0, GROUND]], origin)[0]
    assert np.abs(cloud.points[:, 2] - corner[2]).max() < 0.01
    assert np.abs(cloud.points[:, :2].mean(0) - corner[:2]).max() < 6
    assert cloud.colors is not None
    local = cloud.points - corner
    good = np.abs(local[:, :2]).max(1) < 100
    assert (
        np.abs(cloud.colors[good, 0].astype(float) - 128 - local[good, 0]).max() < 4
    )  # ENU and UTM differ by a degree
    told = capsys.readouterr()
    assert told.out == ""
    for words in ("images", "given by transforms.json: 4 of 4", "EPSG:32615", "points by the network", "report.html"):
        assert words in told.err.replace("\n", " "), words


def test_without_an_origin_the_cloud_stays_in_the_cameras_frame(tmp_path: Path) -> None:
    summary = mapped(make_flight(tmp_path / "f", shift=1000.0), tmp_path / "out")
    assert summary["crs"] is None
    assert summary["metric"]
    assert any("no place on the Earth" in w for w in summary["warnings"])
    cloud = read_cloud(tmp_path / "out" / "cloud.laz")
    assert cloud.epsg is None
    np.testing.assert_allclose(cloud.points[:, 2], GROUND, atol=2e-3)
    assert abs(cloud.points[:, 0].mean() - 1000) < 2
    import rasterio

    with rasterio.open(tmp_path / "out" / "dsm.tif") as dsm:
        assert dsm.crs is None


def test_the_cameras_written_make_the_same_map_again(tmp_path: Path) -> None:
    flight = make_flight(tmp_path / "f", block={"altitude": 55.0, "origin": ORIGIN})
    mapped(flight, tmp_path / "out")
    from overfly.flights import read_flight

    again = read_flight(flight)
    written = json.loads((tmp_path / "out" / "transforms.json").read_text())
    for entry, frame in zip(written["frames"], again.frames, strict=True):
        assert frame.world_from_camera is not None
        np.testing.assert_allclose(np.array(entry["transform_matrix"]) @ OPENCV_FROM_OPENGL, frame.world_from_camera)
    assert written["overfly"]["origin"]["latitude"] == 46.84


def test_finished_steps_are_reused_and_only_where_nothing_changed(tmp_path: Path) -> None:
    flight, out = make_flight(tmp_path / "f"), tmp_path / "out"
    assert mapped(flight, out)["reused"] == []
    assert mapped(flight, out)["reused"] == ["cameras", "dense"]
    assert mapped(flight, out, resume=False)["reused"] == []
    other = run()
    other.network.offset.data += 0.01
    assert mapped(flight, out, network=other)["reused"] == ["cameras"]
    assert mapped(flight, out)["reused"] == ["cameras", "dense"]  # the one before is still there
    os.utime(flight / "images" / "0.png")
    assert mapped(flight, out)["reused"] == []


@pytest.mark.parametrize(("form", "kept"), [("BLOCK_FORM", []), ("DENSE_FORM", ["cameras"])])
def test_what_an_older_form_kept_is_made_anew(
    form: str, kept: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flight, out = make_flight(tmp_path / "f"), tmp_path / "out"
    with monkeypatch.context() as older:
        older.setattr(f"overfly.mapping.map.{form}", 0)
        mapped(flight, out)
    assert mapped(flight, out)["reused"] == kept


def test_an_interruption_keeps_what_is_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    flight, out = make_flight(tmp_path / "f"), tmp_path / "out"

    def stop(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("overfly.mapping.network.network_cloud", stop)
        with pytest.raises(KeyboardInterrupt):
            mapped(flight, out, progress=True)
    assert "kept: cameras" in capsys.readouterr().err
    assert not (out / "map.json").exists()
    (out / "work" / "dense-0123456789abcdef.99.part").mkdir()  # as a killed process leaves it
    assert mapped(flight, out)["reused"] == ["cameras"]
    assert not list((out / "work").glob("*.part"))


def test_a_kill_loses_only_the_running_step(tmp_path: Path) -> None:
    flight, out = make_flight(tmp_path / "f"), tmp_path / "out"
    code = (
        f"import os, signal, sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "import test_map, overfly.mapping.network as network\n"
        "network.network_cloud = lambda *a, **k: os.kill(os.getpid(), signal.SIGKILL)\n"
        f"test_map.mapped({str(flight)!r}, {str(out)!r})"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -signal.SIGKILL
    assert not (out / "map.json").exists()
    assert mapped(flight, out)["reused"] == ["cameras"]


def test_a_folder_with_another_map_is_not_overwritten_unasked(tmp_path: Path) -> None:
    first, second, out = make_flight(tmp_path / "a"), make_flight(tmp_path / "b", 3), tmp_path / "out"
    mapped(first, out)
    kept = (out / "cloud.laz").read_bytes()
    with pytest.raises(InputError, match="map of another flight"):
        mapped(second, out)
    assert (out / "cloud.laz").read_bytes() == kept
    assert mapped(second, out, overwrite=True)["images"] == 3
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "cloud.laz").write_text("precious")
    with pytest.raises(InputError, match="unknown origin"):
        mapped(first, tmp_path / "mine")
    with pytest.raises(InputError, match="the flight itself"):
        mapped(first, first)
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="is a file"):
        mapped(first, tmp_path / "file")
    assert not (first / "work").exists()


def test_a_map_that_was_refused_leaves_its_folder_free(tmp_path: Path) -> None:
    first, second, out = make_flight(tmp_path / "a"), make_flight(tmp_path / "b", 3), tmp_path / "out"
    with pytest.raises(InputError, match="would not be used"):
        mapped(first, out, calibration=str(first))
    assert mapped(second, out)["images"] == 3
    with pytest.raises(InputError, match="map of another flight"):
        mapped(first, out)


def test_a_moved_flight_is_still_the_same(tmp_path: Path) -> None:
    flight, out = make_flight(tmp_path / "f"), tmp_path / "out"
    mapped(flight, out)
    assert mapped(flight.rename(tmp_path / "g"), out)["reused"] == ["cameras", "dense"]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"network": None}, "needs a trained network"),
        ({"dense": "magic"}, "--dense 'magic' is unknown"),
        ({"cameras": "some"}, "--cameras 'some' is unknown"),
        ({"max_memory_gb": 0}, "--max-memory 0"),
        ({"size": 10}, "--size 10"),
        ({"mesh": True, "mesh_faces": 3}, "^--mesh-faces 3 is not possible: give 100 to"),
        ({"mesh_faces": 5000}, "add --mesh"),
        ({"mesh": True, "max_memory_gb": 1}, "A mesh of 200000 triangles takes about 1.2 GB, more than --max-memory 1"),
    ],
)
def test_wrong_settings_are_refused_before_anything_is_written(
    tmp_path: Path, settings: dict[str, Any], words: str
) -> None:
    flight = make_flight(tmp_path / "f", 2)
    with pytest.raises(InputError, match=words):
        mapped(flight, tmp_path / "out", **settings)
    assert not (tmp_path / "out").exists()
    assert MapSettings(dense="stereo").shown()["network"] is None


def test_given_cameras_that_are_not_there_are_refused(tmp_path: Path) -> None:
    flight = make_flight(tmp_path / "f", 3)
    (flight / "transforms.json").unlink()
    with pytest.raises(InputError, match="--cameras estimate"):
        mapped(flight, tmp_path / "out", cameras="given")


def test_one_camera_is_no_map_and_lost_images_are_named(tmp_path: Path) -> None:
    flight = make_flight(tmp_path / "f", 4)
    data = json.loads((flight / "transforms.json").read_text())
    data["frames"] = data["frames"][:3]
    (flight / "transforms.json").write_text(json.dumps(data))
    summary = mapped(flight, tmp_path / "out")
    assert (summary["images"], summary["registered"], summary["unregistered"]) == (4, 3, ["3.png"])
    assert any("3.png" in w for w in summary["warnings"])
    assert "3.png" in (tmp_path / "out" / "report.html").read_text()
    data["frames"] = data["frames"][:1]
    (flight / "transforms.json").write_text(json.dumps(data))
    with pytest.raises(InputError, match="at least two"):
        mapped(flight, tmp_path / "out1")


def test_an_unknown_scale_is_said_everywhere_and_kept(tmp_path: Path) -> None:
    flight = make_flight(tmp_path / "f", block={"altitude": 55.0, "scale": "unknown"})
    summary = mapped(flight, tmp_path / "out")
    assert (summary["metric"], summary["gsd_m"], summary["crs"]) == (False, None, None)
    assert any("Metric scale unknown" in w for w in summary["warnings"])
    assert "Metric scale unknown" in (tmp_path / "out" / "report.html").read_text()
    assert json.loads((tmp_path / "out" / "transforms.json").read_text())["overfly"]["scale"] == "unknown"


def test_images_of_mixed_size_are_mapped(tmp_path: Path) -> None:
    flight = make_flight(tmp_path / "f")
    data = json.loads((flight / "transforms.json").read_text())
    small = CAMERA.resized(80, 60)
    matrix = np.array(data["frames"][1]["transform_matrix"]) @ OPENCV_FROM_OPENGL
    Image.fromarray(paint(matrix, small)).save(flight / "images" / "1.png")
    data["frames"][1] |= {"fl_x": small.fx, "fl_y": small.fy, "cx": small.cx, "cy": small.cy, "w": 80, "h": 60}
    (flight / "transforms.json").write_text(json.dumps(data))
    assert mapped(flight, tmp_path / "out")["registered"] == 4


def test_a_frame_whose_z_is_not_up_gets_no_rasters_and_keeps_its_cloud(tmp_path: Path) -> None:
    flight = make_flight(tmp_path / "f")
    data = json.loads((flight / "transforms.json").read_text())
    turn = pose(rotation_from_gimbal(40, -10, 30), [0, 0, 0])
    from overfly.flights import read_flight
    from overfly.mapping.deliver import deliver
    from overfly.mapping.given import given_block
    from overfly.mapping.steps import Steps

    upright_block = given_block(read_flight(flight))
    for frame in data["frames"]:
        frame["transform_matrix"] = (turn @ np.array(frame["transform_matrix"])).tolist()
    (flight / "transforms.json").write_text(json.dumps(data))
    lying = read_flight(flight)
    x, y = np.meshgrid(np.linspace(-30, 30, 60), np.linspace(-40, 40, 60))
    ground = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, GROUND)])
    cloud = Cloud(transform(turn, ground), np.full((x.size, 3), 99, np.uint8))
    steps = Steps(tmp_path / "work", resume=True, show=False)
    out = tmp_path / "out"
    out.mkdir()
    tiles = write_tiles(tmp_path / "tiles", [cloud[:1000], cloud[1000:]])
    summary = deliver(lying, given_block(lying), tiles, out, MapSettings(dense="stereo", mesh=True), steps)
    assert not (out / "dsm.tif").exists()
    assert not (out / "mesh.glb").exists()
    assert summary["mesh"] is None
    assert "so there is no raster and no mesh" in summary["warnings"][0]
    np.testing.assert_allclose(read_cloud(out / "cloud.laz").points, cloud.points, atol=1e-3)
    assert summary["gsd_m"] == pytest.approx(55 / 80, rel=0.02)
    flat = write_tiles(tmp_path / "flat", [Cloud(ground)])
    summary = deliver(lying, upright_block, flat, out, MapSettings(dense="stereo", mesh=True), steps)
    assert (out / "dsm.tif").exists()
    assert summary["mesh"] is None  # the other products must not be lost for it
    assert any(w.startswith("There is no mesh.glb. The cloud has no colours") for w in summary["warnings"])
    assert json.loads((out / "map.json").read_text()) == summary


def test_a_mesh_is_written_beside_the_other_products(tmp_path: Path) -> None:
    import trimesh

    flight = make_flight(tmp_path / "f", block={"altitude": 55.0, "origin": ORIGIN})
    out = tmp_path / "out"
    summary = mapped(flight, out, mesh=True, mesh_faces=1000)
    facts = summary["mesh"]
    assert facts["crs"] == summary["crs"] == "EPSG:32615"
    assert facts["faces"] == pytest.approx(1000, rel=0.2)
    assert facts["textured_share"] > 0.7
    assert 0 <= facts["filled_share"] < 0.5
    assert f"{facts['filled_share']:.0%} of its plan closes gaps" in (out / "report.html").read_text()
    assert summary["settings"]["mesh_faces"] == 1000
    report = (out / "report.html").read_text()
    assert "mesh.glb" in report
    assert f"{facts['textured_share']:.0%} of the surface shows photographs" in report
    scene = trimesh.load_scene(out / "mesh.glb")
    (part,) = scene.geometry.values()
    x, y, z = np.asarray(part.vertices).T
    placed = np.column_stack([x, -z, y]) + facts["origin"]
    corner = crs_from_enu([[0, 0, GROUND]], Origin(46.84, -91.99, 150.0))[0]
    assert np.abs(placed[:, 2] - corner[2]).max() < 0.01
    rgb = np.asarray(part.visual.to_color().vertex_colors)[:, :3].astype(float)
    assert np.abs(rgb[:, :2] - 128 - (placed - corner)[:, :2]).mean() < 3
    first = (out / "mesh.glb").read_bytes()
    again = mapped(flight, out, mesh=True, mesh_faces=1000)
    assert again["reused"] == ["cameras", "dense"]
    assert (out / "mesh.glb").read_bytes() == first
    assert mapped(flight, out)["mesh"] is None
    assert not (out / "mesh.glb").exists()  # what map.json does not tell of is not there


def test_a_mesh_has_no_more_triangles_than_points(tmp_path: Path) -> None:
    summary = mapped(make_flight(tmp_path / "f"), tmp_path / "out", mesh=True, mesh_faces=1_000_000)
    assert summary["mesh"]["faces"] <= 1.05 * summary["points"]
    assert any(w.startswith("--mesh-faces 1000000 asks for more triangles than") for w in summary["warnings"])


def test_stereo_measures_the_ground_without_a_network(tmp_path: Path) -> None:
    import cv2

    flight = make_flight(tmp_path / "f", 4)
    data = json.loads((flight / "transforms.json").read_text())
    camera = CAMERA.resized(288, 216)
    texture = np.random.default_rng(0).integers(0, 255, (512, 512), dtype=np.uint8)
    texture = cv2.GaussianBlur(cv2.resize(texture, (1024, 1024), interpolation=cv2.INTER_CUBIC), (0, 0), 1)
    for i, frame in enumerate(data["frames"]):
        matrix = np.array(frame["transform_matrix"]) @ OPENCV_FROM_OPENGL
        xy = on_plane(pixel_grid(288, 216), camera, matrix, GROUND)[..., :2]
        at = (xy * 5 + 512).astype(np.float32)  # 20 cm of texture, 23 cm of GSD
        grey = cv2.remap(texture, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        Image.fromarray(np.repeat(grey[..., None], 3, -1)).save(flight / "images" / f"{i}.png")
    data |= {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "w": 288, "h": 216}
    (flight / "transforms.json").write_text(json.dumps(data))
    summary = mapped(flight, tmp_path / "out", dense="stereo", network=None)
    cloud = read_cloud(tmp_path / "out" / "cloud.laz")
    assert summary["predicted"] == 0
    assert len(cloud) > 20_000
    away = np.abs(cloud.points[:, 2] - GROUND)
    assert np.median(away) < 0.1
    assert np.quantile(away, 0.95) < 0.5
    assert cloud.views is not None
    assert cloud.views.min() >= 2
    assert mapped(flight, tmp_path / "out", dense="stereo", network=None)["reused"] == ["cameras", "dense"]


def test_a_damaged_cloud_is_made_again_and_not_delivered(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flight, out = make_flight(tmp_path / "f"), tmp_path / "out"
    mapped(flight, out)
    before = read_cloud(out / "cloud.laz").points
    tile = next((out / "work").glob("dense-*/*.npz"))
    content = bytearray(tile.read_bytes())
    content[len(content) // 3] ^= 0xFF
    tile.write_bytes(content)
    assert mapped(flight, out, progress=True)["reused"] == ["cameras"]
    assert "is damaged and made anew" in capsys.readouterr().err
    np.testing.assert_array_equal(read_cloud(out / "cloud.laz").points, before)
    (next((out / "work").glob("cameras-*")) / "block.json").write_text('{"frames": {')
    assert mapped(flight, out)["reused"] == ["dense"]


FULL = OSError(errno.ENOSPC, "No space left on device")
LOCKED = PermissionError(errno.EACCES, "Permission denied")


@pytest.mark.parametrize(
    ("writer", "error", "words"),
    [
        ("overfly.mapping.tiles.save_arrays", FULL, "during dense: the disk is full"),
        ("laspy.LasWriter.write_points", FULL, "during products: the disk is full"),
        ("rasterio.shutil.copy", OSError("CPLE_FileIO: write failed: No space left on device"), "the disk is full"),
        ("overfly.mapping.deliver.write_transforms", LOCKED, r"Permission denied .*another folder by --out"),
    ],
)
def test_what_cannot_be_written_is_one_sentence_and_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, writer: str, error: OSError, words: str
) -> None:
    flight, out = make_flight(tmp_path / "f"), tmp_path / "out"

    def fail(*_: Any, **__: Any) -> None:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(writer, fail)
        with pytest.raises(InputError, match=words) as told:
            mapped(flight, out)
    assert "\n" not in str(told.value)
    assert not (out / "map.json").exists()
    assert not list(out.glob(".*")), "temporary files were left behind"
    expected = ["cameras"] if "dense" in words else ["cameras", "dense"]
    assert mapped(flight, out)["reused"] == expected


def test_other_errors_of_the_system_are_not_blamed_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise ConnectionResetError(errno.ECONNRESET, "reset")

    monkeypatch.setattr("overfly.mapping.deliver.write_transforms", fail)
    with pytest.raises(ConnectionResetError):
        mapped(make_flight(tmp_path / "f"), tmp_path / "out")


def test_a_read_only_folder_is_told_by_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from overfly import cli

    flight = make_flight(tmp_path / "f")
    out = Path("/proc/overfly")  # where nobody can write, root included
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["overfly", "map", str(flight), "--out", str(out), "--dense", "stereo"])
        with pytest.raises(SystemExit) as done:
            cli.main()
    assert done.value.code == 2
    assert "cannot be written" in capsys.readouterr().err


def test_an_image_without_bytes_is_named_and_left_out(tmp_path: Path) -> None:
    flight = make_flight(tmp_path / "f")
    (flight / "images" / "9.png").write_bytes(b"")
    summary = mapped(flight, tmp_path / "out")
    assert (summary["images"], summary["registered"]) == (5, 4)
    assert list(summary["skipped"]) == ["9.png"]
