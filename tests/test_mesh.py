"""Meshes survive their files and are sampled by area."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal

from overfly.cloud import Cloud, write_cloud
from overfly.errors import InputError
from overfly.mesh import Mesh, read_mesh, write_mesh

UTM = np.array([569_123.25, 5_187_432.125, 183.5])


def box(offset: np.ndarray = UTM) -> Mesh:
    """A 10 m x 20 m x 5 m box with coloured corners."""
    solid = trimesh.creation.box((10, 20, 5))
    colors = np.random.default_rng(0).integers(0, 256, (8, 3), dtype=np.uint8)
    return Mesh(solid.vertices + offset, solid.faces.astype(np.int32), colors)


@pytest.mark.parametrize("suffix", ["ply", "obj", "glb"])
@pytest.mark.parametrize("offset", [UTM, np.zeros(3)], ids=["utm", "local"])
def test_round_trip(tmp_path: Path, suffix: str, offset: np.ndarray) -> None:
    mesh, path = box(offset), tmp_path / f"box.{suffix}"
    write_mesh(mesh, path)
    back = read_mesh(path)
    assert_allclose(back.vertices, mesh.vertices, rtol=0, atol=1e-5)
    assert_array_equal(back.faces, mesh.faces)
    assert_array_equal(back.colors, mesh.colors)
    assert back.faces.dtype == np.int32
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("suffix", ["ply", "obj", "glb"])
def test_without_colours(tmp_path: Path, suffix: str) -> None:
    mesh = Mesh(box().vertices, box().faces)
    write_mesh(mesh, tmp_path / f"a.{suffix}")
    assert read_mesh(tmp_path / f"a.{suffix}").colors is None


def test_glb_is_y_up_in_the_file(tmp_path: Path) -> None:
    write_mesh(box(np.zeros(3)), tmp_path / "a.glb")
    assert_allclose(trimesh.load_scene(tmp_path / "a.glb").extents, [10, 5, 20], atol=1e-6)


def test_duplicate_vertices_stay_apart(tmp_path: Path) -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.0]])
    mesh = Mesh(vertices, np.array([[0, 1, 2], [3, 5, 4]], np.int32))
    for suffix in ("ply", "obj", "glb"):
        write_mesh(mesh, tmp_path / f"a.{suffix}")
        assert_allclose(read_mesh(tmp_path / f"a.{suffix}").vertices, vertices, atol=1e-6)


def test_polygons_become_triangles(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
    header = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_text(header + "0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n")
    for name in ("a.obj", "a.ply"):
        mesh = read_mesh(tmp_path / name)
        assert len(mesh.faces) == 2
        assert mesh.areas().sum() == pytest.approx(1)


def test_ply_with_mixed_polygons_in_binary(tmp_path: Path) -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 2, 0]], "<f4")
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 5\nproperty float x\nproperty float y\n"
    header += "property float z\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n"
    rows = b"\x04" + np.array([0, 1, 2, 3], "<i4").tobytes() + b"\x03" + np.array([3, 2, 4], "<i4").tobytes()
    (tmp_path / "a.ply").write_bytes(header.encode() + vertices.tobytes() + rows)
    assert_array_equal(read_mesh(tmp_path / "a.ply").faces, [[0, 1, 2], [0, 2, 3], [3, 2, 4]])


def test_textured_obj_has_colours(tmp_path: Path) -> None:
    from PIL import Image

    Image.fromarray(np.full((4, 4, 3), (200, 100, 50), np.uint8)).save(tmp_path / "t.png")
    (tmp_path / "m.mtl").write_text("newmtl roof\nmap_Kd t.png\n")
    (tmp_path / "a.obj").write_text(
        "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl roof\nf 1/1 2/2 3/3\n"
    )
    colors = read_mesh(tmp_path / "a.obj").colors
    assert colors is not None
    assert_array_equal(colors[0], [200, 100, 50])


def test_sample_is_uniform_by_area_and_on_the_surface() -> None:
    mesh = box(np.zeros(3))
    sample = mesh.sample(20_000, np.random.default_rng(1))
    assert len(sample) == 20_000
    half = np.array([5, 10, 2.5])
    on = np.isclose(np.abs(sample.points), half, atol=1e-9)
    assert on.any(axis=1).all()
    assert (np.abs(sample.points) <= half + 1e-9).all()
    # 2 x 10 x 20 of the 700 square metres lie on top and bottom.
    assert on[:, 2].mean() == pytest.approx(400 / 700, abs=0.015)
    assert_array_equal(sample.points, mesh.sample(20_000, np.random.default_rng(1)).points)


def test_sample_interpolates_colours() -> None:
    ramp = Mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1.0, 0]]), np.array([[0, 1, 2]], np.int32),
                np.array([[0, 0, 0], [200, 0, 0], [0, 100, 0]], np.uint8))  # fmt: skip
    sample = ramp.sample(100, np.random.default_rng(0))
    assert sample.colors is not None
    assert_allclose(sample.colors[:, 0], sample.points[:, 0] * 200, atol=0.51)
    assert_allclose(sample.colors[:, 1], sample.points[:, 1] * 100, atol=0.51)


def test_bad_files(tmp_path: Path) -> None:
    write_cloud(Cloud(np.eye(3)), tmp_path / "cloud.ply")
    with pytest.raises(InputError, match="no faces"):
        read_mesh(tmp_path / "cloud.ply")
    for name in ("a.glb", "a.ply"):
        (tmp_path / name).write_bytes(b"nonsense" * 20)
        with pytest.raises(InputError, match="not a readable"):
            read_mesh(tmp_path / name)
    (tmp_path / "b.obj").write_text("nonsense\n" * 20)
    with pytest.raises(InputError, match=r"b\.obj"):
        read_mesh(tmp_path / "b.obj")
    with pytest.raises(InputError, match="does not exist"):
        read_mesh(tmp_path / "none.glb")
    with pytest.raises(InputError, match=r"\.ply, \.obj, \.glb"):
        write_mesh(box(), tmp_path / "a.stl")
    write_mesh(Mesh(np.eye(3), np.array([[0, 1, 7]], np.int32)), tmp_path / "c.ply")
    with pytest.raises(InputError, match="does not exist"):
        read_mesh(tmp_path / "c.ply")
    write_mesh(
        Mesh(np.array([[0, 0, 0], [1, 0, np.nan], [0, 1, 0]]), np.array([[0, 1, 2]], np.int32)), tmp_path / "d.ply"
    )
    with pytest.raises(InputError, match="1 of the 3 vertices"):
        read_mesh(tmp_path / "d.ply")
    with pytest.raises(InputError, match="without area"):
        Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]], np.int32)).sample(3, np.random.default_rng(0))
