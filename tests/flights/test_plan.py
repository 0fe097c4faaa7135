"""Flight plans: the measured overlap is the asked one, checked in three independent ways."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from overfly.data.footprints import footprint, ground_overlaps
from overfly.errors import InputError
from overfly.flights.cameras import camera_preset
from overfly.flights.plan import PATHS, plan_flight
from overfly.geometry import gimbal_from_rotation, look_at, pixel_grid, project, unproject

CAMERA = camera_preset("p4p", 192)
SMALL = replace(camera_preset("p4p", 96), k1=-0.08, k2=0.01, p1=0.001)
LENS = replace(CAMERA, k1=-0.08, k2=0.01, p1=0.001)


def flat(xy):
    return np.zeros(len(xy))


def hilly(xy):
    return 8 * np.sin(xy[:, 0] / 60) + 6 * np.cos(xy[:, 1] / 45 + xy[:, 0] / 90) + 0.02 * xy[:, 0]


def plan(path, *, altitude=100.0, overlap=50.0, side=50.0, area=None, ground=flat, camera=CAMERA, seed=0, **more):
    area = area if area is not None else (-2 * altitude, -2 * altitude, 2 * altitude, 2 * altitude)
    return plan_flight(
        path,
        area,
        altitude=altitude,
        overlap=overlap,
        side_overlap=side,
        camera=camera,
        ground=ground,
        rng=np.random.default_rng(seed),
        **more,
    )


@pytest.mark.parametrize("overlap", [0, 30, 50, 80, 95])
def test_flat_grid_is_the_analytic_one(overlap):
    result = plan("grid", overlap=overlap, side=30)
    length, width = 100 * CAMERA.height / CAMERA.fy, 100 * CAMERA.width / CAMERA.fx
    assert result.step_m == pytest.approx((1 - overlap / 100) * length, abs=1e-9)
    assert result.line_spacing_m == pytest.approx(0.7 * width, abs=1e-9)
    assert result.measured_overlap == pytest.approx(overlap, abs=1e-6)
    assert result.measured_side_overlap == pytest.approx(30, abs=1e-6)


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize(("altitude", "overlap"), [(20, 0), (100, 30), (150, 50), (300, 80), (500, 95)])
def test_flat_overlap_by_another_clipping(path, altitude, overlap):
    """On flat ground without a lens the convex clipping of the data package must find the same overlaps."""
    result = plan(path, altitude=altitude, overlap=overlap, frames=16)
    outlines = [footprint(CAMERA, p, 0.0) for p in result.world_from_camera]
    pairs = ground_overlaps(np.stack(outlines))
    index = [i for i in range(len(result) - 1) if result.strip[i] == result.strip[i + 1]]
    assert 100 * np.mean([pairs[i, i + 1] for i in index]) == pytest.approx(overlap, abs=0.5)
    assert result.measured_overlap == pytest.approx(overlap, abs=0.5)


def depth_overlap(camera, a, b, ground):
    """Overlap of two frames from the depth of frame a's pixels (ray marching of a dense sampling, no footprints)."""
    grid = pixel_grid(camera.width, camera.height)
    near, far = np.full(grid.shape[:2], 1.0), np.full(grid.shape[:2], 4.0 * a[2, 3] + 100)
    for _ in range(28):
        middle = (near + far) / 2
        points = unproject(grid, middle, camera, a)
        above = points[..., 2] > ground(points[..., :2].reshape(-1, 2)).reshape(middle.shape)
        near, far = np.where(above, middle, near), np.where(above, far, middle)
    points = unproject(grid, near, camera, a)
    right, down = np.gradient(points, axis=1), np.gradient(points, axis=0)
    weight = np.abs(right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0])
    pixels, _ = project(points, camera, b)
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(-1)
    return (weight * inside).sum() / weight.sum()


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize(("altitude", "overlap"), [(60, 30), (300, 80)])
def test_overlap_over_hills_with_a_lens_by_depth(path, altitude, overlap):
    result = plan(path, altitude=altitude, overlap=overlap, ground=hilly, camera=SMALL, frames=7, side=30)
    poses = result.world_from_camera
    index = [i for i in range(len(result) - 1) if result.strip[i] == result.strip[i + 1]]
    by_depth = np.mean([depth_overlap(SMALL, poses[i], poses[i + 1], hilly) for i in index])
    assert result.measured_overlap == pytest.approx(overlap, abs=0.5)
    assert 100 * by_depth == pytest.approx(overlap, abs=1.0)


