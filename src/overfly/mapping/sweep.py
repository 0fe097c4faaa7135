"""The network's say in the depth of every frame: a window round it, its surface, and that surface as a depth map."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from threading import Lock
from typing import Any, Protocol

import numpy as np

from overfly.data.footprints import footprint
from overfly.data.windows import height_range, window_frame, window_sample
from overfly.geometry import Array, Camera, project
from overfly.mapping.culling import Groups
from overfly.mapping.depth_map import Opinion
from overfly.mapping.views import Views

SIDES = tuple(range(64, 193, 32))
"""Sides that the coarsest octave of a network's images may have, pixels."""

OCTAVES = 1
"""Octaves of detail over the coarsest. A second one takes three times as long, and F-scores of flights are the same:
what several frames see is refined at full size anyway, and what one sees is carried on from what is measured."""

PER_FRAME = ("images", "intrinsics", "camera_from_window", "prior_from_window")
"""What a batch holds of each frame [B, K, ...] and a network looks at."""


def reference_alone(batch: Mapping[str, Any]) -> dict[str, Any]:
    """A batch whose windows hold their reference frame only."""
    return {name: value[:, :1] if name in PER_FRAME else value for name, value in batch.items()}


FEWEST = 20
"""Surface points that tell the height of the ground under a frame."""

GROUND_SHARE = 0.3
"""Share of surface points below what is taken for the ground: the others are roofs and trees."""


class TrainedRun(Protocol):
    """What ``overfly.run.load_run`` returns."""

    @property
    def network(self) -> Any: ...

    @property
    def config(self) -> Mapping[str, Any]: ...


class SweepOpinions:
    """Asks a network that predicts surfaces (``model=sweep_decoder``) about one frame after the other.

    Args:
        run: the trained network; its configuration is not needed, since it takes images of any size.
        views: the flight's images and cameras.
        points: surface points [M, 3] in the flight's frame, for the height of the ground and the relief.
        ground_height: of the ground in the flight's frame, where it is better known than by ``points``, which are then
            not looked at: a first look at cameras without sparse points holds many wrong ones.
        metric: whether the flight's frame is in metres; if not, only the relief limits the heights.
    """

    def __init__(
        self, run: TrainedRun, views: Views, points: Array, *, ground_height: float | None = None, metric: bool = True
    ) -> None:
        self.network, self.views, self.metric = run.network.eval(), views, metric
        self.groups = Groups(points)
        self.ground_height = ground_height
        self.cameras = [octave_camera(camera, run.network.size) for camera in views.full]
        self._image = lru_cache(maxsize=16)(lambda i: views.small(i, self.cameras[i]))
        self._lock = Lock()

    def __call__(self, i: int, partners: list[int], measured: Array) -> Opinion | None:
        """The surface of frame i, compared with its partners; None where the frame sees no ground.

        Args:
            i: index of the frame.
            partners: of others.
            measured: surface points [M, 3] of this frame, by which the ground is known best.

        One frame at a time: the network takes the most memory of all, and its kernels are not made for threads.
        """
        with self._lock:
            return self._say(i, partners, measured)

    def _say(self, i: int, partners: list[int], measured: Array) -> Opinion | None:
        import torch

        size = self.cameras[i].width, self.cameras[i].height
        chosen = [i, *(j for j in partners if (self.cameras[j].width, self.cameras[j].height) == size)]
        poses = np.stack([self.views.poses[j] for j in chosen])
        ground, heights = self._heights(i, measured)
        if poses[0, 2, 3] <= ground or not np.isfinite(footprint(self.cameras[i], poses[0], ground)).all():
            return None
        cameras = [self.cameras[j] for j in chosen]
        sample, _ = window_sample([self._image(j) for j in chosen], cameras, poses, ground, heights=heights)
        _, scale = window_frame(cameras[0], poses[0], ground)
        device = next(self.network.parameters()).device
        batch = {name: torch.from_numpy(value)[None].to(device) for name, value in sample.items()}
        with torch.inference_mode():
            answer = self.network(batch)
            depth, along = _depth(answer["height"], batch)
            alone = depth
            if len(chosen) > 1 and bool((answer["views"] < 2).any()):
                alone, _ = _depth(self.network(reference_alone(batch))["height"], batch)
        found = {
            "depth": depth * scale,
            "alone": alone * scale,
            "sigma": answer["sigma"] * along * scale,
            "confidence": answer["confidence"],
        }
        maps = {name: np.asarray(value[0].float().cpu().numpy(), np.float32) for name, value in found.items()}
        return Opinion(**maps, views=answer["views"][0].cpu().numpy().astype(np.uint8))

    def _heights(self, i: int, measured: Array) -> tuple[float, tuple[float, float]]:
        """Height of the ground under a frame, and the heights over it that are looked at."""
        pose, z = self.views.poses[i], self._around(i)
        prior = float(np.quantile(z, GROUND_SHARE)) if self.ground_height is None else self.ground_height
        usual = height_range(float(pose[2, 3]) - prior)
        near = measured[:, 2] - prior
        near = measured[(near > usual[0]) & (near < usual[1]), 2] if self.metric else measured[:, 2]
        if len(near) >= FEWEST:
            z = near
        elif self.ground_height is not None:
            return prior, usual
        low, ground, high = (float(q) for q in np.quantile(z, [0.005, GROUND_SHARE, 0.995]))
        altitude, relief = float(pose[2, 3]) - ground, high - low
        # Key points are rare on roofs' ridges, tree tops and in pits: leave room.
        low, high = low - ground - 0.3 * relief - 0.04 * altitude, high - ground + 0.5 * relief + 0.08 * altitude
        if self.metric and altitude > 0:
            usual = height_range(altitude)
            low, high = min(low, usual[0]), max(high, usual[1])
        return ground, (low, min(high, 0.8 * altitude))

    def _around(self, i: int) -> Array:
        """Heights of the surface points in a frame, of all if there are few."""
        camera, pose = self.views.full[i], self.views.poses[i]
        near = self.groups.points[self.groups.near(camera, pose)]
        pixels, _ = project(near, camera, pose)
        with np.errstate(invalid="ignore"):
            inside = ((pixels > 0) & (pixels < [camera.width, camera.height])).all(1)
        return near[inside, 2] if inside.sum() >= FEWEST else self.groups.points[:, 2]


