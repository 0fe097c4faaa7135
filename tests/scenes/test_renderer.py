"""The renderer against Embree's rays, against geometry, and its image against the physics that it claims."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from overfly.errors import InputError
from overfly.geometry import Camera, look_at, project, rays, unproject
from overfly.scenes import Appearance, Renderer, Scene, make_scene
from overfly.scenes.builder import Builder, boxes
from overfly.scenes.scene import Heightfield

PINHOLE = Camera.from_fov(320, 240, 60)
LENS = Camera(320, 240, 280.0, 284.0, 155.0, 124.0, k1=-0.21, k2=0.05, p1=0.002, p2=-0.003, k3=-0.01)
NADIR = look_at([3, 5, 150], [3, 5.001, 0])
OBLIQUE = look_at([0, -150, 150], [0, 0, 0])


@pytest.fixture(scope="module")
def city() -> Scene:
    return make_scene("blocks", 2, size_m=300)


@pytest.fixture(scope="module")
def renderer(city: Scene) -> Renderer:
    return Renderer(city)


def table(extra: Builder | None = None) -> Scene:
    """A level square of 200 m, and what a builder adds."""
    line = np.array([-100.0, 100.0])
    field = Heightfield(line, line, np.zeros((2, 2)))
    builder = extra or Builder()
    vertices, faces = field.mesh()
    builder.add(vertices, faces, field.normals(), 14, (0.2, 0.2, 0.2, 0.5))
    return Scene(name="table", terrain=field, extent=(-100, -100, 100, 100), **builder.arrays())


def embree_depth(scene: Scene, camera: Camera, pose: NDArray) -> NDArray:
    pytest.importorskip("embreex", reason="embreex, the independent ray caster, is not installed")
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    world = rtcore_scene.EmbreeScene()
    TriangleMesh(world, (scene.vertices[scene.faces] - pose[:3, 3]).astype(np.float32))
    column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    direction = rays(np.stack([column, row], -1).reshape(-1, 2), camera) @ pose[:3, :3].T
    hit = world.run(np.zeros_like(direction, np.float32), direction.astype(np.float32), output=1)
    return np.where(hit["primID"] >= 0, hit["tfar"], 0).reshape(camera.height, camera.width)


@pytest.mark.parametrize("camera", [PINHOLE, LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize("place", ["nadir", "oblique", "low"])
def test_depth_agrees_with_embree(city: Scene, renderer: Renderer, camera: Camera, place: str) -> None:
    low = look_at([0, -170, float(city.ground([0, -170])[0]) + 15], [30, 100, 0])  # near triangles, and the sky
    pose = {"nadir": NADIR, "oblique": OBLIQUE, "low": low}[place]
    depth, truth = renderer.depth(camera, pose), embree_depth(city, camera, pose)
    assert (np.abs(depth - truth) < 1e-3).mean() >= 0.999
    assert ((depth > 0) == (truth > 0)).mean() >= 0.9999


def test_depth_leads_to_the_mesh(city: Scene, renderer: Renderer) -> None:
    rendered = renderer.render(LENS, NADIR, supersample=1)
    column, row = np.meshgrid(np.arange(320) + 0.5, np.arange(240) + 0.5)
    points = unproject(np.stack([column, row], -1), rendered.depth, LENS, NADIR).reshape(-1, 3)
    heights = renderer.height_map(-150, -150, 150, 150, 0.25)
    level = points[np.abs(points[:, 2] - city.ground(points[:, :2])) < 0.01]
    assert len(level) > 5000  # streets and squares
    cols, rows = ((level[:, 0] + 150) / 0.25).astype(int), ((150 - level[:, 1]) / 0.25).astype(int)
    assert np.median(np.abs(heights[rows, cols] - level[:, 2])) < 0.02


def test_depth_does_not_depend_on_the_samples_per_pixel(renderer: Renderer) -> None:
    depths = [renderer.render(LENS, OBLIQUE, supersample=s).depth for s in (1, 2, 3)]
    np.testing.assert_array_equal(depths[0], renderer.depth(LENS, OBLIQUE))
    assert (np.abs(depths[0] - depths[1]) < 1e-3).mean() > 0.9999
    assert (np.abs(depths[0] - depths[2]) < 1e-3).mean() > 0.9999


def test_a_triangle_under_the_camera_does_not_vanish() -> None:
    """Two triangles of 200 m, seen by a level camera 2 m above them: most of them lies behind the camera."""
    camera = Camera.from_fov(64, 48, 70)
    depth = Renderer(table()).depth(camera, look_at([0, 0, 2], [0, 50, 2]))
    below = np.arange(48) + 0.5 - 24
    expected = np.where(below > 0, 2 * camera.fy / np.abs(below), 0)
    expected[expected > 100] = 0
    np.testing.assert_allclose(depth[:, 32], expected, rtol=1e-5)


def test_nothing_behind_the_camera_is_seen() -> None:
    assert not Renderer(table()).depth(PINHOLE, look_at([0, 0, 50], [0, 0.001, 90])).any()


def test_a_pair_of_images_is_photo_consistent(renderer: Renderer) -> None:
    """Colours of one image, taken to the other by the depth, agree where both see the point."""
    first, second = look_at([-30, 0.01, 150], [0, 0, 0]), look_at([30, 0.01, 150], [0, 0, 0])
    a, b = renderer.render(PINHOLE, first, supersample=4), renderer.render(PINHOLE, second, supersample=4)
    column, row = np.meshgrid(np.arange(320) + 0.5, np.arange(240) + 0.5)
    points = unproject(np.stack([column, row], -1), a.depth, PINHOLE, first)
    pixels, depth = project(points, PINHOLE, second)
    inside = ((pixels > 1) & (pixels < [319, 239])).all(-1)
    x, y = np.where(inside[..., None], pixels, 1).astype(int).transpose(2, 0, 1)
    seen = inside & (np.abs(b.depth[y, x] - depth) < 0.3)
    assert seen.mean() > 0.4
    difference = np.abs(a.image.astype(int) - b.image[y, x]).mean(-1)[seen]  # to the nearest pixel
    shuffled = np.abs(a.image.astype(int) - b.image[:, ::-1]).mean(-1)[seen]
    assert np.median(difference) < 6
    assert np.median(difference) < 0.35 * np.median(shuffled)


def test_height_map_and_surface_of_a_box() -> None:
    builder = Builder()
    boxes(builder, [(10.0, 20.0)], [0.0], [(8.0, 4.0, 6.0)], [0.0], [(0.5, 0.5, 0.5, 0.5)])
    renderer = Renderer(table(builder))
    heights = renderer.height_map(-100, -100, 100, 100, 1.0)
    assert heights.shape == (200, 200)
    assert heights[80, 110] == pytest.approx(6)  # x = 10.5, y = 19.5: row 0 is the north
    assert heights[120, 110] == pytest.approx(0)
    assert (heights > 5).sum() == 8 * 4
    assert np.isnan(renderer.height_map(90, 90, 110, 110, 1.0)[0, -1])
    points = renderer.surface(4000, np.random.default_rng(0), (0, 10, 20, 30))
    assert points.shape == (4000, 3)
    on_top = (np.abs(points[:, :2] - [10, 20]) < [4, 2]).all(1)
    np.testing.assert_allclose(points[:, 2], np.where(on_top, 6, 0), atol=1e-4)
    assert on_top.mean() == pytest.approx(32 / 400, abs=0.01)
    counts = np.histogram2d(points[:, 0], points[:, 1], bins=4)[0]
    assert np.abs(counts - 250).max() < 60


def test_surface_outside_the_scene_is_refused() -> None:
    with pytest.raises(InputError, match="no surface"):
        Renderer(table()).surface(100, np.random.default_rng(0), (500, 500, 600, 600))


def test_a_shadow_falls_away_from_the_sun_by_the_right_length() -> None:
    builder = Builder()
    boxes(builder, [(0.0, 0.0)], [0.0], [(10.0, 10.0, 10.0)], [0.0], [(0.2, 0.2, 0.2, 0.5)])
    renderer = Renderer(table(builder))
    camera = Camera.from_fov(400, 400, 60)
    pose = look_at([0, 0, 100], [0, 1e-4, 0])
    light = Appearance(sun_azimuth_deg=180, sun_elevation_deg=45, haze=0.0)  # from the south: shadow 10 m to the north
    image = renderer.render(camera, pose, supersample=1, appearance=light).image.mean(-1)
    plain = renderer.render(camera, pose, supersample=1, appearance=Appearance(shadows=False, haze=0.0)).image.mean(-1)

    def at(picture: NDArray, x: float, y: float) -> float:
        (pixel,), _ = project([[x, y, 0.0]], camera, pose)
        return float(picture[int(pixel[1]), int(pixel[0])])

    lit, dark = at(image, 0, -12), at(image, 0, 14.0)
    assert dark < 0.75 * lit
    assert at(image, 0, 16.5) == pytest.approx(lit, abs=2)
    assert at(image, 12, 12) == pytest.approx(lit, abs=2)
    assert at(plain, 0, 14.0) == pytest.approx(at(plain, 0, -12), abs=2)


def test_exposure_gain_vignetting_and_noise() -> None:
    renderer = Renderer(table())
    pose = look_at([0, 0, 50], [0, 1e-4, 0])

    def image(rng: np.random.Generator | None = None, **changes: object) -> NDArray:
        return renderer.render(PINHOLE, pose, appearance=Appearance(**changes), rng=rng).image.astype(float)

    plain = image()
    assert image(exposure=0.5).mean() < 0.8 * plain.mean()
    warm = image(gain=(1.3, 1.0, 0.7)).mean((0, 1)) - plain.mean((0, 1))
    assert warm[0] > 5 > abs(warm[1]) + 4 > warm[2]
    dim = image(vignetting=0.5)
    assert dim[0, 0].mean() < 0.8 * dim[120, 160].mean()
    noisy = image(np.random.default_rng(1), noise_std=4.0)
    assert 2 < (noisy - plain).std() < 4
    np.testing.assert_array_equal(noisy, image(np.random.default_rng(1), noise_std=4.0))
    with pytest.raises(InputError, match="rng"):
        image(noise_std=4.0)


def test_textures_fade_instead_of_aliasing(renderer: Renderer) -> None:
    """An image from far away is the mean of many samples, not a random pick of them."""
    far = Camera.from_fov(96, 72, 50)
    pose = look_at([0, 0, 300], [0, 1e-3, 0])
    few, many = (renderer.render(far, pose, supersample=s).image.astype(float) for s in (2, 8))
    assert np.abs(few - many).mean() < 6


def test_frames_have_something_to_match() -> None:
    cv2 = pytest.importorskip("cv2")
    pose = look_at([0, 0, 150], [0, 1e-3, 0])
    image = Renderer(make_scene("suburb", 1, size_m=250)).render(Camera.from_fov(800, 600, 65), pose).image
    assert len(cv2.SIFT_create().detect(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None)) >= 500


def test_sampled_points_lie_on_all_surfaces_by_area() -> None:
    builder = Builder()
    boxes(builder, [(0.0, 0.0)], [0.3], [(40.0, 40.0, 50.0)], [0.0], [(0.6, 0.1, 0.1, 0.5)])
    points, colors = table(builder).sample(20000, np.random.default_rng(0))
    assert points.shape == colors.shape == (20000, 3)
    walls = (points[:, 2] > 0.01) & (points[:, 2] < 49.99)
    assert walls.mean() == pytest.approx(8000 / (8000 + 1600 + 40000), abs=0.01)
    red = colors[walls].astype(int)
    assert (red[:, 0] > red[:, 1] + 50).all()


def test_the_same_view_twice_is_bit_equal(city: Scene, renderer: Renderer) -> None:
    first, again = renderer.render(PINHOLE, OBLIQUE), Renderer(city).render(PINHOLE, OBLIQUE)
    np.testing.assert_array_equal(first.image, again.image)
    np.testing.assert_array_equal(first.depth, again.depth)


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda r: r.render(PINHOLE, np.full((4, 4), np.nan)), "rotation"),
        (lambda r: r.render(PINHOLE, NADIR, supersample=0), "supersample"),
        (lambda r: r.height_map(0, 0, 0, 5, 1.0), "empty"),
        (lambda r: r.height_map(0, 0, 5, 5, 0.0), "resolution"),
        (lambda r: r.depth(Camera(320, 240, 100, 100, 160, 120, k1=-0.9), NADIR), "distortion"),
        (lambda r: Appearance(sun_elevation_deg=-10), "elevation"),
    ],
)
def test_bad_requests_name_what_is_allowed(renderer: Renderer, call, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        call(renderer)
