"""The textured mesh against the truth: colours, hidden ground, place on the Earth, and what a reader of glTF finds."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import house
import numpy as np
import pytest
import trimesh

from conftest import ORIGIN, bar, nadir
from overfly.cloud import Cloud
from overfly.errors import InputError
from overfly.flights import Frame
from overfly.geodesy import crs_from_enu, enu_from_crs
from overfly.mapping.atlas import lay_out
from overfly.mapping.gains import Gains
from overfly.mapping.rough_mesh import rough_mesh
from overfly.mapping.textured_mesh import write_textured_mesh
from overfly.mesh import Z_UP_FROM_Y_UP, Mesh

FACES = 1500
CELL = 40 / np.sqrt(FACES / 2)


def truth(xy: np.ndarray) -> np.ndarray:
    """True colours [N, 3] at x, y [N, 2]; remap takes short rows only."""
    return np.concatenate([house.color(some[None])[0] for some in np.array_split(xy, len(xy) // 30_000 + 1)])


def ground(half: float = 20.0, step: float = 0.25) -> Cloud:
    """The true surface of the house's surroundings, as points in their true colours."""
    at = np.arange(-half + step / 2, half, step)
    xy = np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)
    return Cloud(np.column_stack([xy, house.height(xy)]), np.rint(truth(xy)).astype(np.uint8))


def even(count: int) -> Gains:
    return Gains(np.ones((count, 3)), np.ones(count))


def written(path: Path, mesh: Mesh, frames: list, gains: Gains | None = None, **settings: Any) -> dict[str, Any]:
    settings = {"place": lambda points: points, "crs": None, "bar": bar} | settings
    return write_textured_mesh(path, mesh, frames, gains or even(len(frames)), **settings)


class Surface(NamedTuple):
    """Points all over a mesh: place [N, 3], normal's z [N], and colour [N, 3] as the textures have it."""

    points: np.ndarray
    up: np.ndarray
    colors: np.ndarray
    faces: int


def read(path: Path) -> Surface:
    """What a viewer would show: bilinear samples of the textures at points of every face, z up, origin added."""
    scene = trimesh.load_scene(path, process=False)
    origin = np.array(scene.metadata["origin"])
    points, up, colors, faces = [], [], [], 0
    weights = np.random.default_rng(0).dirichlet(np.ones(3), 20)  # [20, 3]
    for part in scene.geometry.values():
        uv = np.asarray(part.visual.uv)
        assert 0 <= uv.min() <= uv.max() <= 1
        corners = np.asarray(part.vertices)[part.faces] @ Z_UP_FROM_Y_UP[:3, :3].T
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        image = np.asarray(part.visual.material.baseColorTexture.convert("RGB"))
        size = np.array(image.shape[1::-1])
        place = (weights @ (np.column_stack([uv[:, 0], 1 - uv[:, 1]]) * size)[part.faces] - 0.5).astype(np.float32)
        colors.append(cv2.remap(image, place[..., 0], place[..., 1], cv2.INTER_LINEAR).reshape(-1, 3))
        points.append((weights @ corners).reshape(-1, 3) + origin)
        up.append(np.repeat(normal[:, 2], len(weights)))
        faces += len(part.faces)
    return Surface(np.concatenate(points), np.concatenate(up), np.concatenate(colors).astype(float), faces)


def level(surface: Surface, xy: np.ndarray) -> np.ndarray:
    """Whether points lie on flat faces of roof or meadow, away from the roof's outline."""
    outside = (np.abs(xy) - house.HALF).max(1)
    return np.asarray((surface.up > 0.99) & (np.abs(outside) > 1.5 * CELL))


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    return rough_mesh(ground(), faces=FACES)


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> list:
    return house.frames(tmp_path_factory.mktemp("house"))


