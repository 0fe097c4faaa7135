from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from overfly.networks.poses import inverse, motion, relative, transform_from, true_correction
from terrain import make_batch


def test_motion_agrees_with_scipy_and_has_an_inverse() -> None:
    vectors = np.random.default_rng(0).normal(0, 0.8, (50, 3))
    vectors[0] = 0
    rigid = torch.eye(4, dtype=torch.float64).repeat(50, 1, 1)
    rigid[:, :3, :3] = torch.from_numpy(Rotation.from_rotvec(vectors).as_matrix())
    rigid[:, :3, 3] = torch.arange(150, dtype=torch.float64).reshape(50, 3)
    found = motion(rigid)
    assert np.allclose(found[:, :3], Rotation.from_matrix(rigid[:, :3, :3].numpy()).as_rotvec(), atol=1e-9)
    assert torch.allclose(transform_from(found), rigid)
    assert torch.allclose(inverse(rigid) @ rigid, torch.eye(4, dtype=torch.float64).expand(50, 4, 4), atol=1e-12)


def test_motion_has_a_gradient_at_rest() -> None:
    vector = torch.zeros(1, 6, dtype=torch.float64, requires_grad=True)
    motion(transform_from(vector)).sum().backward()
    assert vector.grad is not None
    assert torch.allclose(vector.grad, torch.ones(1, 6, dtype=torch.float64))


def test_the_true_correction_turns_the_prior_into_the_truth() -> None:
    batch = make_batch(3)
    change = true_correction(batch["prior_from_window"], batch["camera_from_window"])
    corrected = transform_from(change) @ relative(batch["prior_from_window"])
    assert torch.allclose(corrected, relative(batch["camera_from_window"]), atol=1e-5)
    assert change[:, 0].abs().max() < 1e-5  # the reference frame needs none
    assert change[:, 1:].abs().max() > 1e-3


def test_an_error_that_all_frames_share_needs_no_correction() -> None:
    poses = make_batch(1)["camera_from_window"]
    shift = transform_from(torch.tensor([0.0, 0, 0.1, 0.2, 0.1, 0]))
    assert true_correction(poses @ shift, poses).abs().max() < 1e-5
