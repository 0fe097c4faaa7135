"""Semi-global stereo on one window: the reference frame matched with each of the others, fused, holes closed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from overfly.geometry import Camera
from overfly.mapping.consensus import consensus
from overfly.mapping.matcher import depth_in_frame, disparities, right_disparities
from overfly.mapping.rectify import Relief, ordered, rectify
from overfly.mapping.subpixel import Shot
from overfly.networks.baselines import interpolated
from overfly.networks.correlation import LUMA, Heights
from overfly.networks.ground import pixel_centres, rays
from overfly.networks.poses import inverse
from overfly.networks.sweep import NO_BASE
from overfly.stages.supervision import repeated

DISPARITY_SIGMA = 0.4
"""Standard deviation of a semi-global disparity, pixels."""


def semi_global(batch: Mapping[str, Tensor]) -> Heights:
    """Heights by OpenCV's semi-global matcher at the size of the window's images.

    Pixels without a disparity, and those whose height is outside the height range, get the height interpolated from
    their measured neighbours on the ground; 0 where the window has none.

    Args:
        batch: of windows; ``images``, ``intrinsics``, ``camera_from_window`` and ``height_range`` are taken.
    """
    height, width = batch["images"].shape[-2:]
    cells = pixel_centres(width, height, width, height, torch.device("cpu"))
    feet = rays(cells, batch["intrinsics"][:, 0].cpu(), batch["camera_from_window"][:, 0].cpu()).foot[..., :2].numpy()
    found, measured = [], []
    for number in range(len(batch["images"])):
        window = one_window(batch, number)
        low, high = (float(x) for x in batch["height_range"][number])
        frames = shots(window)
        surface = pair_depth(frames, window, (low, high))[0] * rise(frames[0]) + frames[0].world_from_camera[2, 3]
        known = np.isfinite(surface) & (surface >= low) & (surface <= high)
        surface = np.where(known, surface, 0.0)
        if known.any():
            points = np.column_stack([feet[number][known.ravel()], surface[known]])
            surface[~known] = interpolated(feet[number][~known.ravel()], points)
        found.append(surface)
        measured.append(known)
    device = batch["images"].device
    return Heights(
        torch.from_numpy(np.stack(found)).float().to(device), torch.from_numpy(np.stack(measured)).to(device)
    )


def one_window(batch: Mapping[str, Tensor], number: int) -> dict[str, Tensor]:
    """What stereo needs of one window of a batch, every frame once: short windows repeat some."""
    window = {name: batch[name][number].cpu() for name in ("images", "intrinsics", "camera_from_window")}
    poses = {"camera_from_window": window["camera_from_window"][None]}
    new = ~repeated(poses)[0].tril(-1).any(-1)
    return {name: value[new] for name, value in window.items()}


def shots(window: Mapping[str, Tensor]) -> list[Shot]:
    """The frames of one window, on the CPU: gray values in whole steps, window_from_camera as pose."""
    _, _, height, width = window["images"].shape
    shape = torch.tensor(LUMA)[:, None, None]
    grays = [((image * shape).sum(0) * 255).round().numpy().astype(np.float32) for image in window["images"]]
    cameras = [
        Camera(width, height, *(float(k[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))) for k in window["intrinsics"]
    ]
    return [Shot(*each) for each in zip(grays, cameras, inverse(window["camera_from_window"].double()).numpy())]


def pair_depth(
    frames: Sequence[Shot], window: Mapping[str, Tensor], height_range: tuple[float, float]
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Depth of each pixel of the reference [H, W], window units, NaN where no pair knows it; how many pairs agree."""
    grays = [frame.gray.astype(np.uint8) for frame in frames]
    cameras, poses = [frame.camera for frame in frames], [frame.world_from_camera for frame in frames]
    height, width = grays[0].shape
    ranges = [_depth_range(window, k, height_range) for k in range(len(cameras))]
    depths, sigmas = [], []
    for other in range(1, len(cameras)):
        base = np.linalg.norm(poses[other][:3, 3] - poses[0][:3, 3])
        if base < NO_BASE * abs(poses[0][2, 3]):
            continue  # the same frame again
        left, right = (0, other) if ordered((poses[0], poses[other])) else (other, 0)
        pair = rectify(
            (cameras[left], cameras[right]),
            (poses[left], poses[right]),
            (ranges[left], ranges[right]),
            Relief(height_range[0], 0.0, height_range[1]),
        )
        if pair is None:
            continue
        match = disparities(
            (grays[left], grays[right]), (cameras[left], cameras[right]), (poses[left], poses[right]), pair
        )
        match = match if left == 0 else right_disparities(match)
        depth = depth_in_frame(match, cameras[0], poses[0], pair, right=left != 0)
        depths.append(depth)
        sigmas.append(pair.sigma(depth, DISPARITY_SIGMA))
    if not depths:
        return np.full((height, width), np.nan, np.float32), np.zeros((height, width), np.uint8)
    depth, _, support = consensus(depths, sigmas)
    return depth, support


def rise(frame: Shot) -> NDArray[np.float64]:
    """Height gained per unit of depth along the ray of each pixel [H, W]; negative where it goes down."""
    camera, third = frame.camera, frame.world_from_camera[2]
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height)[:, None] + 0.5 - camera.cy) / camera.fy
    return np.asarray(third[0] * x + third[1] * y + third[2])


def _depth_range(window: Mapping[str, Tensor], frame: int, height_range: tuple[float, float]) -> tuple[float, float]:
    """The nearest and farthest depth at which a frame can see heights of the range."""
    height, width = window["images"].shape[-2:]
    matrix, pose = window["intrinsics"][frame], window["camera_from_window"][frame]
    corners = torch.tensor([[u * width, v * height] for u in (0, 0.5, 1) for v in (0, 0.5, 1)])
    cast = rays(corners, matrix[None], pose[None])
    depths = [(cast.foot + z * cast.rise) @ pose[2, :3] + pose[2, 3] for z in height_range]
    both = torch.stack(depths)
    camera_height = float(inverse(pose)[2, 3])
    nearest = max(float(both.min()), 0.05 * camera_height)
    return nearest, max(float(both.max()), 1.1 * nearest)