@pytest.fixture(scope="module")
def textured(tmp_path_factory: pytest.TempPathFactory, mesh: Mesh, frames: list) -> tuple[Path, dict[str, Any]]:
    path = tmp_path_factory.mktemp("mesh") / "mesh.glb"
    return path, written(path, mesh, frames)


def test_the_texture_is_the_scene_much_finer_than_the_mesh(textured: tuple[Path, dict], mesh: Mesh) -> None:
    path, facts = textured
    surface = read(path)
    assert surface.faces == facts["faces"] == len(mesh.faces) == pytest.approx(FACES, rel=0.1)
    xy = surface.points[:, :2]
    flat = level(surface, xy)
    assert flat.mean() > 0.7
    np.testing.assert_allclose(surface.points[flat, 2], house.height(xy[flat]), atol=1e-4)
    off = np.abs(surface.colors - truth(xy))[flat].mean()
    few = mesh.sample(20_000, np.random.default_rng(1))
    clear = np.abs((np.abs(few.points[:, :2]) - house.HALF).max(1)) > 1.5 * CELL
    assert few.colors is not None
    rough = np.abs(few.colors.astype(float) - truth(few.points[:, :2]))[clear].mean()
    assert off < 2.5
    assert off < 0.4 * rough
    assert facts["textured_share"] > 0.75  # walls of one cell stand all around; some only a grazing ray sees
    assert facts["texture_scale"] == 1
    assert facts["charts"] < 60


def test_its_place_on_the_earth_is_the_origin_and_the_vertices(tmp_path: Path, mesh: Mesh, frames: list) -> None:
    path = tmp_path / "mesh.glb"
    facts = written(path, mesh, frames, place=lambda points: crs_from_enu(points, ORIGIN), crs="EPSG:32634")
    surface = read(path)  # adds the origin that the file tells
    local = enu_from_crs(surface.points, ORIGIN)
    flat = level(surface, local[:, :2])
    np.testing.assert_allclose(local[flat, 2], house.height(local[flat, :2]), atol=2e-3)
    assert np.abs(surface.colors - truth(local[:, :2]))[flat].mean() < 2.5
    data = path.read_bytes()
    magic, version, length, header, kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    asset = json.loads(data[20 : 20 + header])["asset"]
    assert asset["extras"]["origin"] == facts["origin"]
    assert asset["extras"]["crs"] == facts["crs"] == "EPSG:32634"
    assert np.abs(np.array(facts["origin"]) - surface.points.mean(0)).max() < 10


def hidden_side() -> list:
    """A camera west of the house, near, that the roof hides a strip east of it from; and a far one in the east."""
    return [nadir(-8.0, 0.0, house.ALTITUDE), nadir(30.0, 0.0, house.ALTITUDE)]


def strip(surface: Surface) -> np.ndarray:
    """Points on the meadow that the western camera does not see for the house: a shadow of 2.67 m."""
    x, y, _ = surface.points.T
    return np.asarray((surface.up > 0.99) & (x > 6.3) & (x < 8.3) & (np.abs(y) < 3))


def green(colors: np.ndarray) -> np.ndarray:
    return np.asarray(colors[:, 1] - colors[:, 0] > 20)


def test_ground_behind_the_house_does_not_take_the_colour_of_the_roof(tmp_path: Path) -> None:
    mesh = rough_mesh(ground(), faces=12_000)
    frames = house.frames(tmp_path, hidden_side())
    written(tmp_path / "mesh.glb", mesh, frames)
    surface = read(tmp_path / "mesh.glb")
    behind = strip(surface)
    assert behind.sum() > 1000
    assert green(surface.colors[behind]).mean() > 0.97
    off = np.abs(surface.colors[behind] - truth(surface.points[behind, :2])).mean()
    assert off < 8
    on_roof = (surface.points[:, 2] > house.HEIGHT - 0.01) & (np.abs(surface.points[:, :2]) < house.HALF - 0.5).all(1)
    assert (surface.colors[on_roof, 0] - surface.colors[on_roof, 1] > 60).mean() > 0.99