def octave_camera(camera: Camera, size: tuple[int, int]) -> Camera:
    """An undistorted camera at the sizes that a network takes: its shape, about so many pixels, whole octaves.

    The picture is stretched a little, by 12 % at most, rather than cut: at low overlap every border is needed.
    """
    shape, pixels = np.log(camera.width / camera.height), np.log(size[0] * size[1])

    def misfit(side: tuple[int, int]) -> float:
        w, h = side
        return float(abs(np.log(w / h) - shape) + 0.25 * abs(np.log(w * h) - pixels))

    width, height = min(((w, h) for w in SIDES for h in SIDES), key=misfit)
    octaves = OCTAVES
    while octaves and width * 2**octaves > 1.5 * camera.width:
        octaves -= 1
    return camera.resized(width * 2**octaves, height * 2**octaves)


def _depth(heights: Any, batch: Mapping[str, Any]) -> tuple[Any, Any]:
    """Depth along the optical axis of heights [B, H, W] over the reference's pixels, and depth per height."""
    from overfly.networks.ground import pixel_centres, rays

    b, height, width = heights.shape
    pose = batch["camera_from_window"][:, 0]
    cells = pixel_centres(width, height, width, height, heights.device)
    cast = rays(cells, batch["intrinsics"][:, 0], pose)
    forward = pose[:, 2, :3]
    rate = (cast.rise @ forward[..., None])[..., 0]
    depth = (cast.foot @ forward[..., None])[..., 0] + pose[:, 2:3, 3] + heights.flatten(1) * rate
    return depth.reshape(b, height, width), rate.abs().reshape(b, height, width)
