"""The accuracies and tables by hand values."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from overfly.metrics import ChamferM, ChamferM2, ChamferSum1024
from overfly.networks.ground import pixel_centres
from overfly.networks.matching import cell_pixels, true_correspondences
from overfly.stages.clouds import window_emd, window_metrics
from overfly.stages.retrieval import RetrievalTop1, window_hits
from overfly.stages.supervision import correction_errors, matching_counts, overlapping, repeated
from terrain import make_batch


def unit_grid() -> np.ndarray:
    """1024 points in a square grid over [-1, 1]^2 at height 0."""
    cells = pixel_centres(2, 2, 32, 32, torch.device("cpu")) - 1
    return np.column_stack([cells.numpy(), np.zeros(1024)])


def test_window_metrics_of_a_lifted_grid() -> None:
    grid = unit_grid()
    lifted = grid + np.array([0, 0, 0.01])
    found = window_metrics(lifted, grid, 50.0)  # 0.5 m too high; the grid's step is 3.125 m
    assert found["chamfer_m2"] == pytest.approx(2 * 0.5**2, rel=1e-4)
    assert found["chamfer_m"] == pytest.approx(2 * 0.5, rel=1e-4)
    assert found["chamfer_sum_1024"] == pytest.approx(1024 * 2 * 0.01**2, rel=1e-4)
    assert found["height_error_m"] == pytest.approx(0.5, rel=1e-4)
    assert window_emd(lifted, grid) == pytest.approx(1024 * 0.01, rel=1e-4)


def test_near_counts_within_two_percent_of_the_footprints_width() -> None:
    grid = unit_grid()
    half = np.where(grid[:, :1] > 0, [[0, 0, 0.039]], [[0, 0, 0.041]])  # the width is 2: 2 % are 0.04
    found = window_metrics(grid + half, grid, 50.0)
    assert found["precision_2pct"] == found["recall_2pct"] == found["near_2pct"] == found["fscore_2pct"] == 0.5
    assert found["fscore_1pct"] == 0
    assert window_metrics(grid + np.array([0, 0, 0.019]), grid, 50.0)["fscore_1pct"] == 1
    few = window_metrics(grid[grid[:, 0] > 0], grid, 50.0)
    assert few["precision_2pct"] == 1
    assert few["recall_2pct"] == pytest.approx(0.5)
    assert few["near_2pct"] == pytest.approx(0.75)


def perfect_maps(batch: dict[str, torch.Tensor]) -> torch.Tensor:
    """Match maps that encode the true ground coordinates: the accuracy's upper end."""
    b, k, h, w = batch["depth"].shape
    pixels = cell_pixels(h // 2, w // 2).expand(b, -1, -1)
    maps = []
    for i in range(k):
        rays = torch.cat([pixels, torch.ones_like(pixels[..., :1])], -1) @ torch.linalg.inv(
            batch["intrinsics"][:, i]
        ).transpose(1, 2)
        depth = F.avg_pool2d(batch["depth"][:, i : i + 1], 2).flatten(2).transpose(1, 2)
        pose = torch.linalg.inv(batch["camera_from_window"][:, i])
        ground = (rays * depth) @ pose[:, :3, :3].transpose(1, 2) + pose[:, None, :3, 3]
        directions = torch.randn(3, 64, generator=torch.Generator().manual_seed(0)) * 6
        phases = ground @ directions
        maps.append(F.normalize(torch.cat([phases.sin(), phases.cos()], -1), dim=-1).transpose(1, 2))
    return torch.stack(maps, 1).unflatten(3, (h // 2, w // 2))


def test_matching_accuracy_is_one_for_perfect_maps_and_small_for_noise() -> None:
    batch = make_batch(2)
    right, visible = matching_counts({"match_map": perfect_maps(batch)}, batch, 64)
    assert visible > 20
    assert right / visible > 0.98
    noise = F.normalize(torch.randn(2, 3, 16, 16, 32, generator=torch.Generator().manual_seed(0)), dim=2)
    right, visible = matching_counts({"match_map": noise}, batch, 64)
    assert right / visible < 0.1


def test_only_visible_key_points_count() -> None:
    batch = make_batch(1, frames=2)
    batch["depth"][:, 1] = 0
    assert matching_counts({"match_map": perfect_maps(make_batch(1, frames=2))}, batch, 64) == (0, 0)


def test_a_repeated_frame_does_not_count_as_its_own_partner() -> None:
    batch = make_batch(1, frames=2)
    for key in ("images", "depth", "intrinsics", "camera_from_window"):
        batch[key][:, 1] = batch[key][:, 0]
    assert repeated(batch).all()
    assert matching_counts({"match_map": perfect_maps(batch)}, batch, 64)[1] == 0
    assert not overlapping(batch)[0].any()


def test_retrieval_counts_hits_by_ground_overlap() -> None:
    e = torch.eye(6)
    top1 = RetrievalTop1()
    overlap = torch.tensor([[1.0, 0.5], [0.5, 1.0]])
    # Scene 0: both frames alike: hits. Scene 1: the second frame looks like scene 0's.
    top1.update(torch.stack([torch.stack([e[0], e[0]])]), overlap[None], torch.tensor([0]))
    top1.update(
        torch.stack([torch.stack([e[1], F.normalize(e[0] + 0.1 * e[1], dim=0)])]), overlap[None], torch.tensor([1])
    )
    assert top1.compute().item() == pytest.approx(3 / 4)
    hits, asked = window_hits(torch.cat(top1.descriptors), torch.cat(top1.overlaps), torch.cat(top1.scenes))
    assert hits.tolist() == [2, 1]
    assert asked.tolist() == [2, 2]
    # Another window of scene 0 is left out of the gallery; one without any overlap is not asked.
    top1.update(torch.stack([torch.stack([e[0], e[2]])]), torch.eye(2)[None], torch.tensor([0]))
    assert top1.compute().item() == pytest.approx(3 / 4)
    lonely = RetrievalTop1()
    lonely.update(e[None, :2], torch.eye(2)[None], torch.tensor([0]))
    assert torch.isnan(lonely.compute())


def test_correspondences_decide_among_the_nearest_by_descriptor() -> None:
    e = torch.eye(6)
    overlap = torch.tensor([[1.0, 0.5], [0.5, 1.0]]).expand(2, 2, 2)
    descriptors = torch.stack([torch.stack([e[0], e[1]]), torch.stack([e[0], e[1]])])
    scenes = torch.tensor([0, 1])
    assert window_hits(descriptors, overlap, scenes)[0].tolist() == [0, 0]  # each is taken for the other scene's
    asked: list[list[int]] = []

    def verify(frame: int, others: torch.Tensor) -> torch.Tensor:
        asked.append(others.tolist())
        return (others // 2 == frame // 2).float()

    assert window_hits(descriptors, overlap, scenes, verify)[0].tolist() == [2, 2]
    assert all(frame not in others and len(others) == 3 for frame, others in enumerate(asked))


def test_pairs_of_one_scene_in_other_windows_are_neither_positive_nor_negative() -> None:
    batch = make_batch(3, frames=2)
    batch["scene"] = torch.tensor([5, 5, 6])
    positive, negative = overlapping(batch)
    assert positive.sum() == 6
    assert not positive.diagonal().any()
    assert not negative[:4, :4].any()
    assert negative[:4, 4:].all()


def test_frames_of_a_window_that_share_no_ground_are_negatives() -> None:
    batch = make_batch(windows=1, frames=3)
    batch["overlaps"] = torch.tensor([[[1.0, 0.4, 0.3], [0.4, 1.0, 0.0], [0.3, 0.0, 1.0]]])
    positive, negative = overlapping(batch)
    assert positive.tolist() == [[False, True, True], [True, False, False], [True, False, False]]
    assert negative.tolist() == [[False, False, False], [False, False, True], [False, True, False]]


def test_correction_errors_in_metres_and_degrees() -> None:
    batch = make_batch(2)
    batch["prior_from_window"] = batch["camera_from_window"].clone()
    batch["prior_from_window"][:, 1, 0, 3] += 0.1  # 5 m at 50 m per unit, one of two frames
    none = {"correction": torch.zeros(2, 2, 6)}
    errors = correction_errors(none, batch)
    assert errors["prior_position_m"].item() == pytest.approx(2.5, rel=1e-3)
    assert errors["prior_rotation_deg"].item() == pytest.approx(0, abs=0.05)
    assert errors["corrected_position_m"].item() == pytest.approx(2.5, rel=1e-3)
    right = {"correction": torch.zeros(2, 2, 6)}
    right["correction"][:, 0, 3] = -0.1
    assert correction_errors(right, batch)["corrected_position_m"].item() == pytest.approx(0, abs=1e-3)


def test_key_points_of_the_analytic_scene_are_truly_there() -> None:
    batch = make_batch(1)
    pixels = cell_pixels(16, 32)[None]
    views = [(batch["depth"][:, i], batch["intrinsics"][:, i], batch["camera_from_window"][:, i]) for i in (0, 1)]
    there, visible = true_correspondences(pixels, *views[0], *views[1])
    back, seen = true_correspondences(there, *views[1], *views[0])
    both = visible & seen
    assert both.sum() > 50
    assert (back - pixels)[both].abs().max() < 0.05


def test_window_metrics_agree_with_the_metric_classes() -> None:
    generator = np.random.default_rng(0)
    cloud, reference = generator.normal(0, 1, (2, 1024, 3))
    found = window_metrics(cloud, reference, 40.0)
    pair, scale = (torch.from_numpy(cloud)[None], torch.from_numpy(reference)[None]), torch.tensor([40.0])
    for metric, key in ((ChamferM2(), "chamfer_m2"), (ChamferM(), "chamfer_m")):
        metric.update(*pair, scale=scale)
        assert float(metric.compute()) == pytest.approx(found[key], rel=1e-6)
    paper = ChamferSum1024()
    paper.update(*pair)
    assert float(paper.compute()) == pytest.approx(found["chamfer_sum_1024"], rel=1e-6)
