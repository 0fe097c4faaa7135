"""Scenes from files: meshes, clouds, height rasters; their frames, colours and bare ground."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from overfly.cloud import Cloud, write_cloud
from overfly.errors import InputError
from overfly.geodesy import enu_from_crs
from overfly.geometry import Camera, look_at
from overfly.mesh import Mesh, write_mesh
from overfly.scenes import Appearance, Renderer, load_scene

CAMERA = Camera.from_fov(120, 90, 60)


def landscape(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A tilted plain with a house of 20 x 20 x 8 m in the middle of 100 x 100 m."""
    house = (np.abs(x - 50) <= 10) & (np.abs(y - 50) <= 10)
    return 0.05 * x + np.where(house, 8.0, 0.0)


def cloud_points(n: int = 60000, offset: tuple[float, float, float] = (0, 0, 0)) -> Cloud:
    rng = np.random.default_rng(3)
    xy = rng.uniform(0, 100, (n, 2))
    z = landscape(xy[:, 0], xy[:, 1])
    colors = np.where((z > 0.05 * xy[:, 0] + 1)[:, None], [200, 40, 30], [60, 120, 40]).astype(np.uint8)
    return Cloud(np.c_[xy, z] + np.array(offset), colors)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb"])
def test_a_mesh_keeps_its_size_place_and_colours(tmp_path: Path, suffix: str) -> None:
    corners = np.array([(100 + x, 200 + y, 5 + z) for z in (0, 10) for y in (0, 10) for x in (0, 10)], float)
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.int32)
    write_mesh(Mesh(corners, faces, np.tile(np.uint8([200, 30, 30]), (8, 1))), tmp_path / f"cube{suffix}")
    scene = load_scene(tmp_path / f"cube{suffix}")
    np.testing.assert_allclose(scene.bounds, [corners.min(0), corners.max(0)], atol=1e-4)
    image = (
        Renderer(scene).render(CAMERA, look_at([105, 205, 30], [105, 205.001, 15]), appearance=Appearance(haze=0)).image
    )
    red, green, blue = image[45, 60].astype(int)
    assert red > green + 80
    assert red > blue + 80