def test_overlap_by_the_real_renderer():
    """Rendered depth of the bare terrain of a procedural scene, every path."""
    from overfly.scenes import Renderer, make_scene

    scene = make_scene("village", 3, size_m=400)
    vertices, faces = scene.terrain.mesh()
    bare = replace(
        scene,
        vertices=vertices.astype(np.float32).astype(float),
        faces=faces.astype(np.int32),
        normals=scene.terrain.normals().astype(np.float32),
        material=np.zeros(len(faces), np.int32),
        paint=np.zeros((len(faces), 4), np.float32),
        shape=np.zeros((len(faces), 4), np.float32),
    )
    renderer = Renderer(bare)
    for path in PATHS:
        result = plan(path, overlap=60, ground=scene.ground, camera=LENS, frames=6)
        shares = []
        for a, b in zip(result.world_from_camera[:-1], result.world_from_camera[1:], strict=True):
            depth = renderer.depth(LENS, a)
            assert (depth > 0).all()
            points = unproject(pixel_grid(LENS.width, LENS.height), depth, LENS, a)
            right, down = np.gradient(points, axis=1), np.gradient(points, axis=0)
            weight = np.abs(right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0])
            pixels, _ = project(points, LENS, b)
            inside = ((pixels >= 0) & (pixels < [LENS.width, LENS.height])).all(-1)
            shares.append((weight * inside).sum() / weight.sum())
        same = result.strip[1:] == result.strip[:-1]
        assert 100 * np.mean(np.array(shares)[same]) == pytest.approx(60, abs=1.0)


def test_grid_is_a_serpentine_that_covers_the_area():
    result = plan("grid", altitude=100, overlap=50, side=50)
    xy = result.world_from_camera[:, :2, 3]
    yaws = [gimbal_from_rotation(p[:3, :3])[0] for p in result.world_from_camera]
    for strip in range(result.strip.max() + 1):
        members = result.strip == strip
        assert np.ptp(xy[members, 0]) < 1e-9
        assert np.allclose(np.diff(xy[members, 1]), result.step_m * (1 if strip % 2 == 0 else -1))
        assert np.allclose(np.array(yaws)[members], 0 if strip % 2 == 0 else 180)
    assert np.ptp(xy[:, 1]) + 100 >= 400 - 0.1 * result.step_m
    assert np.ptp(xy[:, 0]) + 150 >= 400 - 0.1 * result.line_spacing_m
    assert np.allclose(result.world_from_camera[:, 2, 3], 100)
    assert np.allclose(result.world_from_camera[:, 2, 2], -1)  # straight down


def test_double_grid_flies_both_directions_tilted():
    result = plan("double_grid")
    gimbal = np.array([gimbal_from_rotation(p[:3, :3]) for p in result.world_from_camera])
    assert np.allclose(gimbal[:, 1], -70)
    assert {0, 90, 180, 270} == set(gimbal[:, 0].round().astype(int).tolist())
    assert result.measured_side_overlap == pytest.approx(50, abs=0.5)
    level = plan("double_grid", tilt_deg=0)
    assert np.allclose(level.world_from_camera[:, 2, 2], -1)


def test_circular_cameras_face_the_middle_of_the_ground():
    result = plan("circular", overlap=80, area=(0.0, 0.0, 100.0, 100.0))
    assert result.radius_m == pytest.approx(100 * np.tan(np.radians(35)))
    for p in result.world_from_camera:
        assert np.allclose(p, look_at(p[:3, 3], [50, 50, 0]), atol=1e-9)
    angles = np.degrees(np.unwrap(np.arctan2(*(result.world_from_camera[:, :2, 3] - 50).T)))
    assert np.allclose(np.diff(angles), result.step_deg)
    assert 300 < np.ptp(angles) + result.step_deg < 420


def test_circular_orbit_widens_where_60_degrees_still_overlap_more():
    result = plan("circular", overlap=30, area=(-50.0, -50.0, 50.0, 50.0))
    assert result.step_deg == pytest.approx(60)
    assert result.radius_m > 1.2 * 100 * np.tan(np.radians(35))
    assert np.allclose([gimbal_from_rotation(p[:3, :3])[1] for p in result.world_from_camera], -55)


