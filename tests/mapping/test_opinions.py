"""A network's surface as a depth map, and what becomes of it in the cloud."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import torch

from overfly.geometry import Camera, pixel_grid, rays
from overfly.mapping.depth_map import Opinion
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
