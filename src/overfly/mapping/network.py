"""The network's way to a dense cloud: windows are cut from the flight, predicted, and put back into the world.

A network answers in window units; ``overfly.data.windows.to_world`` undoes them in float64, so a metre stays a metre.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from overfly.cloud import Cloud, voxel_thin
from overfly.data.footprints import choose_frames, footprint
from overfly.data.windows import resample, to_world, window_camera, window_frame, window_sample
from overfly.errors import InputError
from overfly.geometry import Array, Camera, pose, rotation_from_gimbal
from overfly.mapping.visibility import Image, View, colorize, count_views

Progress = Callable[[int, int], None]


class TrainedRun(Protocol):
    """What ``overfly.run.load_run`` returns."""

    @property
    def network(self) -> Any: ...

    @property
    def config(self) -> Mapping[str, Any]: ...


@dataclass(frozen=True)
class Window:
    """One window of a flight.

    Attributes:
        frames: indices of its K frames, the reference first; frames repeat where too few see the same ground.
        sample: the network's input without a batch dimension (see ``window_sample``).
        world_from_window: [4, 4].
        scale: metres per window unit.
    """

    frames: list[int]
    sample: dict[str, NDArray]
    world_from_window: Array
    scale: float


def network_cloud(
    views: Sequence[View],
    run: TrainedRun,
    *,
    ground_height: float,
    priors: Sequence[NDArray | None] | None = None,
    batch_size: int = 4,
    progress: Progress | None = None,
) -> Cloud:
    """The dense cloud of a flight by a trained network, in the cameras' world frame.

    Args:
        views: frames with cameras.
        run: the trained network and its configuration (``frames``, ``image_size``).
        ground_height: prior height of the ground in the world's z, metres.
        priors: poses from GPS and gimbal [4, 4]; None where unknown (the cameras' own poses are taken).
        batch_size: windows per call of the network.
        progress: called with (windows done, windows in all).

    Returns:
        Points with colour, ``views`` (frames that see the point), ``predicted`` (all are: these networks measure
        nothing that pairs could check), ``sigma_m`` and ``confidence`` (spread and agreement in height between windows,
        see :func:`agreement`). Where windows overlap, one point per voxel of the network's ground sampling distance is
        kept, the most confident one.

    Raises:
        InputError: no camera sees the ground, or the network's answer is not finite.
    """
    import torch

    count, (width, height) = window_settings(run.config)
    cameras, poses = cameras_of(views)
    known = list(poses) if priors is None else [p if q is None else np.asarray(q) for p, q in zip(poses, priors)]
    small = [window_camera(camera, width, height) for camera in cameras]
    images = _SmallImages(views, cameras, small)
    references = [i for i in range(len(views)) if _sees_ground(small[i], poses[i], ground_height)]
    if not references:
        raise InputError(
            f"No camera sees the ground at height {ground_height:.1f} m: check the cameras' heights and directions."
        )
    parts: list[Array] = []
    owners: list[int] = []
    gsds: list[float] = []
    device = next(iter(run.network.parameters()), torch.zeros(0)).device
    for start in range(0, len(references), batch_size):
        windows = [
            cut_window(reference, count, images, small, poses, np.stack(known), ground_height)
            for reference in references[start : start + batch_size]
        ]
        batch = {
            key: torch.from_numpy(np.stack([w.sample[key] for w in windows])).to(device) for key in windows[0].sample
        }
        with torch.inference_mode():
            answer = run.network(batch)["points"]
        predicted = np.asarray(answer.float().cpu().numpy(), np.float64)  # [B, N, 3]
        if not np.isfinite(predicted).all():
            raise InputError("The network's points are not finite: train it again or give another run.")
        for window, points in zip(windows, predicted, strict=True):
            parts.append(to_world(points, window.world_from_window, window.scale))
            owners.append(window.frames[0])
            gsds.append(float(window.sample["gsd"]))
        if progress:
            progress(min(start + batch_size, len(references)), len(references))
    return merge(parts, owners, views, gsd=float(np.median(gsds)))


def window_settings(config: Mapping[str, Any]) -> tuple[int, tuple[int, int]]:
    """K and the image size (width, height) that a run was trained with."""
    try:
        width, height = (int(v) for v in config["image_size"])
        return int(config["frames"]), (width, height)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            "The run's config.yaml does not say frames and image_size: give a run folder that train.py wrote."
        ) from error


def cameras_of(views: Sequence[View]) -> tuple[list[Camera], Array]:
    """Cameras and poses [n, 4, 4] of frames that all have them."""
    cameras = [view.camera for view in views if view.camera is not None]
    poses = [view.world_from_camera for view in views if view.world_from_camera is not None]
    if not len(cameras) == len(poses) == len(views) or not poses:
        raise InputError("A frame without a camera cannot be mapped: give its camera or leave the frame out.")
    return cameras, np.stack(poses).astype(np.float64)


def cut_window(
    reference: int,
    count: int,
    images: Sequence[Image] | _SmallImages,
    cameras: Sequence[Camera],
    poses: Array,
    priors: Array,
    ground_height: float,
) -> Window:
    """The window of a reference frame: its neighbours by ground overlap, itself again where there are too few."""
    chosen = choose_frames(reference, count, cameras, poses, ground_height)
    chosen = (chosen + [reference] * count)[:count]
    sample, world_from_window = window_sample(
        [images[i] for i in chosen],
        [cameras[i] for i in chosen],
        poses[chosen],
        ground_height,
        prior_world_from_camera=priors[chosen],
    )
    # The sample's own scale is rounded to float32.
    _, scale = window_frame(cameras[reference], poses[reference], ground_height)
    return Window(chosen, sample, world_from_window, scale)


def prior_pose(
    position: NDArray | None, gimbal: tuple[float, float, float] | None, fallback: NDArray
) -> NDArray[np.float64]:
    """The pose that GPS (local ENU [3]) and gimbal (yaw, pitch, roll) tell; missing parts come from ``fallback``."""
    fallback = np.asarray(fallback, float)
    rotation = fallback[:3, :3] if gimbal is None else rotation_from_gimbal(*gimbal)
    return pose(rotation, fallback[:3, 3] if position is None else position)


class _SmallImages:
    """The frames' images at the network's size, read once each."""

    def __init__(self, views: Sequence[View], cameras: Sequence[Camera], small: Sequence[Camera]) -> None:
        self.views, self.cameras, self.small = views, cameras, small
        self.kept: dict[int, Image] = {}

    def __getitem__(self, index: int) -> Image:
        if index not in self.kept:
            self.kept[index] = resample(self.views[index].image(), self.cameras[index], self.small[index])
        return self.kept[index]


def _sees_ground(camera: Camera, world_from_camera: NDArray, ground_height: float) -> bool:
    return bool(np.isfinite(footprint(camera, world_from_camera, ground_height)).all())


def merge(parts: Sequence[Array], owners: Sequence[int], views: Sequence[View], *, gsd: float) -> Cloud:
    """One cloud from the windows' points.

    Args:
        parts: world points [N, 3] of each window.
        owners: index of each window's reference frame, which colours its points where it sees them.
        views: the frames.
        gsd: metres per pixel of the network's images.
    """
    points = np.concatenate(parts)
    window = np.repeat(np.arange(len(parts)), [len(p) for p in parts])
    sigma, share = agreement(points, window, gsd)
    # The most confident point of each voxel: the first one after sorting.
    order = np.lexsort((window, -share))
    kept = np.sort(order[voxel_thin(points[order], gsd)])
    points, sigma, share, window = points[kept], sigma[kept], share[kept], window[kept]
    seen = count_views(points, views)
    inside = seen > 0  # a point that no frame sees is outside the survey
    points, sigma, share, seen = points[inside], sigma[inside], share[inside], seen[inside]
    colors = colorize(points, views, np.asarray(owners)[window[inside]])
    return Cloud(
        points,
        colors,
        confidence=share.astype(np.float32),
        sigma_m=sigma.astype(np.float32),
        views=np.minimum(seen, 255).astype(np.uint8),
        predicted=np.ones(len(points), bool),
    )


def agreement(points: NDArray, window: NDArray, gsd: float, neighbours: int = 12) -> tuple[NDArray, NDArray]:
    """How well windows agree about the height around each point.

    Args:
        points: [N, 3].
        window: [N] the window that predicted each point.
        gsd: metres; heights within two of them agree.
        neighbours: nearest points in x, y that are compared.

    Returns:
        ``sigma`` [N] in metres: 1.48 x the median height difference to neighbours of other windows, or, without any,
        to those of its own; and ``share`` [N] in 0..1: the part of the neighbours of other windows that agree, halved
        where there is none to ask.
    """
    from scipy.spatial import cKDTree

    k = min(neighbours + 1, len(points))
    if k < 2:
        return np.full(len(points), gsd), np.zeros(len(points))
    _, found = cKDTree(points[:, :2]).query(points[:, :2], k=k)
    near = np.asarray(found)[:, 1:]
    rise = np.abs(points[near, 2] - points[:, None, 2])
    foreign = window[near] != window[:, None]
    asked = foreign.any(1)
    usable = foreign | ~asked[:, None]
    sigma = 1.4826 * np.nanmedian(np.where(usable, rise, np.nan), axis=1)
    agree = ((rise <= 2 * gsd) & usable).sum(1) / usable.sum(1)
    return np.maximum(sigma, 0.1 * gsd), np.where(asked, agree, 0.5 * agree)
