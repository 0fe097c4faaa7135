"""Points that a network predicts in window units land at their true world coordinates."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import torch

from overfly.errors import InputError
from overfly.geometry import Camera, look_at, pose, project, rotation_from_gimbal
from overfly.mapping.network import agreement, merge, network_cloud, prior_pose, window_settings
from overfly.mapping.visibility import colorize, count_views

LENS = Camera(200, 150, 150.0, 150.0, 104.0, 73.0, k1=-0.05)
CORNER = np.array([431_000.0, 5_402_000.0])


@dataclass
class View:
    name: str
    camera: Camera | None
    world_from_camera: np.ndarray | None
    reads: list[str] = field(default_factory=list)

    def image(self) -> np.ndarray:
        assert self.camera is not None
        self.reads.append(self.name)
        image = np.zeros((self.camera.height, self.camera.width, 3), np.uint8)
        image[..., 0] = 10 * int(self.name)
        image[: self.camera.height // 2, :, 1] = 200
        return image


@dataclass
class Run:
    network: Any
    config: dict[str, Any] = field(default_factory=lambda: {"frames": 3, "image_size": [64, 48]})


def heights(xy: np.ndarray) -> np.ndarray:
    """A slope with a 10 m cube on it."""
    local = xy - CORNER
    cube = (np.abs(local) <= 5).all(-1)
    return 100 + 0.05 * local[..., 0] + 10.0 * cube


def flight(n: int = 5, step: float = 25.0) -> list[View]:
    return [
        View(str(i), LENS, pose(rotation_from_gimbal(12.0, -85.0), [CORNER[0], CORNER[1] + step * (i - n // 2), 200.0]))
        for i in range(n)
    ]


class Truth(torch.nn.Module):
    """Answers with the true surface: it finds the world by the first camera, whose true pose it is told."""

    def __init__(self, views: list[View], ground: float) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.views, self.ground = views, ground
        self.calls: list[int] = []

    def forward(self, batch: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        from overfly.data.windows import to_window, to_world, window_camera, window_frame

        answers = []
        for index in range(len(batch["images"])):
            owner = round(float(batch["images"][index, 0, 0].max()) * 255 / 10)
            self.calls.append(owner)
            view = self.views[owner]
            assert view.camera is not None
            assert view.world_from_camera is not None
            frame, scale = window_frame(window_camera(view.camera, 64, 48), view.world_from_camera, self.ground)
            square = np.random.default_rng(owner).uniform(-1, 1, (1024, 3))
            world = to_world(square, frame, scale)
            world[:, 2] = heights(world[:, :2])
            answers.append(to_window(world, frame, scale))
        return {"points": torch.tensor(np.stack(answers), dtype=torch.float32)}


def test_true_points_land_where_they_are_and_a_ten_metre_cube_stays_ten_metres() -> None:
    views = flight()
    network = Truth(views, 100.0).eval()
    told: list[tuple[int, int]] = []
    cloud = network_cloud(
        views, Run(network), ground_height=100.0, batch_size=2, progress=lambda a, b: told.append((a, b))
    )
    assert network.calls == [0, 1, 2, 3, 4]
    assert told[-1] == (5, 5)
    assert len(cloud) > 500
    # float32 in window units of about 70 m: hundredths of a millimetre, at UTM-sized coordinates
    away = np.abs(cloud.points[:, 2] - heights(cloud.points[:, :2]))
    rim = (np.abs(np.abs(cloud.points[:, :2] - CORNER) - 5) < 0.01).any(-1)
    assert away[~rim].max() < 1e-4
    on_cube = cloud.points[cloud.points[:, 2] > 105.0]
    size = np.ptp(on_cube[:, :2], axis=0)
    assert (size <= 10 + 1e-4).all()
    assert (size > 7).all()


def test_views_are_counted_and_no_point_counts_as_measured() -> None:
    """A network that learns landscapes by heart may be right where several frames see a place, but nobody measured."""
    views = flight(2, step=60.0)  # little overlap
    cloud = network_cloud(views, Run(Truth(views, 100.0)), ground_height=100.0)
    assert cloud.views is not None
    assert cloud.predicted is not None
    assert cloud.predicted.all()
    inside = np.zeros(len(cloud), int)
    for view in views:
        assert view.camera is not None
        assert view.world_from_camera is not None
        uv, _ = project(cloud.points, view.camera, view.world_from_camera)
        inside += ((uv >= 0) & (uv < [200, 150])).all(-1)
    assert (cloud.views <= inside).all()  # occlusion may only take away
    assert (cloud.views == inside).mean() > 0.97
    assert 0.2 < (cloud.views < 2).mean() < 0.95


def test_colours_come_from_the_reference_frame() -> None:
    views = flight(3)
    points = np.array([[*CORNER, 100.0], [CORNER[0] + 3, CORNER[1] + 8, 101.0]])
    colors = colorize(points, views, np.array([2, 0]))
    assert colors[:, 0].tolist() == [20, 0]
    assert all(view.reads == [view.name] for view in (views[0], views[2]))
    assert views[1].reads == []


def test_a_point_behind_a_roof_is_not_seen() -> None:
    ground = np.stack(np.meshgrid(np.linspace(-40, 40, 81), np.linspace(-40, 40, 81)), -1).reshape(-1, 2)
    roof = ground[(np.abs(ground) < 10).all(-1)]
    points = np.concatenate([np.column_stack([ground, 0 * ground[:, 0]]), np.column_stack([roof, 0 * roof[:, 0] + 30])])
    camera = Camera.from_fov(160, 160, 60)
    views = [View("0", camera, pose(rotation_from_gimbal(0, -90), [0, 0, 100]))]
    seen = count_views(points, views)
    under = (np.abs(ground) < 8).all(-1)
    assert seen[: len(ground)][under].mean() < 0.05
    assert seen[len(ground) :].mean() > 0.99


def test_disagreeing_windows_lower_confidence_and_raise_sigma() -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform(0, 50, (2000, 2))
    window = np.arange(2000) % 2
    z = np.where((xy[:, 0] > 25) & (window == 1), 3.0, 0.0)
    sigma, share = agreement(np.column_stack([xy, z]), window, 0.5)
    good, bad = xy[:, 0] < 23, xy[:, 0] > 27
    assert share[good].mean() > 0.95
    assert share[bad].mean() < 0.05
    assert np.median(sigma[bad]) == pytest.approx(1.4826 * 3, rel=1e-6)
    assert sigma[good].max() < 1
    alone = merge(
        [np.column_stack([xy, 0 * xy[:, 0]])], [0], [View("0", Camera.from_fov(90, 90, 90), look_down())], gsd=1.0
    )
    assert alone.confidence is not None
    assert alone.confidence.max() <= 0.5


def look_down() -> np.ndarray:
    return pose(rotation_from_gimbal(0, -90), [25, 25, 60])


def test_one_frame_alone_gives_predicted_points_only() -> None:
    views = flight(1)
    cloud = network_cloud(views, Run(Truth(views, 100.0)), ground_height=100.0)
    assert cloud.predicted is not None
    assert cloud.predicted.all()


def test_frames_at_the_horizon_are_left_out_and_none_is_an_error() -> None:
    views = [*flight(3), View("3", LENS, look_at([0, 0, 200], [0, 1000, 900]))]
    network = Truth(views, 100.0)
    network_cloud(views, Run(network), ground_height=100.0)
    assert network.calls == [0, 1, 2]
    with pytest.raises(InputError, match="No camera sees the ground"):
        network_cloud(views[3:], Run(network), ground_height=100.0)


def test_priors_and_settings() -> None:
    base = look_down()
    moved = prior_pose(np.array([1.0, 2, 3]), (90.0, -90.0, 0.0), base)
    np.testing.assert_allclose(moved[:3, 3], [1, 2, 3])
    np.testing.assert_allclose(moved[:3, :3], rotation_from_gimbal(90, -90))
    np.testing.assert_array_equal(prior_pose(None, None, base), base)
    assert window_settings({"frames": 3, "image_size": [128, 96]}) == (3, (128, 96))
    with pytest.raises(InputError, match="frames and image_size"):
        window_settings({})
    with pytest.raises(InputError, match="without a camera"):
        network_cloud([View("0", None, None)], Run(None), ground_height=0.0)


def test_an_answer_of_nan_is_refused() -> None:
    class Broken(torch.nn.Module):
        def forward(self, batch: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
            return {"points": torch.full((len(batch["images"]), 8, 3), torch.nan)}

    with pytest.raises(InputError, match="not finite"):
        network_cloud(flight(2), Run(Broken()), ground_height=100.0)