def test_large_areas_get_concentric_orbits():
    result = plan("circular", overlap=80, side=60, area=(-400.0, -400.0, 400.0, 400.0))
    radii = np.linalg.norm(result.world_from_camera[:, :2, 3], axis=1)
    assert result.strip.max() >= 2
    for orbit in range(result.strip.max() + 1):
        expected = result.radius_m + orbit * result.line_spacing_m
        assert np.allclose(radii[result.strip == orbit], expected)
    assert result.measured_side_overlap == pytest.approx(60, abs=0.5)


def test_random_walk_stays_in_its_area_and_each_pair_overlaps_as_asked():
    area = (-150.0, -150.0, 150.0, 150.0)
    result = plan("random", altitude=60, overlap=60, area=area, frames=25)
    assert len(result) == 25
    yaws = np.array([gimbal_from_rotation(p[:3, :3])[0] for p in result.world_from_camera])
    assert np.std(np.diff(yaws)) > 20
    middles = np.stack([footprint(CAMERA, p, 0.0).mean(0) for p in result.world_from_camera])
    assert (np.abs(middles) < 155).all()
    pairs = ground_overlaps(np.stack([footprint(CAMERA, p, 0.0) for p in result.world_from_camera]))
    assert np.allclose(100 * np.diagonal(pairs, 1), 60, atol=0.3)


def test_random_needs_the_generator_and_nothing_else():
    one, same, other = (plan("random", seed=s, frames=5).world_from_camera for s in (3, 3, 4))
    assert np.array_equal(one, same)
    assert not np.allclose(one, other)


def test_altitude_is_over_the_mean_ground_and_can_follow_the_terrain():
    result = plan("grid", ground=lambda xy: 300 + 0.1 * xy[:, 0])
    assert np.allclose(result.world_from_camera[:, 2, 3], 400)
    follow = plan("grid", ground=lambda xy: 300 + 0.1 * xy[:, 0], terrain_follow=True)
    assert np.allclose(follow.world_from_camera[:, 2, 3], 400 + 0.1 * follow.world_from_camera[:, 0, 3])


def test_frames_limit():
    for path in PATHS:
        assert 2 <= len(plan(path, overlap=80, side=80, frames=11)) <= 12
    assert len(plan("grid", overlap=80, side=80, frames=11)) == 11


def test_summary_states_the_measured_overlap():
    text = plan("grid").summary()
    assert "overlap 50.0 % (asked 50)" in text
    assert "\n" not in text


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"overlap": 120}, r"overlap=120 is not allowed: give overlap as a number from 0 to 95"),
        ({"overlap": -1}, r"overlap=-1"),
        ({"overlap": float("nan")}, r"overlap=nan"),
        ({"overlap": "50"}, r"overlap='50'"),
        ({"overlap": None}, r"overlap=None"),
        ({"overlap": True}, r"overlap=True"),
        ({"side": 99}, r"side_overlap=99"),
        ({"altitude": -5, "area": (0, 0, 9, 9)}, r"altitude=-5 is not allowed.*from 20 to 500"),
        ({"altitude": 501}, r"altitude=501"),
        ({"altitude": float("inf"), "area": (0, 0, 9, 9)}, r"altitude=inf"),
        ({"tilt_deg": 70}, r"tilt_deg=70"),
        ({"tilt_deg": 58}, r"horizon"),
        ({"frames": 1}, r"frames=1"),
        ({"frames": 2.5}, r"frames=2.5"),
        ({"area": (0, 0, 0, 5)}, r"min under max"),
        ({"area": (0, 0, float("nan"), 5)}, r"min under max"),
        ({"area": 7}, r"x_min, y_min"),
        ({"altitude": 20, "overlap": 95, "side": 95, "area": (0, 0, 4000, 4000)}, r"frames, 20000 are allowed"),
        (
            {"altitude": 20, "ground": lambda xy: 60 * np.sin(xy[:, 0] / 200), "area": (0, 0, 800, 50)},
            r"altitude of at",
        ),
    ],
)
def test_bad_input_is_one_clear_sentence(change, sentence):
    with pytest.raises(InputError, match=sentence):
        plan("grid", **change)


def test_unknown_path_and_too_small_area():
    with pytest.raises(InputError, match=r"'circle' is unknown.*circular"):
        plan("circle")
    with pytest.raises(InputError, match="does not fit"):
        plan("random", overlap=0, area=(0.0, 0.0, 10.0, 10.0))
