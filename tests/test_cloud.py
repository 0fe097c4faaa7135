"""Clouds survive their files; broken files are refused with a sentence."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest
import trimesh
from numpy.testing import assert_array_equal

from overfly.cloud import Cloud, concatenate, read_cloud, voxel_thin, write_cloud, write_clouds
from overfly.errors import InputError

UTM = np.array([569_123.4567, 5_187_432.1234, 183.4321])


@pytest.fixture
def cloud() -> Cloud:
    rng = np.random.default_rng(0)
    n = 500
    return Cloud(
        rng.uniform(-50, 50, (n, 3)) + UTM,
        rng.integers(0, 256, (n, 3), dtype=np.uint8),
        rng.random(n, dtype=np.float32),
        rng.random(n, dtype=np.float32),
        rng.integers(0, 20, n, dtype=np.uint8),
        rng.random(n) < 0.3,
        32615,
    )


def same(a: Cloud, b: Cloud, atol: float) -> None:
    np.testing.assert_allclose(a.points, b.points, rtol=0, atol=atol)
    for name in ("colors", "confidence", "sigma_m", "views", "predicted"):
        x, y = getattr(a, name), getattr(b, name)
        assert (x is None) == (y is None), name
        if x is not None:
            assert x.dtype == y.dtype, name
            assert_array_equal(x, y)
    assert a.epsg == b.epsg


@pytest.mark.parametrize(("suffix", "atol"), [("ply", 0), ("las", 5.1e-4), ("laz", 5.1e-4), ("LAZ", 5.1e-4)])
def test_round_trip_keeps_everything(cloud: Cloud, tmp_path: Path, suffix: str, atol: float) -> None:
    path = tmp_path / "new" / f"cloud.{suffix}"
    write_cloud(cloud, path)
    same(cloud, read_cloud(path), atol)
    assert [p.name for p in path.parent.iterdir()] == [path.name], "a temporary file was left behind"


@pytest.mark.parametrize("suffix", ["ply", "laz"])
def test_parts_make_the_same_file_as_the_whole(
    cloud: Cloud, tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_cloud(cloud, tmp_path / f"whole.{suffix}")
    monkeypatch.setattr("overfly.cloud.PIECE", 70)
    parts = [cloud[:100], cloud[100:100], cloud[100:]]
    write_clouds(iter(parts), tmp_path / f"parts.{suffix}", count=len(cloud), low=cloud.points.min(0))
    same(read_cloud(tmp_path / f"whole.{suffix}"), read_cloud(tmp_path / f"parts.{suffix}"), 0)


@pytest.mark.parametrize("suffix", ["ply", "laz"])
def test_bare_points_stay_bare_and_local(tmp_path: Path, suffix: str) -> None:
    bare = Cloud(np.array([[0.0, 0, 0], [10, 0, 0], [10, 10, 10]]))
    write_cloud(bare, tmp_path / f"cube.{suffix}")
    same(bare, read_cloud(tmp_path / f"cube.{suffix}"), 1e-9)


def test_las_header_is_what_other_programs_expect(cloud: Cloud, tmp_path: Path) -> None:
    write_cloud(cloud, tmp_path / "cloud.laz")
    las = laspy.read(tmp_path / "cloud.laz")
    assert las.header.parse_crs().to_epsg() == 32615
    assert list(las.point_format.extra_dimension_names) == ["confidence", "sigma_m", "views", "predicted"]
    assert_array_equal(las.header.offsets, np.floor(cloud.points.min(0)))
    assert_array_equal(las.red, cloud.colors[:, 0].astype(int) * 257)


@pytest.mark.parametrize("factor", [1, 256])
def test_las_colours_of_8_and_of_16_bits(tmp_path: Path, factor: int) -> None:
    las = laspy.create(point_format=2, file_version="1.2")
    las.x = las.y = las.z = np.arange(3.0)
    las.red, las.green, las.blue = np.array([[10, 20, 30], [40, 50, 60], [0, 128, 255]], np.uint16).T * factor
    las.write(tmp_path / "a.las")
    assert_array_equal(read_cloud(tmp_path / "a.las").colors, [[10, 20, 30], [40, 50, 60], [0, 128, 255]])


def test_real_odm_cloud(shared_data, tmp_path: Path) -> None:
    cloud = read_cloud(shared_data("brighton_beach") / "reference_odm" / "model.laz")
    assert len(cloud) == 940_393
    assert cloud.epsg == 32615
    assert cloud.colors is not None
    assert cloud.colors.max() > 200
    np.testing.assert_allclose(np.ptp(cloud.points[:, :2], axis=0), [107, 98], atol=1)


def test_ply_written_by_others(tmp_path: Path) -> None:
    points = np.array([[0, 0, 0], [1.5, 2, 3], [-4, 5, 6]])
    colors = np.array([[1, 2, 3, 255], [4, 5, 6, 255], [7, 8, 9, 255]], np.uint8)
    path = tmp_path / "a.ply"
    for encoding in ("ascii", "binary"):
        path.write_bytes(trimesh.PointCloud(points, colors).export(file_type="ply", encoding=encoding))
        cloud = read_cloud(path)
        assert_array_equal(cloud.points, points)
        assert_array_equal(cloud.colors, colors[:, :3])
        path.write_bytes(trimesh.Trimesh(points, [[0, 1, 2]], process=False).export(file_type="ply", encoding=encoding))
        assert_array_equal(read_cloud(path).points, points)


def test_ply_dialects(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    header = "ply\r\nformat ascii 1.0\r\ncomment made by hand\r\nelement vertex 2\r\nproperty double x\r\n"
    header += "property double y\r\nproperty double z\r\nproperty uchar r\r\nproperty uchar g\r\nproperty uchar b\r\n"
    path.write_text(header + "end_header\r\n569123.4567 5187432.1234 1 9 8 7\r\n1 2 3 4 5 6\r\n", newline="")
    cloud = read_cloud(path)
    assert cloud.points[0, 1] == 5187432.1234
    assert_array_equal(cloud.colors, [[9, 8, 7], [4, 5, 6]])
    big = np.array([(1.5, 2, 3), (4, 5, 6)], [(k, ">f4") for k in "xyz"])
    lines = "ply\nformat binary_big_endian 1.0\nelement camera 1\nproperty list uchar int k\nelement vertex 2\n"
    lines += "property float x\nproperty float y\nproperty float z\nend_header\n"
    path.write_bytes(lines.encode() + b"\x02" + np.array([7, 8], ">i4").tobytes() + big.tobytes())
    assert_array_equal(read_cloud(path).points, [[1.5, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize("suffix", ["ply", "las", "laz"])
@pytest.mark.parametrize("keep", [0, 3, 150, 300, 1200, 0.5, 0.99])
def test_truncated_files_are_refused(cloud: Cloud, tmp_path: Path, suffix: str, keep: float) -> None:
    path = tmp_path / f"a.{suffix}"
    write_cloud(cloud, path)
    data = path.read_bytes()
    path.write_bytes(data[: int(keep if isinstance(keep, int) else keep * len(data))])
    with pytest.raises(InputError, match=r"a\.la|a\.ply"):
        read_cloud(path)


@pytest.mark.parametrize("name", ["a.ply", "a.las", "a.laz"])
def test_files_of_another_kind_are_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"<html>not found</html>" * 100)
    with pytest.raises(InputError, match="not a readable"):
        read_cloud(tmp_path / name)


def test_missing_and_unknown(cloud: Cloud, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        read_cloud(tmp_path / "a.ply")
    (tmp_path / "b.ply").mkdir()
    with pytest.raises(InputError, match="is not a file"):
        read_cloud(tmp_path / "b.ply")
    (tmp_path / "a.xyz").write_text("1 2 3")
    with pytest.raises(InputError, match=r"\.ply, \.las, \.laz"):
        read_cloud(tmp_path / "a.xyz")
    with pytest.raises(InputError, match=r"\.ply, \.las, \.laz"):
        write_cloud(cloud, tmp_path / "a.e57")


def test_empty_and_nan(tmp_path: Path) -> None:
    header = (
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    (tmp_path / "a.ply").write_text(header.format(0))
    with pytest.raises(InputError, match="has no points"):
        read_cloud(tmp_path / "a.ply")
    (tmp_path / "b.ply").write_text(header.format(2) + "1 2 nan\n1 2 3\n")
    with pytest.raises(InputError, match="1 of the 2 points"):
        read_cloud(tmp_path / "b.ply")
    laspy.create().write(tmp_path / "c.las")
    with pytest.raises(InputError, match="has no points"):
        read_cloud(tmp_path / "c.las")
    for bad in (np.zeros((0, 3)), np.array([[0, np.inf, 0]])):
        with pytest.raises(InputError, match="not written"):
            write_cloud(Cloud(bad), tmp_path / "d.ply")
    assert not (tmp_path / "d.ply").exists()


def test_feet_are_refused(tmp_path: Path) -> None:
    from pyproj import CRS

    las = laspy.create(point_format=6, file_version="1.4")
    las.header.add_crs(CRS.from_epsg(2992))  # Oregon Lambert, international feet
    las.x = las.y = las.z = np.arange(3.0)
    las.write(tmp_path / "a.las")
    with pytest.raises(InputError, match="foot"):
        read_cloud(tmp_path / "a.las")


def test_failed_write_keeps_the_old_file(cloud: Cloud, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.laz"
    write_cloud(cloud, path)
    before = path.read_bytes()

    def full(self: laspy.LasWriter, points: object) -> None:
        self.dest.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(laspy.LasWriter, "write_points", full)
    with pytest.raises(OSError, match="No space"):
        write_cloud(cloud[:10], path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_voxel_thin_keeps_one_point_per_voxel() -> None:
    points = np.array([[0, 0, 0], [0.4, 0, 0], [1.1, 0, 0], [0, 1.2, 0], [0.1, 0.1, 0.1]])
    assert_array_equal(voxel_thin(points, 1.0), [0, 2, 3])
    # Voxels stand still where points move.
    assert_array_equal(voxel_thin(points + np.array([0.7, 0, 0]), 1.0), [0, 1, 3])
    far = np.vstack([points, [[1e9, 1e9, 1e9]]])
    assert_array_equal(voxel_thin(far, 0.1), [0, 1, 2, 3, 4, 5])


def test_concatenate_and_select(cloud: Cloud) -> None:
    same(concatenate([cloud[:100], cloud[100:]]), cloud, 0)
    assert concatenate([cloud, Cloud(cloud.points, epsg=32615)]).colors is None
    with pytest.raises(InputError, match="CRS"):
        concatenate([cloud, Cloud(cloud.points)])