def test_a_roof_that_the_mesh_has_too_small_is_not_laid_on_the_ground_behind_it(tmp_path: Path) -> None:
    """Where the mesh's shadow ends before the true one, the photograph that looks past the edge shows the roof."""
    cloud = ground()
    eaves = house.on_roof(cloud.points[:, :2]) & (cloud.points[:, 0] > house.HALF[0] - 0.2)
    cloud.points[eaves, 2] = 0
    written(tmp_path / "mesh.glb", rough_mesh(cloud, faces=12_000), house.frames(tmp_path, hidden_side()))
    surface = read(tmp_path / "mesh.glb")
    x, y, _ = surface.points.T
    band = (surface.up > 0.99) & (x > 8.3) & (x < 8.6) & (np.abs(y) < 3)
    assert band.sum() > 100
    assert green(surface.colors[band]).mean() > 0.9


def test_the_lens_is_honoured(tmp_path: Path, mesh: Mesh) -> None:
    camera, pose = replace(house.CAMERA, k1=-0.3), nadir(0.0, 0.0, house.ALTITUDE)
    path = tmp_path / "barrel.png"
    cv2.imwrite(str(path), house.photograph(camera, pose)[..., ::-1])
    frame = Frame(path.name, path, camera.width, camera.height, camera, pose)
    written(tmp_path / "mesh.glb", mesh, [frame])
    surface = read(tmp_path / "mesh.glb")
    xy = surface.points[:, :2]
    shown = level(surface, xy) & (np.hypot(*xy.T) > 13) & (np.abs(xy) < [17, 14]).all(1)  # off by 1 m without
    assert shown.sum() > 2000
    assert np.abs(surface.colors - truth(xy))[shown].mean() < 3


def test_what_no_photograph_sees_keeps_the_colours_of_the_cloud_and_is_told(tmp_path: Path) -> None:
    mesh = rough_mesh(ground(), faces=12_000)
    facts = written(tmp_path / "mesh.glb", mesh, house.frames(tmp_path, hidden_side()[:1]))
    surface = read(tmp_path / "mesh.glb")
    behind = strip(surface) & (surface.points[:, 0] < 7.5)  # the mesh's shadow may be a cell or two shorter
    assert green(surface.colors[behind]).mean() > 0.97
    outside = surface.points[:, 0] > 17.5  # beyond the image, which ends 25 m from the camera
    assert np.abs(surface.colors - truth(surface.points[:, :2]))[outside].mean() < 8
    assert surface.colors.min() > 0
    areas, x = mesh.areas(), mesh.vertices[mesh.faces][..., 0]
    surely, perhaps = (areas[mine].sum() / areas.sum() for mine in (x.max(1) < -6.5, x.min(1) < 17))
    assert surely < facts["textured_share"] < perhaps


def test_photographs_of_another_place_leave_the_colours_of_the_cloud(tmp_path: Path, mesh: Mesh) -> None:
    elsewhere = house.frames(tmp_path, [nadir(1000.0, 0.0, house.ALTITUDE), nadir(0.0, 0.0, -50.0)])
    facts = written(tmp_path / "mesh.glb", mesh, elsewhere)
    assert facts["textured_share"] == 0
    surface = read(tmp_path / "mesh.glb")
    flat = level(surface, surface.points[:, :2])
    assert np.abs(surface.colors - truth(surface.points[:, :2]))[flat].mean() < 12
    assert surface.colors.min() > 5


def test_exposures_are_evened_by_the_gains(tmp_path: Path, mesh: Mesh) -> None:
    exposures = dict.fromkeys(range(0, 12, 2), 0.6)
    frames = house.frames(tmp_path, exposures=exposures)
    gains = Gains(np.array([[1 / exposures.get(i, 1.0)] * 3 for i in range(12)]), np.ones(12))
    off = []
    for path, given in ((tmp_path / "even.glb", gains), (tmp_path / "raw.glb", even(12))):
        written(path, mesh, frames, given)
        surface = read(path)
        flat = level(surface, surface.points[:, :2])
        off.append(np.abs(surface.colors - truth(surface.points[:, :2]))[flat].mean())
    assert off[0] < 3
    assert off[1] > 10


