"""A network's surface as a depth map, and what becomes of it in the cloud."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from overfly.files import save_arrays
from overfly.flights import Frame
from overfly.geometry import Camera, pixel_grid, rays
from overfly.mapping.depth_map import DepthMap, Opinion
from overfly.mapping.frame_points import cleaned, frame_points
from overfly.mapping.fuse import fuse
from overfly.mapping.stereo import stereo
from overfly.mapping.sweep import SIDES, SweepOpinions, octave_camera
from overfly.mapping.views import Views

GROUND, ABOVE, SIGMA = -3.0, 5.0, 0.7
NOTHING = np.zeros((0, 3))


class Level(torch.nn.Module):
    """Answers that everything lies ``ABOVE`` metres over the ground; it knows the scale of a window by its GSD."""

    size = (64, 64)
    predicts_surfaces = True

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.seen: list[dict[str, torch.Tensor]] = []

    def forward(self, batch: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        self.seen.append(batch)
        b, k, _, h, w = batch["images"].shape
        flat = torch.ones(b, h, w) / batch["scale"][:, None, None]
        return {
            "height": flat * ABOVE,
            "sigma": flat * SIGMA,
            "confidence": flat * 0 + 0.6,
            "views": torch.full((b, h, w), k),
        }


@dataclass
class Run:
    network: Any = field(default_factory=Level)
    config: dict[str, Any] = field(default_factory=dict)


def test_heights_over_the_ground_become_depths(hill, strips, camera, tmp_path) -> None:  # type: ignore[no-untyped-def]
    views = Views(hill.frames(tmp_path, camera, strips[:3], known=True), 1600)
    x, y = np.meshgrid(np.linspace(-60, 60, 30), np.linspace(-60, 60, 30))
    points = np.stack([x, y, np.full_like(x, GROUND)], -1).reshape(-1, 3)
    run = Run()
    opinion = SweepOpinions(run, views, points)(1, [0, 2], NOTHING)
    assert opinion is not None
    small = run.network.seen[0]["images"].shape
    assert small[1] == 3
    height, width = opinion.depth.shape
    assert (height, width) == tuple(small[3:])
    direction = rays(pixel_grid(width, height), octave_camera(views.full[1], Level.size)) @ strips[1][:3, :3].T
    expected = (GROUND + ABOVE - strips[1][2, 3]) / direction[..., 2]
    np.testing.assert_allclose(opinion.depth, expected, rtol=1e-4)
    tilted = np.abs(direction[..., 2])
    np.testing.assert_allclose(opinion.sigma, SIGMA / tilted, rtol=1e-3)
    assert opinion.views.min() == 3


def test_the_relief_alone_limits_the_heights_without_a_metric_scale(hill, strips, camera, tmp_path) -> None:  # type: ignore[no-untyped-def]
    views = Views(hill.frames(tmp_path, camera, strips[:2], known=True), 1600)
    x, y = np.meshgrid(np.linspace(-60, 60, 30), np.linspace(-60, 60, 30))
    points = np.stack([x, y, np.full_like(x, GROUND)], -1).reshape(-1, 3)
    ranges = []
    for metric in (True, False):
        run = Run()
        SweepOpinions(run, views, points, metric=metric)(0, [1], NOTHING)
        batch = run.network.seen[0]
        ranges.append(np.ptp(batch["height_range"][0].numpy()) * float(batch["scale"][0]))
    assert ranges[0] > 50
    assert ranges[1] < 15


def test_what_pairs_have_measured_tells_the_ground_best(hill, strips, camera, tmp_path) -> None:  # type: ignore[no-untyped-def]
    views = Views(hill.frames(tmp_path, camera, strips[:2], known=True), 1600)
    x, y = np.meshgrid(np.linspace(-60, 60, 30), np.linspace(-60, 60, 30))
    wrong = np.stack([x, y, np.full_like(x, -40.0)], -1).reshape(-1, 3)  # a first look full of wrong matches
    measured = wrong + np.array([0, 0, 40 + GROUND])
    for ground_height, points, expected in ((1.0, measured, GROUND), (1.0, NOTHING, 1.0), (1.0, wrong, 1.0)):
        run = Run()
        opinion = SweepOpinions(run, views, wrong, ground_height=ground_height)(0, [1], points)
        assert opinion is not None
        middle = opinion.depth[opinion.depth.shape[0] // 2, opinion.depth.shape[1] // 2]
        assert strips[0][2, 3] - middle == pytest.approx(expected + ABOVE, abs=1.0)


@pytest.mark.parametrize("shape", [(4000, 3000), (1600, 900), (6000, 4000), (5280, 3956), (3000, 4000)])
def test_a_network_sees_whole_pictures_hardly_stretched(shape) -> None:  # type: ignore[no-untyped-def]
    camera = Camera(*shape, 3000.0, 3000.0, shape[0] / 2, shape[1] / 2)
    small = octave_camera(camera, (128, 96))
    assert small.width % 64 == small.height % 64 == 0  # an octave over multiples of 32
    assert max(small.width, small.height) <= 2 * max(SIDES)
    assert 0.85 < small.fx / small.fy < 1.18
    assert small.fov_deg == pytest.approx(camera.fov_deg)


def test_where_nothing_matches_the_networks_word_stands_and_is_marked(hill, strips, camera, tmp_path) -> None:  # type: ignore[no-untyped-def]
    frames = hill.frames(tmp_path, camera, strips[:2], known=True)

    def truthful(views: Views, points: np.ndarray):  # type: ignore[no-untyped-def]
        def answer(i: int, partners: list[int], measured: np.ndarray) -> Opinion:
            pose = views.poses[i]
            at = (hill.surface(views.full[i], pose) - pose[:3, 3]) @ pose[:3, :3]
            depth = at[..., 2].astype(np.float32)
            j = partners[0]
            there = (hill.surface(views.full[i], pose) - views.poses[j][:3, 3]) @ views.poses[j][:3, :3]
            pixels = there[..., :2] / there[..., 2:] * camera.fx + [camera.cx, camera.cy]
            seen = ((pixels > 0) & (pixels < [camera.width, camera.height])).all(-1)
            return Opinion(depth, np.full_like(depth, 0.3), np.full_like(depth, 0.8), 1 + seen.astype(np.uint8), depth)

        return answer

    stereo_folder, sweep_folder = tmp_path / "stereo", tmp_path / "sweep"
    measured = fuse(stereo(frames, workdir=stereo_folder), frames, workdir=stereo_folder).whole()
    cloud = fuse(stereo(frames, workdir=sweep_folder, opinions=truthful), frames, workdir=sweep_folder).whole()
    assert not measured.predicted.any()
    assert 0.2 < cloud.predicted.mean() < 0.6  # what one frame alone sees
    assert (~cloud.predicted).sum() >= 0.98 * len(measured)
    off = np.abs(hill.off(cloud.points))
    assert np.quantile(off[~cloud.predicted], 0.99) < 1.0
    assert np.quantile(off[cloud.predicted], 0.9) < 1.5  # carried on from what was measured, not as the network said
    from scipy.spatial import cKDTree

    kept, _ = cKDTree(cloud.points).query(measured.points)
    assert (kept < 1e-6).mean() > 0.98
    far, _ = cKDTree(measured.points[:, :2]).query(cloud.points[cloud.predicted][:, :2])
    assert np.median(far) > 2.0  # predicted points lie where nothing was measured
    assert cloud.views[cloud.predicted].max() == 1


@pytest.mark.parametrize(
    ("others", "sure", "share"), [(1, 0.5, 0.5), (1, 0.75, 1.0), (2, 0.75, 0.5), (2, 0.85, 1.0), (4, 0.99, 0.5)]
)
def test_a_word_alone_must_be_surer_the_more_other_frames_see_the_place(
    camera: Camera, others: int, sure: float, share: float, tmp_path: Path
) -> None:
    """What other frames have inside and could not match is mostly wood and water, where networks err, too."""
    shape = camera.height, camera.width
    once = np.zeros(shape, bool)
    once[:, : camera.width // 2] = True
    data = {
        "depth": np.full(shape, 50, np.float32), "sigma": np.ones(shape, np.float32),
        "support": np.zeros(shape, np.uint8), "score": np.full(shape, -1, np.float32),
        "paired": np.zeros(shape, bool), "guessed": np.ones(shape, bool),
        "second": np.ones(shape, bool), "sure": np.full(shape, sure, np.float32), "once": once,
    }  # fmt: skip
    own = DepthMap("a", camera, np.eye(4), [], tmp_path / "a.npz")
    frame = Frame("a", tmp_path / "a.png", camera.width, camera.height, camera=camera)
    Image.fromarray(np.zeros((*shape, 3), np.uint8)).save(frame.path)
    silent = data | {"depth": np.full(shape, np.nan, np.float32)}
    cloud, *_ = frame_points(own, data, [(own, silent, None)] * others, frame, single=True)
    assert cloud.predicted is not None
    assert cloud.predicted.all()
    assert len(cloud) == pytest.approx(share * once.size, abs=camera.height)


def test_no_point_comes_from_where_the_lens_has_shown_nothing(camera: Camera, tmp_path: Path) -> None:
    """Undistorted, a picture has an empty rim: points there were black."""
    shape = camera.height, camera.width
    lens = replace(camera, k1=0.3)
    data = {name: np.ones(shape, np.float32) for name in ("sigma", "sure")} | {
        name: np.ones(shape, bool) for name in ("guessed", "second", "once")
    }
    data |= {"depth": np.full(shape, 50, np.float32), "support": np.zeros(shape, np.uint8)}
    data |= {"score": np.full(shape, -1, np.float32), "paired": np.zeros(shape, bool)}
    frame = Frame("a", tmp_path / "a.png", camera.width, camera.height, camera=lens)
    Image.fromarray(np.full((*shape, 3), 200, np.uint8)).save(frame.path)
    cloud, *_ = frame_points(DepthMap("a", camera, np.eye(4), [], tmp_path / "a.npz"), data, [], frame, single=True)
    assert 0.3 * camera.width * camera.height < len(cloud) < 0.98 * camera.width * camera.height
    assert cloud.colors is not None
    assert cloud.colors.min() > 190


@pytest.mark.parametrize(
    ("partners", "score", "kept"), [(1, 0.35, True), (2, 0.35, False), (2, 0.45, True), (3, 0.5, False)]
)
def test_a_pair_alone_must_correlate_better_where_more_partners_see_the_place(
    camera: Camera, partners: int, score: float, kept: bool, tmp_path: Path
) -> None:
    shape = camera.height, camera.width
    blank = {"sigma": np.full(shape, 0.1, np.float32), "support": np.ones(shape, np.uint8)}
    data = blank | {"depth": np.full(shape, 50, np.float32), "score": np.full(shape, score, np.float32)}
    empty = blank | {"depth": np.full(shape, np.nan, np.float32)}  # sees the place and has matched nothing there
    own, other = (DepthMap(name, camera, np.eye(4), [], tmp_path / f"{name}.npz") for name in ("a", "b"))
    frame = Frame("a", tmp_path / "a.png", camera.width, camera.height, camera=camera)
    Image.fromarray(np.full((*shape, 3), 200, np.uint8)).save(frame.path)
    near = [(other, data, None), *[(other, empty, None)] * (partners - 1)]
    cloud, *_ = frame_points(own, data, near, frame, single=True)
    assert len(cloud) == (camera.width * camera.height if kept else 0)


@pytest.mark.parametrize(("others", "kept"), [(0, True), (1, False)])
def test_a_wall_that_two_frames_alone_see_stands_though_its_depth_changes_from_pixel_to_pixel(
    camera: Camera, others: int, kept: bool, tmp_path: Path
) -> None:
    """Between the depths of two neighbouring pixels of the other frame lies what the first one sees of the wall."""
    shape = camera.height, camera.width
    blank = {"sigma": np.full(shape, 0.01, np.float32), "support": np.ones(shape, np.uint8)}
    wall = np.full(shape, 50, np.float32) + 2 * (np.arange(camera.width) % 2).astype(np.float32)
    data = blank | {"depth": np.full(shape, 51, np.float32), "score": np.full(shape, 0.9, np.float32)}
    own, other = (DepthMap(name, camera, np.eye(4), [], tmp_path / f"{name}.npz") for name in ("a", "b"))
    frame = Frame("a", tmp_path / "a.png", camera.width, camera.height, camera=camera)
    Image.fromarray(np.full((*shape, 3), 200, np.uint8)).save(frame.path)
    empty = blank | {"depth": np.full(shape, np.nan, np.float32)}
    near = [(other, data | {"depth": wall}, None), *[(other, empty, None)] * others]
    cloud, *_ = frame_points(own, data, near, frame, single=True)
    assert len(cloud) == (camera.width * camera.height if kept else 0)
    off = [(other, data | {"depth": wall + 4}, None)]
    assert not len(frame_points(own, data, off, frame, single=True)[0])


@pytest.mark.parametrize("partners", [1, 3])
def test_partners_that_confirm_a_place_do_not_count_against_it(camera: Camera, partners: int, tmp_path: Path) -> None:
    shape = camera.height, camera.width
    data = {"sigma": np.full(shape, 0.1, np.float32), "support": np.ones(shape, np.uint8)}
    data |= {"depth": np.full(shape, 50, np.float32), "score": np.full(shape, 0.35, np.float32)}
    own = DepthMap("a", camera, np.eye(4), [], tmp_path / "a.npz")
    frame = Frame("a", tmp_path / "a.png", camera.width, camera.height, camera=camera)
    Image.fromarray(np.full((*shape, 3), 200, np.uint8)).save(frame.path)
    cloud, *_ = frame_points(own, data, [(own, data, None)] * partners, frame, single=True)
    assert len(cloud) == camera.width * camera.height


@pytest.mark.parametrize(("step", "kept"), [(4, True), (12, False)])
def test_a_sliver_of_wall_is_one_piece_where_its_depth_changes_by_a_few_pixels(
    camera: Camera, step: int, kept: bool, tmp_path: Path
) -> None:
    """``step``: pixels of disparity, of four standard deviations each, from row to row."""
    shape = camera.height, camera.width
    inverse = np.full(shape, np.nan)
    inverse[:20, 10:13] = 0.02 + 4 * step * 1e-5 * np.arange(20)[:, None]
    depth = (1 / inverse).astype(np.float32)
    path = tmp_path / "a.npz"
    save_arrays(
        path,
        {
            "depth": depth,
            "sigma": np.nan_to_num(1e-5 * depth**2, nan=1).astype(np.float16),
            "support": np.ones(shape, np.uint8),
            "score": np.full(shape, 60, np.int8),
            "paired": np.ones(shape, bool),
        },
    )
    found = cleaned(DepthMap("a", camera, np.eye(4), [], path))["depth"]
    assert np.isfinite(found).sum() == (60 if kept else 0)


@pytest.mark.parametrize("others", [None, True])
def test_partners_may_have_images_of_another_shape(camera: Camera, others: bool | None, tmp_path: Path) -> None:
    def level(name: str, lens: Camera, score: float) -> tuple[DepthMap, dict]:
        shape = lens.height, lens.width
        data = {"sigma": np.full(shape, 0.1, np.float32), "support": np.ones(shape, np.uint8)}
        data |= {"depth": np.full(shape, 50, np.float32), "score": np.full(shape, score, np.float32)}
        if others:
            data |= {"second": np.zeros(shape, bool), "guessed": np.zeros(shape, bool)}
        return DepthMap(name, lens, np.eye(4), [], tmp_path / f"{name}.npz"), data

    upright = replace(camera, width=camera.height, height=camera.width, cx=camera.cy, cy=camera.cx)
    own, data = level("a", camera, 0.9)
    partner, seen = level("b", upright, 0.9)
    seen["depth"][:] += 3 * (np.arange(upright.width) % 2)  # so that neighbours are asked, too
    frame = Frame("a", tmp_path / "a.png", camera.width, camera.height, camera=camera)
    Image.fromarray(np.full((camera.height, camera.width, 3), 200, np.uint8)).save(frame.path)
    cloud, *_ = frame_points(own, data, [(partner, seen, None)], frame, single=True)
    assert 0 < len(cloud) < camera.width * camera.height  # what the upright image has inside


def test_what_is_carried_on_states_its_own_sigma_and_passes_no_camera(camera: Camera) -> None:
    shape = camera.height, camera.width
    u = np.arange(camera.width, dtype=np.float32)
    measured = np.where(u < camera.width / 2, 100 - 1.2 * u * 100 / camera.width, np.nan) * np.ones(shape, np.float32)
    wild = np.full(shape, 400, np.float32)  # what the network says, alone, is not what is told
    views = np.ones(shape, np.uint8)
    opinion = Opinion(wild, wild, np.full(shape, 0.9, np.float32), views, wild)
    down = np.diag([1.0, -1, -1, 1])
    settled = opinion.settled(measured.astype(np.float32), camera, down)
    known = np.isfinite(settled.depth)
    assert (settled.depth[known] > 0).all()
    assert known[:, : camera.width // 2].all()
    near = settled.confidence[:, camera.width // 2 + 2]
    assert (settled.confidence[:, -1] < near).all()
    assert (settled.sigma[:, camera.width // 2 + 2] < 3).all()
