"""Procedural landscapes: deterministic, varied, with the ground where it is said to be."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from overfly.errors import InputError
from overfly.scenes import STYLES, Scene, make_scene, open_scene
from overfly.scenes import materials as m

ARRAYS = ("vertices", "faces", "normals", "material", "paint", "shape")


@pytest.fixture(scope="module", params=STYLES)
def scene(request: pytest.FixtureRequest) -> Scene:
    return make_scene(request.param, 1, size_m=240)


def test_same_seed_same_scene_other_seed_another(scene: Scene) -> None:
    style = scene.name.split("-")[0]
    again, other = make_scene(style, 1, size_m=240), make_scene(style, 2, size_m=240)
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(scene, name), getattr(again, name))
    np.testing.assert_array_equal(scene.cover.kind, again.cover.kind)
    np.testing.assert_array_equal(scene.cover.road, again.cover.road)
    assert len(other.faces) != len(scene.faces) or not np.array_equal(other.vertices, scene.vertices)


def test_arrays_fit_together(scene: Scene) -> None:
    n = len(scene.faces)
    assert scene.material.shape == (n,)
    assert scene.paint.shape == scene.shape.shape == (n, 4)
    assert scene.normals.shape == scene.vertices.shape
    assert scene.faces.min() == 0
    assert scene.faces.max() == len(scene.vertices) - 1
    assert all(np.isfinite(getattr(scene, name)).all() for name in ARRAYS)
    assert (scene.paint[:, :3] >= 0).all()
    assert (scene.paint[:, :3] < 1).all()
    np.testing.assert_array_equal(scene.vertices, scene.vertices.astype(np.float32))


def test_ground_is_level_with_zero_on_average_and_lies_on_the_mesh(scene: Scene) -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform(-120, 120, (20000, 2))
    assert abs(scene.ground(xy).mean()) < 0.5
    ground = scene.faces[scene.material == m.GROUND]
    inside = ground[(np.abs(scene.vertices[ground, :2]) < 119).all((1, 2))][:3000]
    weights = rng.dirichlet((1, 1, 1), len(inside))
    points = (scene.vertices[inside] * weights[..., None]).sum(1)
    np.testing.assert_allclose(scene.ground(points[:, :2]), points[:, 2], atol=1e-4)


def test_objects_stand_within_the_extent_and_on_the_ground(scene: Scene) -> None:
    objects = scene.faces[scene.material != m.GROUND]
    points = scene.vertices[np.unique(objects)]
    assert np.abs(points[:, :2]).max() < 120 + 25
    above = points[:, 2] - scene.ground(points[:, :2])
    assert above.min() > -8
    assert 3 < above.max() < 110


def test_bounds_are_those_of_the_extent(scene: Scene) -> None:
    low, high = scene.bounds
    np.testing.assert_array_equal(low[:2], [-120, -120])
    np.testing.assert_array_equal(high[:2], [120, 120])
    assert low[2] < 0 < high[2]


@pytest.mark.parametrize(
    ("style", "kinds"),
    [
        ("blocks", {m.WALL_WINDOWS, m.ROOF_TILES, m.ROOF_GRAVEL, m.FOLIAGE, m.PAINT}),
        ("campus", {m.FOLIAGE, m.PAINT, m.BARK}),
        ("suburb", {m.WALL_WINDOWS, m.ROOF_TILES, m.FOLIAGE}),
        ("village", {m.ROOF_TILES, m.WALL_PLAIN, m.FOLIAGE}),
        ("industrial", {m.WALL_METAL, m.PAINT}),
        ("vegetation", {m.FOLIAGE}),
    ],
)
def test_each_style_has_what_it_is_known_for(style: str, kinds: set[int]) -> None:
    found = set(np.unique(make_scene(style, 4, size_m=400).material))
    assert kinds <= found


def test_relief_and_size_are_obeyed() -> None:
    flat, steep = make_scene("village", 0, size_m=300, relief=0), make_scene("village", 0, size_m=300, relief=40)
    xy = np.random.default_rng(1).uniform(-150, 150, (5000, 2))
    assert np.ptp(flat.ground(xy)) < 1e-6
    assert 25 < np.ptp(np.percentile(steep.ground(xy), [2, 98])) < 45
    assert steep.extent == (-150, -150, 150, 150)


def test_ground_follows_the_two_triangles_of_a_cell() -> None:
    from overfly.scenes.scene import Heightfield

    field = Heightfield(np.array([0.0, 2.0]), np.array([0.0, 1.0]), np.array([[0.0, 4.0], [1.0, 9.0]]))
    # Below the diagonal: 0 + u 4 + v 5; above it: 0 + v 1 + u 8.
    np.testing.assert_allclose(field([(1.0, 0.25), (0.5, 0.75), (2.0, 1.0)]), [3.25, 2.75, 9.0])


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"style": "blokcs", "seed": 0}, "did you mean 'blocks'"),
        ({"style": "blocks", "seed": -1}, "seed"),
        ({"style": "blocks", "seed": 0, "size_m": 10.0}, "60 to 4000"),
        ({"style": "blocks", "seed": 0, "relief": -3.0}, "relief"),
    ],
)
def test_bad_requests_are_explained(arguments: dict, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        make_scene(**arguments)


def test_open_scene_knows_styles_and_explains_the_rest(tmp_path) -> None:
    assert open_scene("vegetation", 3, size_m=100).name == "vegetation-3"
    with pytest.raises(InputError, match="unknown"):
        open_scene("vegetaton")
    with pytest.raises(InputError, match="does not exist"):
        open_scene(tmp_path / "none.ply")


def test_importing_the_package_is_cheap() -> None:
    heavy = "{'warp', 'torch', 'scipy'} & set(sys.modules)"
    code = f"import sys, overfly.scenes as s; s.STYLES; s.make_scene; print(bool({heavy}))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "False"