def steps_at_seams(path: Path) -> np.ndarray:
    """Differences [N] in colour between the charts that meet at a vertex, on the meadow far from the house."""
    (part,) = trimesh.load_scene(path, process=False).geometry.values()
    image = cv2.blur(np.asarray(part.visual.material.baseColorTexture.convert("RGB")), (5, 5))
    uv = np.asarray(part.visual.uv)
    column, row = (np.column_stack([uv[:, 0], 1 - uv[:, 1]]) * image.shape[1::-1]).astype(int).T
    colors, vertices = image[row, column].astype(float), np.asarray(part.vertices)
    order = np.lexsort(vertices.T)
    i, j = order[:-1], order[1:]
    meet = (vertices[i] == vertices[j]).all(1) & (np.abs(vertices[i][:, [0, 2]]) > house.HALF + 2 * CELL).any(1)
    meet &= (np.abs(vertices[i][:, [0, 2]]) < 17).all(1)  # the cloud's colours begin at the edge of the photographs
    return np.asarray(np.abs(colors[i] - colors[j]).mean(1)[meet])


def test_light_that_falls_off_over_the_image_leaves_no_seams(
    tmp_path: Path, mesh: Mesh, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = house.frames(tmp_path)
    x, y = np.meshgrid(np.linspace(-1, 1, house.CAMERA.width), np.linspace(-1, 1, house.CAMERA.height))
    for frame in frames:
        dark = cv2.imread(str(frame.path)) * (1 - 0.15 * x - 0.15 * y)[..., None]
        cv2.imwrite(str(frame.path), np.rint(dark).astype(np.uint8))
    written(tmp_path / "even.glb", mesh, frames)
    monkeypatch.setattr("overfly.mapping.textured_mesh.movements", lambda colors, *_: np.zeros_like(colors))
    written(tmp_path / "raw.glb", mesh, frames)
    even, raw = steps_at_seams(tmp_path / "even.glb"), steps_at_seams(tmp_path / "raw.glb")
    assert len(even) == len(raw) > 50
    assert raw.mean() > 4
    assert even.mean() < 0.5 * raw.mean()


def test_what_does_not_fit_at_full_size_is_scaled_and_lies_on_several_pages(
    tmp_path: Path, mesh: Mesh, frames: list, textured: tuple[Path, dict], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("overfly.mapping.textured_mesh.lay_out", partial(lay_out, side=128, pages=3))
    facts = written(tmp_path / "mesh.glb", mesh, frames)
    assert 0.3 < facts["texture_scale"] < 1
    assert 2 <= len(facts["texture_px"]) <= 3
    assert max(max(size) for size in facts["texture_px"]) == 128
    surface = read(tmp_path / "mesh.glb")
    assert surface.faces == len(mesh.faces)
    assert facts["textured_share"] == textured[1]["textured_share"]
    flat = level(surface, surface.points[:, :2])
    assert np.abs(surface.colors - truth(surface.points[:, :2]))[flat].mean() < 5


def test_the_same_input_gives_the_same_bytes(tmp_path: Path, textured: tuple[Path, dict], mesh: Mesh, frames) -> None:
    assert written(tmp_path / "again.glb", mesh, frames) == textured[1]
    assert (tmp_path / "again.glb").read_bytes() == textured[0].read_bytes()


def test_a_mesh_without_colours_is_refused(tmp_path: Path, mesh: Mesh, frames: list) -> None:
    with pytest.raises(InputError, match="no colours"):
        written(tmp_path / "mesh.glb", Mesh(mesh.vertices, mesh.faces), frames)
    assert not list(tmp_path.iterdir())
