"""Flights whose cameras are estimated as a map would, and what that does to the truth and to the table."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from overfly.data.dataset import WindowDataset, WindowSettings
from overfly.data.flight_job import FlightJob, record_flight
from overfly.data.record import Record, write_record
from overfly.evaluation.answers import as_true
from overfly.evaluation.cameras import _laid_on, estimate_all, estimated_poses
from overfly.evaluation.measure import camera_values, truths
from overfly.geometry import pixel_grid, project, unproject
from terrain import make_batch

SETTINGS = WindowSettings(
    frames=3, points=64, choice="overlap", ground_sigma_m=2.0, position_sigma_m=1.0, rotation_sigma_deg=1.0, shrink=1,
    drop_share=0.0, light_sigma=0.0, colour_sigma=0.0, camera_sigma_px=0.0,
)  # fmt: skip


@pytest.fixture(scope="module")
def record() -> Record:
    job = FlightJob(
        style="suburb", file=None, seed=4, scene=0, altitude=100.0, overlap=70.0, side_overlap=60.0,
        flight_path={"name": "grid"}, camera="p4p", image_size=(256, 192), images=6, supersample=1,
    )  # fmt: skip
    return record_flight(job)


def off_px(record: Record, poses: np.ndarray) -> list[float]:
    """Median distance, for each frame, between where poses and truth put the ground that it truly sees, pixels."""
    found = []
    for camera, true, pose, depth in zip(record.cameras, record.world_from_camera, poses, record.depth, strict=True):
        pixels = pixel_grid(camera.width, camera.height)[::8, ::8]
        points = unproject(pixels, depth[::8, ::8], camera, true)
        found.append(float(np.nanmedian(np.linalg.norm(project(points, camera, pose)[0] - pixels, axis=-1))))
    return found


def test_cameras_are_found_from_images_and_bad_priors_and_laid_on_the_truth(record: Record, tmp_path: Path) -> None:
    poses = estimated_poses(record, SETTINGS, None, np.random.default_rng(0))
    assert np.isfinite(poses).all()
    assert np.allclose(np.linalg.det(poses[:, :3, :3]), 1)
    assert max(off_px(record, poses)) < 0.6
    assert not np.allclose(poses, record.world_from_camera, atol=1e-4)  # estimated, not looked up
    write_record(record, tmp_path / "record")
    dataset = WindowDataset([tmp_path / "record"], SETTINGS, seed=0, augment=False)
    estimate_all({"test": dataset}, tmp_path / "cameras", None)
    kept = next((tmp_path / "cameras").iterdir())
    assert np.array_equal(np.load(kept), dataset.estimated[0])
    np.save(kept, np.zeros((6, 4, 4)))  # what is kept is not estimated again
    estimate_all({"test": dataset}, tmp_path / "cameras", None)
    assert not dataset.estimated[0].any()


@pytest.mark.parametrize("scale", [0.5, 1.0, 1.05])
def test_only_errors_among_the_cameras_remain(record: Record, scale: float) -> None:
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("xyz", [2, -1, 40], degrees=True).as_matrix()
    moved = record.world_from_camera.copy()
    moved[:, :3, 3] = scale * moved[:, :3, 3] + [30, -20, 5]
    laid = _laid_on(turn @ moved, record)
    assert np.allclose(laid, record.world_from_camera, atol=1e-3)


@pytest.mark.parametrize("fault", ["elsewhere", "looks up"])
def test_a_frame_that_sees_other_ground_is_not_placed(record: Record, fault: str) -> None:
    poses = record.world_from_camera.copy()
    if fault == "elsewhere":
        poses[2, 0, 3] += 400
    else:
        poses[2, :3, :3] = poses[2, :3, :3] @ np.diag([1.0, -1, -1])
    laid = _laid_on(poses, record)
    assert np.isnan(laid[2]).all()
    others = [0, 1, 3, 4, 5]
    assert np.allclose(laid[others], record.world_from_camera[others], atol=1.0)


def test_frames_that_cannot_be_placed_are_nan(record: Record) -> None:
    blank = replace(record, images=np.full_like(record.images, 128))
    assert np.isnan(estimated_poses(blank, SETTINGS, None, np.random.default_rng(0))).all()


def test_the_truth_stays_where_it_is() -> None:
    """A reference camera that is estimated half a metre too high must not lift what it is measured against."""
    batch = make_batch(1, frames=3)
    wrong = {**batch, "true_camera_from_window": batch["camera_from_window"].clone()}
    wrong["camera_from_window"] = batch["camera_from_window"].clone()
    wrong["camera_from_window"][:, 0, 2, 3] += 0.01
    assert torch.equal(as_true(wrong)["camera_from_window"], batch["camera_from_window"])
    assert np.array_equal(truths(wrong)[0].height, truths(batch)[0].height)


def test_errors_of_cameras_are_told_in_pixels_among_each_other() -> None:
    batch = make_batch(1, frames=3)
    assert camera_values(batch, 0) == {}
    turn = torch.eye(4)
    turn[:3, :3] = torch.from_numpy(Rotation.from_euler("y", 1, degrees=True).as_matrix()).float()
    batch["true_camera_from_window"] = batch["camera_from_window"].clone()
    batch["placed"] = torch.tensor([[True, True, False]])
    common = {**batch, "camera_from_window": batch["camera_from_window"] @ turn}  # the whole block, in its own frame
    values = camera_values(common, 0)
    assert values["cameras_placed"][0] == pytest.approx(2 / 3)
    assert values["cameras_px"][0] == pytest.approx(0, abs=1e-4)
    single = {**batch, "camera_from_window": batch["camera_from_window"].clone()}
    for k in (1, 2):
        single["camera_from_window"][:, k] = turn @ single["camera_from_window"][:, k]
    focal = float(batch["intrinsics"][0, 0, 0, 0])
    assert camera_values(single, 0)["cameras_px"][0] == pytest.approx(np.tan(np.radians(1)) * focal, rel=0.2)