def test_a_texture_is_on_the_right_side_of_a_mesh(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    from PIL import Image

    picture = np.zeros((64, 64, 3), np.uint8)
    picture[:, :32, 0], picture[:32, 32:, 1], picture[32:, 32:, 2] = 255, 255, 255  # left red, top right green, blue
    square = np.array([(0, 0, 0), (40, 0, 0), (40, 40, 0), (0, 40, 0)], float)
    visual = trimesh.visual.TextureVisuals(
        uv=square[:, :2] / 40, material=trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(picture))
    )
    quad = trimesh.Trimesh(square, [(0, 1, 2), (0, 2, 3)], visual=visual, process=False)
    quad.apply_transform([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # glTF is y up
    (tmp_path / "quad.glb").write_bytes(trimesh.Scene([quad]).export(file_type="glb"))
    scene = load_scene(tmp_path / "quad.glb")
    assert scene.texture is not None
    colors = {}
    for name, x, y in (("west", 10, 20), ("north-east", 30, 30), ("south-east", 30, 10)):
        view = look_at([x, y, 10], [x, y + 1e-4, 0])
        colors[name] = int(Renderer(scene).render(CAMERA, view).image[45, 60].argmax())
    assert colors == {"west": 0, "north-east": 1, "south-east": 2}


@pytest.mark.parametrize("suffix", [".ply", ".laz"])
def test_a_cloud_becomes_a_coloured_surface(tmp_path: Path, suffix: str) -> None:
    cloud = cloud_points()
    hole = ((cloud.points[:, :2] - [20, 20]) ** 2).sum(1) > 3**2  # a shadow of the scanner
    write_cloud(cloud[hole], tmp_path / f"scan{suffix}")
    scene = load_scene(tmp_path / f"scan{suffix}")
    assert scene.origin is None
    assert scene.offset == (0, 0, 0)
    renderer = Renderer(scene)
    heights = renderer.height_map(5, 5, 95, 95, 1.0)
    x, y = np.meshgrid(np.arange(5.5, 95), np.arange(94.5, 5, -1))
    error = np.abs(heights - landscape(x, y))
    assert np.isfinite(heights).all()
    assert np.median(error) < 0.05
    assert (error < 0.3).mean() > 0.97
    roof = renderer.render(CAMERA, look_at([50, 50, 40], [50, 50.001, 0])).image[45, 60].astype(int)
    assert roof[0] > roof[1] + 60
    lawn = renderer.render(CAMERA, look_at([20, 80, 40], [20, 80.001, 0])).image[45, 60].astype(int)
    assert lawn[1] > lawn[0] + 20
    xy = np.array([[50.0, 50.0], [20.0, 20.0], [80.0, 30.0]])
    np.testing.assert_allclose(scene.ground(xy), 0.05 * xy[:, 0], atol=0.6)  # the house is not ground


def test_a_bird_is_not_a_tower(tmp_path: Path) -> None:
    cloud = cloud_points()
    points = np.concatenate([cloud.points, [[20.0, 80.0, 70.0]]])
    write_cloud(Cloud(points), tmp_path / "scan.laz")
    assert Renderer(load_scene(tmp_path / "scan.laz")).height_map(10, 70, 30, 90, 1.0).max() < 3


def test_holes_are_filled_from_their_lower_rim() -> None:
    from overfly.scenes.lidar import _fill_holes

    z = np.tile(np.arange(30) * 0.02, (30, 1))
    ground = z.copy()
    z[:, 15:] = 10.0
    z[10:20, 8:15] = np.nan  # the ground beside a wall of 10 m that the scanner did not see
    z[4, 20] = np.nan  # one cell of the roof
    filled = _fill_holes(z)
    np.testing.assert_allclose(filled[10:20, 8:15], ground[10:20, 8:15], atol=0.15)
    assert filled[4, 20] == 10


def test_a_cloud_in_a_crs_gets_its_origin(tmp_path: Path) -> None:
    place = (500_000.0, 5_700_000.0, 150.0)
    moved = cloud_points(offset=place)
    write_cloud(Cloud(moved.points, moved.colors, epsg=32632), tmp_path / "scan.laz")
    scene = load_scene(tmp_path / "scan.laz")
    assert scene.origin is not None
    assert scene.origin.epsg == 32632
    assert scene.origin.longitude == pytest.approx(9.0, abs=0.01)
    corner = enu_from_crs([np.add(place, [50, 50, landscape(np.array(50.0), np.array(50.0))])], scene.origin)[0]
    top = Renderer(scene).height_map(corner[0] - 2, corner[1] - 2, corner[0] + 2, corner[1] + 2, 1.0)
    assert np.median(top) == pytest.approx(corner[2], abs=0.1)


def write_dsm(path: Path, z: np.ndarray, *, epsg: int | str | None = 32632, cell: float = 0.5, bands: int = 1) -> None:
    rasterio = pytest.importorskip("rasterio")
    from affine import Affine

    data = z[None] if z.ndim == 2 else np.moveaxis(z, -1, 0)
    rows, cols = data.shape[1:]
    profile = {"driver": "GTiff", "width": cols, "height": rows, "count": bands, "dtype": data.dtype}
    placed = Affine(cell, 0, 500_000, 0, -cell, 5_700_100)
    with rasterio.open(path, "w", **profile, crs=f"EPSG:{epsg}" if epsg else None, transform=placed) as file:
        file.write(data)


def test_a_height_raster_with_its_orthophoto(tmp_path: Path) -> None:
    x, y = np.meshgrid(np.arange(0.25, 100, 0.5), np.arange(99.75, 0, -0.5))
    z = landscape(x, y).astype(np.float32)
    z[:20, :20] = np.nan
    photo = np.zeros((400, 400, 3), np.uint8)
    photo[:200, :, 2], photo[200:, :, 0] = 200, 200  # north blue, south red
    write_dsm(tmp_path / "area.tif", z)
    write_dsm(tmp_path / "area_ortho.tif", photo, cell=0.25, bands=3)
    scene = load_scene(tmp_path / "area.tif")
    assert scene.origin is not None
    renderer = Renderer(scene)
    low, high = scene.bounds
    middle = (low + high) / 2
    assert high[0] - low[0] == pytest.approx(99.5, abs=0.2)  # the grid's scale at the central meridian is 0.9996
    north = renderer.render(CAMERA, look_at([middle[0], middle[1] + 30, 50], [middle[0], middle[1] + 30.001, 0])).image
    south = renderer.render(CAMERA, look_at([middle[0], middle[1] - 30, 50], [middle[0], middle[1] - 29.999, 0])).image
    assert north[45, 60].argmax() == 2
    assert south[45, 60].argmax() == 0
    corner = renderer.height_map(low[0] + 1, high[1] - 5, low[0] + 5, high[1] - 1, 1.0)
    assert np.isnan(corner).all()  # NaN cells stay empty
    other = load_scene(tmp_path / "area.tif", orthophoto=tmp_path / "area_ortho.tif")
    np.testing.assert_array_equal(other.texture, scene.texture)


def test_a_raster_of_heights_above_the_sea_has_its_place_on_the_earth(tmp_path: Path) -> None:
    write_dsm(tmp_path / "sea.tif", np.full((100, 100), 7.0, np.float32), epsg="32632+5773")
    scene = load_scene(tmp_path / "sea.tif")
    assert scene.origin is not None
    assert (scene.origin.epsg, scene.origin.height) == (32632, 7.0)


def test_a_raster_without_crs_is_in_its_own_metres(tmp_path: Path) -> None:
    write_dsm(tmp_path / "plain.tif", np.full((100, 100), 7.0, np.float32), epsg=None)
    scene = load_scene(tmp_path / "plain.tif")
    assert scene.origin is None
    assert scene.offset == (500_025.0, 5_700_075.0, 0.0)
    np.testing.assert_allclose(scene.vertices[:, 2], 7.0)
    assert np.abs(scene.vertices[:, :2]).max() < 30


def test_bad_files_are_explained(tmp_path: Path) -> None:
    cases = {
        "nothing.ply": "does not exist",
        "scene.fbx": "cannot be a scene",
        "broken.tif": "not a readable raster",
        "broken.glb": "not a readable mesh",
        "empty.tif": "no heights",
        "nan.ply": "NaN",
        "line.laz": "100",
    }
    (tmp_path / "scene.fbx").write_bytes(b"x")
    (tmp_path / "broken.tif").write_bytes(b"not a raster")
    (tmp_path / "broken.glb").write_bytes(b"not a mesh")
    write_dsm(tmp_path / "empty.tif", np.full((20, 20), np.nan, np.float32))
    write_mesh(
        Mesh(np.array([[0, 0, 0], [1, 0, np.nan], [0, 1, 0]], float), np.array([[0, 1, 2]], np.int32)),
        tmp_path / "nan.ply",
    )
    write_cloud(Cloud(np.zeros((5, 3))), tmp_path / "line.laz")
    for name, sentence in cases.items():
        with pytest.raises(InputError, match=sentence):
            load_scene(tmp_path / name)
    with pytest.raises(InputError, match="orthophoto"):
        load_scene(tmp_path / "nan.ply", orthophoto=tmp_path / "empty.tif")


def test_a_real_lidar_cloud(shared_data) -> None:
    path = shared_data("autzen_lidar") / "autzen_offices.laz"
    scene = load_scene(path)
    low, high = scene.bounds
    assert high[0] - low[0] == pytest.approx(683, abs=3)
    assert high[1] - low[1] == pytest.approx(268, abs=3)
    centre = (low + high) / 2
    ground = float(scene.ground(centre[:2])[0])
    assert low[2] - 1 < ground < low[2] + 15
    rendered = Renderer(scene).render(
        CAMERA, look_at([*centre[:2], ground + 100], [centre[0], centre[1] + 1e-3, ground])
    )
    assert (rendered.depth > 50).mean() > 0.99
    assert rendered.image.std() > 15
