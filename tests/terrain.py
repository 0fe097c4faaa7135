"""Batches of windows over analytic landscapes: smooth hills with a painted texture, exact depth and cameras."""

from __future__ import annotations

from copy import deepcopy

import numpy as np
import torch
from torch import Tensor


def make_batch(
    windows: int = 2,
    *,
    frames: int = 3,
    width: int = 64,
    height: int = 32,
    relief: float = 0.2,
    seed: int = 0,
    points: int = 1024,
) -> dict[str, Tensor]:
    """A batch as the data module gives it. ``relief`` is the hills' height in window units; 0 is a tilted plane."""
    samples = [_window(np.random.default_rng((seed, i)), frames, width, height, relief, points) for i in range(windows)]
    batch = {key: torch.from_numpy(np.stack([s[key] for s in samples])).float() for key in samples[0]}
    batch["scene"] = torch.arange(windows) + 100 * seed
    batch["style"], batch["index"] = torch.zeros(windows, dtype=torch.int64), torch.arange(windows)
    return batch


def _window(rng, frames, width, height, relief, points):
    waves = rng.normal(0, 1, (4, 2)) * 2.5
    phases = rng.uniform(0, 2 * np.pi, 4)
    slope = rng.uniform(-0.1, 0.1, 2)
    mean = rng.uniform(-1, 1) * relief

    def ground(x, y):
        hills = sum(np.sin(a * x + b * y + p) for (a, b), p in zip(waves, phases))
        return relief * hills / 4 + mean + slope[0] * x + slope[1] * y

    paint = rng.normal(0, 1, (3, 40, 2)) * np.geomspace(3, 45, 40)[:, None]
    paint_phase = rng.uniform(0, 2 * np.pi, (3, 40))

    def colour(x, y):
        angle = x[..., None, None] * paint[..., 0] + y[..., None, None] * paint[..., 1] + paint_phase
        return 0.5 + 0.08 * np.sin(angle).sum(-1)  # [..., 3]

    altitude, focal = 2.0, width  # the footprint of the first frame spans [-1, 1] in x
    intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(u - width / 2) / focal, (v - height / 2) / focal, np.ones_like(u)], -1)
    images, depths, poses, priors = [], [], [], []
    for k in range(frames):
        yaw = 0.0 if k == 0 else rng.uniform(-0.3, 0.3)
        down = np.diag([1.0, -1.0, -1.0])
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        window_from_camera = turn @ down
        centre = np.array([0.0, 0.3 * k, altitude])
        direction = rays @ window_from_camera.T
        depth = np.full_like(u, altitude)
        for _ in range(60):
            at = centre + direction * depth[..., None]
            depth = depth + (ground(at[..., 0], at[..., 1]) - at[..., 2]) / direction[..., 2]
        at = centre + direction * depth[..., None]
        images.append(np.moveaxis(np.clip(colour(at[..., 0], at[..., 1]), 0, 1), -1, 0))
        depths.append(depth)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = window_from_camera.T, -window_from_camera.T @ centre
        poses.append(pose)
        noise = np.eye(4)
        angle = rng.normal(0, 0.02)
        noise[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        noise[:3, 3] = rng.normal(0, 0.02, 3)
        priors.append(noise @ pose)
    xy = rng.uniform(-1, 1, (points, 2))
    reference = np.concatenate([xy, ground(xy[:, 0], xy[:, 1])[:, None]], 1)
    step = np.abs(np.arange(frames)[:, None] - np.arange(frames)[None])
    return {
        "images": np.stack(images),
        "depth": np.stack(depths),
        "intrinsics": np.repeat(intrinsics[None], frames, 0),
        "camera_from_window": np.stack(poses),
        "prior_from_window": np.stack(priors),
        "reference": reference,
        "overlaps": np.clip(1 - 0.3 * step * width / (2 * height), 0, 1),
        "scale": np.array(50.0),
        "gsd": np.array(100.0 / width),
        "altitude": np.array(100.0),
        "height_range": np.array([-0.8, 0.8]),
    }


def make_network(**changes):
    """A tiny GanDecoder for images of 64 x 32 pixels, with the same random weights every time."""
    from overfly.networks import GanDecoder

    parts = {
        "encoder": {"widths": [4, 8, 8, 16], "descriptor": 16, "match_channels": 8, "correction_width": 16},
        "generator": {"width": 8, "blocks": 10, "upsampled_width": 4, "head_width": 16, "candidates": 2},
        "discriminator": {"widths": [8, 16], "strides": [1, 4], "head_width": 8},
    }
    for name in parts:
        parts[name] |= changes.pop(name, {})
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return GanDecoder(**{"size": [64, 32], "points": 256, "features": 32, **parts, **changes})


SWEEP_SIZES = {
    "size": [64, 32],
    "points": 256,
    "features": 32,
    "encoder": {"widths": [8, 8, 8, 16], "descriptor": 16, "match_channels": 8, "correction_width": 16},
    "generator": {
        "hypotheses": 12,
        "groups": 2,
        "coarse_widths": [16, 16],
        "fine_hypotheses": 5,
        "fine_step": 0.5,
        "fine_width": 16,
    },
    "discriminator": {"widths": [8, 16], "strides": [1, 4], "head_width": 8},
}
"""Of a tiny SweepDecoder for images of 64 x 32 pixels."""


def make_sweep_network(**changes):
    """A tiny SweepDecoder, with the same random weights every time; ``changes`` of :data:`SWEEP_SIZES`."""
    from overfly.networks import SweepDecoder

    sizes = deepcopy(SWEEP_SIZES)
    for name in ("encoder", "generator", "discriminator"):
        sizes[name] |= changes.pop(name, {})
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return SweepDecoder(**{**sizes, **changes})


def make_local_network(**changes):
    """A tiny LocalDecoder for images of 64 x 32 pixels, with the same random weights every time."""
    from overfly.networks import LocalDecoder

    parts = {
        "encoder": {"widths": [4, 8, 8, 16], "descriptor": 16, "match_channels": 8, "correction_width": 16},
        "generator": {"width": 16, "layers": 2},
        "discriminator": {"widths": [8, 16], "strides": [1, 4], "head_width": 8},
    }
    for name in parts:
        parts[name] |= changes.pop(name, {})
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return LocalDecoder(**{"size": [64, 32], "points": 256, "features": 32, **parts, **changes})
