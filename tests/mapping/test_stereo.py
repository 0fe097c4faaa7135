"""From frames with cameras to a cloud on the ground that they show."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from overfly.errors import InputError
from overfly.geometry import Camera, invert, look_at, pose, rotation_from_gimbal, unproject
from overfly.mapping.consensus import consensus
from overfly.mapping.depth_ranges import Span, depth_ranges
from overfly.mapping.fuse import fuse
from overfly.mapping.neighbours import choose_partners, is_wide
from overfly.mapping.stereo import BASE_TO_HEIGHT, stereo
from overfly.mapping.subpixel import Shot, frame_to_frame, refine

GSD = 80 / 320


@pytest.fixture(scope="module")
def cloud(hill, strips, camera, tmp_path_factory):  # type: ignore[no-untyped-def]
    """The cloud of six frames, cameras given, and nothing else known."""
    folder = tmp_path_factory.mktemp("frames")
    frames = hill.frames(folder, camera, [*strips[:3], *strips[5:]], known=True)
    seen: list[tuple[int, int]] = []
    maps = stereo(frames, workdir=folder / "work", progress=lambda done, total: seen.append((done, total)))
    assert seen[-1] == (6, 6)
    return fuse(maps, frames, workdir=folder / "fused").whole()


def test_the_cloud_lies_on_the_ground(cloud, hill) -> None:  # type: ignore[no-untyped-def]
    off = np.abs(hill.off(cloud.points))
    assert np.median(off) < 0.3 * GSD
    assert (off < 1.0).mean() > 0.99


def test_the_cloud_covers_what_two_frames_see(cloud, hill, strips, camera) -> None:  # type: ignore[no-untyped-def]
    x, y = np.meshgrid(np.arange(-50, 50, 2.0), np.arange(-50, 50, 2.0))
    ground = np.stack([x, y, hill.height(np.stack([x, y], -1))], -1).reshape(-1, 3)
    times = np.zeros(len(ground), int)
    for matrix in [*strips[:3], *strips[5:]]:
        local = (ground - matrix[:3, 3]) @ matrix[:3, :3]
        times += (np.abs(local[:, :2] / local[:, 2:] * camera.fx) < [155, 115]).all(1)
    from scipy.spatial import cKDTree

    away, _ = cKDTree(cloud.points).query(ground[times >= 2])
    assert (away < 1.0).mean() > 0.97


def test_points_carry_colour_views_sigma_and_confidence(cloud, hill) -> None:  # type: ignore[no-untyped-def]
    assert cloud.views.min() >= 2
    assert not cloud.predicted.any()
    assert cloud.confidence.min() > 0
    assert cloud.confidence.max() <= 1
    row, column = ((cloud.points[:, [1, 0]] / hill.size + 0.5) * 960).astype(int).T
    assert np.median(np.abs(cloud.colors[:, 0].astype(float) - hill.texture[row, column])) < 25
    # A stated sigma is a promise: most points lie within two of them.
    off = np.abs(hill.off(cloud.points))
    assert 0.8 < (off < 2 * cloud.sigma_m).mean() <= 1
    assert np.median(cloud.sigma_m) < GSD


def test_at_most_one_point_per_voxel(cloud) -> None:  # type: ignore[no-untyped-def]
    cell = np.floor((cloud.points - cloud.points.min(0)) / GSD)
    assert len(np.unique(cell, axis=0)) > 0.8 * len(cell)


def test_finished_depth_maps_are_reused_and_give_the_same(hill, strips, camera, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    frames = hill.frames(tmp_path, camera, strips[:2], known=True)
    first = stereo(frames, workdir=tmp_path / "work", seed=1)
    before = [m.load()["depth"] for m in first]
    stamps = [m.path.stat().st_mtime_ns for m in first]
    first[1].path.unlink()  # as if killed before the last frame
    again = stereo(frames, workdir=tmp_path / "work", seed=1)
    assert again[0].path.stat().st_mtime_ns == stamps[0]
    for old, new in zip(before, again, strict=True):
        np.testing.assert_array_equal(old, new.load()["depth"])
    assert not list((tmp_path / "work").glob("pair-*"))


def test_several_workers_give_the_same(hill, strips, camera, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    frames = hill.frames(tmp_path, camera, [*strips[:3], *strips[5:7]], known=True)
    alone = stereo(frames, workdir=tmp_path / "one")
    together = stereo(frames, workdir=tmp_path / "three", workers=3)
    assert [m.partners for m in together] == [m.partners for m in alone]
    for one, other in zip(alone, together, strict=True):
        for name, values in one.load().items():
            np.testing.assert_array_equal(values, other.load()[name])
    assert not list((tmp_path / "three").glob("pair-*"))


def test_a_failure_in_a_worker_is_told_and_leaves_what_is_done(hill, strips, camera, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    frames = hill.frames(tmp_path, camera, strips[:3], known=True)

    def failing(views, points):  # type: ignore[no-untyped-def]
        def answer(i, partners, measured):  # type: ignore[no-untyped-def]
            if i == 2:
                raise InputError("Frame 2 is odd.")

        return answer

    with pytest.raises(InputError, match="Frame 2"):
        stereo(frames, workdir=tmp_path / "work", workers=2, opinions=failing)
    assert (tmp_path / "work" / "depth-00000.npz").is_file()
    assert len(stereo(frames, workdir=tmp_path / "work", workers=2)) == 3


def test_bad_input_is_named(hill, strips, camera, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    frames = hill.frames(tmp_path, camera, strips[:2], known=True)
    with pytest.raises(InputError, match="at least two frames"):
        stereo(frames[:1], workdir=tmp_path / "a")
    far = strips[1].copy()
    far[0, 3] += 1000
    cv2.imwrite(str(tmp_path / "blank.png"), np.full((240, 320, 3), 99, np.uint8))
    with pytest.raises(InputError, match="--cameras estimate"):
        stereo([frames[0], replace(frames[1], path=tmp_path / "blank.png")], workdir=tmp_path / "b")
    points = hill.surface(camera, strips[0])[::20, ::20].reshape(-1, 3)
    with pytest.raises(InputError, match="overlap"):
        stereo([frames[0], replace(frames[1], world_from_camera=far)], workdir=tmp_path / "c", points=points)


def test_consensus_takes_the_majority_and_its_weighted_mean() -> None:
    maps = [np.array([[v]], np.float32) for v in (10.0, 10.2, 14.0)]
    sigmas = [np.array([[s]], np.float32) for s in (0.1, 0.2, 0.05)]
    depth, sigma, support = consensus(maps, sigmas)
    # weights 100 and 25: (1000 + 255) / 125
    assert depth[0, 0] == pytest.approx(10.04, abs=1e-4)
    assert sigma[0, 0] == pytest.approx(1 / np.sqrt(125), rel=1e-4)
    assert support[0, 0] == 2
    depth, _, support = consensus([np.full((1, 1), np.nan, np.float32)] * 2, sigmas[:2])
    assert np.isnan(depth[0, 0])
    assert support[0, 0] == 0


def test_refinement_finds_the_fraction_of_a_pixel(hill, strips, camera) -> None:  # type: ignore[no-untyped-def]
    ideal = camera.undistorted()
    poses = strips[:3]
    shots = [Shot(hill.render(ideal, p)[..., 0].astype(np.float32), ideal, p) for p in poses]
    true = ((hill.surface(ideal, poses[1]) - poses[1][:3, 3]) @ poses[1][:3, 2]).astype(np.float32)
    wrong = true * np.float32(1.008)  # 0.7 pixels in the neighbours
    wrong[:20, :20] = np.nan
    found = refine(shots[1], [shots[0], shots[2]], wrong, steps=(-1, -0.5, 0, 0.5, 1))
    inner = np.zeros(true.shape, bool)
    inner[30:-30, 30:-30] = True
    before, after = (np.median(np.abs(d - true)[inner & np.isfinite(d)]) for d in (wrong, found.depth))
    assert before > 0.5
    assert after < 0.06
    assert np.isnan(found.depth[:20, :20]).all()
    assert np.median(found.score[inner]) > 0.9


def test_frame_to_frame_is_projection(strips, camera) -> None:  # type: ignore[no-untyped-def]
    ideal = camera.undistorted()
    q, t = frame_to_frame(ideal, strips[0], ideal, strips[1])
    point = unproject([40.5, 60.5], 77.0, ideal, strips[0])
    local = (invert(strips[1]) @ [*point, 1])[:3]
    third = q[2][60, 40] + t[2] / 77
    assert third * 77 == pytest.approx(local[2], rel=1e-5)
    assert (q[0][60, 40] + t[0] / 77) / third == pytest.approx(local[0] / local[2] * 320 + 160, abs=1e-2)


def level(depth: float) -> Span:
    """Level ground at z = 0, so deep in the middle of frames, which show it to three times that."""
    return Span(0.5 * depth, depth, 3 * depth, -5.0, 0.0, 20.0)


def test_partners_overlap_and_are_far_enough_apart(strips, camera) -> None:  # type: ignore[no-untyped-def]
    poses = [*strips, strips[0]]  # a frame twice at one place measures nothing
    partners = choose_partners([camera] * 9, poses, [level(80.0)] * 9, count=4, ratio=(0.04, 0.9))
    assert all(partners)
    assert 8 not in partners[0]
    assert 1 in partners[0]
    assert any(j >= 4 for j in partners[1])  # across the strips
    assert all(len(p) <= 4 for p in partners)
    assert 3 not in partners[0]  # three steps on, nothing in common


def test_views_that_differ_much_are_partners_where_there_are_no_better_ones(camera) -> None:  # type: ignore[no-untyped-def]
    """On a circle with an image every 60 degrees neighbours see their common ground from 65 degrees apart."""
    angles = np.radians(60.0 * np.arange(6))
    ring = [
        pose(rotation_from_gimbal(float(np.degrees(a)) + 180, -55.0), [125 * np.sin(a), 125 * np.cos(a), 90])
        for a in angles
    ]
    lens = replace(camera, fx=2.0 * camera.width, fy=2.0 * camera.width)  # a wide one shows far ground, too
    wide = choose_partners([lens] * 6, ring, [level(110.0)] * 6, count=4, ratio=BASE_TO_HEIGHT)
    assert all(wide)
    assert not any(choose_partners([lens] * 6, ring, [level(110.0)] * 6, count=4, ratio=(0.04, 0.9)))
    between = pose(rotation_from_gimbal(210.0, -55.0), [125 * np.sin(angles[1] / 2), 125 * np.cos(angles[1] / 2), 90])
    better = choose_partners([lens] * 7, [*ring, between], [level(110.0)] * 7, count=4, ratio=BASE_TO_HEIGHT)
    assert better[0][0] == better[1][0] == 6


def test_partners_of_oblique_frames_are_chosen_by_the_ground_that_they_show(camera) -> None:  # type: ignore[no-untyped-def]
    """Frames of a line look ahead. What the third one shows of the first is at its top, by few pixels, far away and
    large. As deep as the middle, it would lie behind the third camera."""
    lens = replace(camera, fx=0.9 * camera.width, fy=0.9 * camera.width)
    poses = [look_at([0.0, y, 90], [0.0, y + 90, 0]) for y in (0.0, 20.0, 150.0)]
    span = Span(60.0, 127.0, 330.0, -5.0, 0.0, 20.0)
    assert choose_partners([lens] * 3, poses, [span] * 3, count=4, ratio=BASE_TO_HEIGHT)[0] == [1, 2]
    # Where the frame's z axis does not point up there is no level ground: all of it is taken as deep as its middle.
    turned = [pose([[1, 0, 0], [0, -1, 0], [0, 0, -1]], [0, 0, 0]) @ p for p in poses]
    assert choose_partners([lens] * 3, turned, [span] * 3, count=4, ratio=BASE_TO_HEIGHT)[0] == [1]


def test_sky_and_ground_out_of_reach_choose_no_partner(camera) -> None:  # type: ignore[no-untyped-def]
    """Two fifths of a flat view are beyond the farthest surface point: they weighed nine tenths."""
    lens = replace(camera, fx=0.9 * camera.width, fy=0.9 * camera.width)
    flat = [pose(rotation_from_gimbal(0.0, -15.0), [x, y, 60.0]) for y in (0.0, 25.0, 50.0, 300.0) for x in (0.0, 25.0)]
    span = Span(60.0, 200.0, 400.0, -5.0, 0.0, 20.0)
    assert set(choose_partners([lens] * 8, flat, [span] * 8, count=2, ratio=BASE_TO_HEIGHT)[0][:2]) <= {1, 2, 3}
    # Ground over the camera is no ground: all is as deep as the middle, where the next but one is still a partner.
    over = Span(30.0, 100.0, 300.0, 50.0, 70.0, 90.0)
    line = [pose(rotation_from_gimbal(90.0, -25.0), [0.0, 10.0 * k, 60.0]) for k in range(5)]
    assert choose_partners([lens] * 5, line, [over] * 5, count=4, ratio=BASE_TO_HEIGHT)[0][0] == 2


@pytest.mark.parametrize("step", [12.0, 24.0])
def test_frames_that_look_down_have_no_wide_partners(camera, step: float) -> None:  # type: ignore[no-untyped-def]
    poses = [pose(rotation_from_gimbal(0.0, -90.0), [step * x, step * y, 60.0]) for y in range(5) for x in range(5)]
    found = choose_partners([camera] * 25, poses, [level(60.0)] * 25, count=4, ratio=BASE_TO_HEIGHT)
    assert all(0 < len(partners) <= 4 for partners in found)


def test_wide_pairs_search_what_near_ones_show(hill, camera, tmp_path) -> None:  # type: ignore[no-untyped-def]
    around = [look_at([60 * np.sin(t), 60 * np.cos(t), 80], [0, 0, 0]) for t in np.radians(range(0, 360, 30))]
    frames = hill.frames(tmp_path, camera, around, known=True)
    points = hill.surface(camera, around[0])[::20, ::20].reshape(-1, 3)
    searched: list[tuple[float, float]] = []
    from overfly.mapping import stereo as module

    def noted(flight, pair, ranges, matched=module._layout):  # type: ignore[no-untyped-def]
        searched.append((ranges[pair[0]].low, ranges[pair[0]].high))
        return matched(flight, pair, ranges)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_layout", noted)
        stereo(frames, workdir=tmp_path / "work", points=points)
    assert (tmp_path / "work" / "heights.npz").is_file()
    widths = {round(high - low, 1) for low, high in searched}
    assert max(widths) > 1.6 * min(widths)  # near pairs keep the room that the points leave


def test_wide_partners_come_besides_those_that_already_show_the_ground(camera) -> None:  # type: ignore[no-untyped-def]
    """Eighteen images round a place: four neighbours show all of the ground, and houses hide some of it from them."""
    ring = [look_at([63 * np.sin(t), 63 * np.cos(t), 90], [0, 0, 0]) for t in np.radians(20.0 * np.arange(18))]
    lens = replace(camera, fx=0.9 * camera.width, fy=0.9 * camera.width)
    found = choose_partners([lens] * 18, ring, [level(110.0)] * 18, count=2, ratio=BASE_TO_HEIGHT)
    for i, partners in enumerate(found):
        apart = [min((j - i) % 18, (i - j) % 18) for j in partners]
        assert max(apart[:2]) <= 4
        assert len(partners) > 2
        assert all(is_wide(lens, ring[i], 110.0, ring[j]) for j in partners[2:])


def test_depth_ranges_hold_the_points_and_fall_back_to_the_usual(strips, camera, hill) -> None:  # type: ignore[no-untyped-def]
    points = hill.surface(camera, strips[0])[::12, ::12].reshape(-1, 3)
    away = strips[0].copy()
    away[0, 3] += 500
    span, unseen = depth_ranges([camera, camera], [strips[0], away], points)
    depth = (points - strips[0][:3, 3]) @ strips[0][:3, 2]
    assert span.near < depth.min() < span.middle < depth.max() < span.far
    assert span.low < points[:, 2].min()
    assert unseen == span._replace(low=-np.inf, high=np.inf)
    assert span.low < span.ground < points[:, 2].max() < span.high


def test_a_camera_of_another_size_is_scaled(hill, strips, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    camera = Camera(320, 240, 320.0, 320.0, 160.0, 120.0)
    frames = hill.frames(tmp_path, camera, strips[:2], known=True)
    maps = stereo(frames, workdir=tmp_path / "work", max_size=200)
    assert (maps[0].camera.width, maps[0].camera.height) == (200, 150)
    cloud = fuse(maps, frames, workdir=tmp_path / "fused", voxel_m=1.0).whole()
    assert np.median(np.abs(hill.off(cloud.points))) < 0.4
