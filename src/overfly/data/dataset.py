"""Windows of recorded flights as a map-style dataset, with randomness that depends on (seed, epoch, index) alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch.utils.data import Dataset, Sampler

from overfly.data.footprints import choose_frames, footprint
from overfly.data.record import Record, read_record
from overfly.data.windows import camera_from_window, height_range, to_window, window_sample
from overfly.errors import InputError
from overfly.flights.footprint import polygons
from overfly.geometry import Array, Camera

Index = tuple[int, int]
"""(epoch, index of the window)."""


@dataclass(frozen=True, kw_only=True)
class WindowSettings:
    """How windows are cut from a flight and how wrong their priors are; values in conf/train.yaml."""

    frames: int
    points: int
    choice: str
    ground_sigma_m: float
    position_sigma_m: float
    rotation_sigma_deg: float
    drop_share: float
    light_sigma: float
    colour_sigma: float
    camera_sigma_px: float
    shrink: int

    def __post_init__(self) -> None:
        if self.choice not in ("overlap", "consecutive"):
            raise InputError(f"windows.choice={self.choice} is unknown: choose overlap or consecutive.")


class WindowDataset(Dataset[dict[str, torch.Tensor]]):
    """Every frame of every record as the reference of one window; where too few neighbours exist, frames repeat.

    An item is the dict of tensors without its batch dimension: images [K, 3, H, W], intrinsics [K, 3, 3],
    camera_from_window and prior_from_window [K, 4, 4], depth [K, H, W], reference [N, 3], overlaps [K, K], and the
    scalars scale, gsd, altitude, scene, style, index. Lengths are in window units (see ``overfly.data.windows``).
    """

    def __init__(self, folders: list[Path], settings: WindowSettings, *, seed: int, augment: bool) -> None:
        self.records = [read_record(folder) for folder in folders]
        self.settings = settings
        self.seed = seed
        self.augment = augment
        self.twice = False
        """Whether items hold ``reference_again`` [N, 3], an independent sample of the same surface."""
        self.estimated: dict[int, Array] = {}
        """Poses [n, 4, 4] to go by instead of the true ones, by record; NaN: a frame that was not placed.

        Items then hold the true poses as ``true_camera_from_window`` [K, 4, 4], and ``placed`` [K]. Frames that were
        not placed are left out like those of a map; a reference that was not is looked at alone, by its prior.
        """
        self.windows = [
            (number, window) for number, record in enumerate(self.records) for window in _windows(record, settings)
        ]
        self.styles = sorted({str(record.facts.get("style", "")) for record in self.records})

    def __len__(self) -> int:
        return len(self.windows)

    def __getitem__(self, key: int | Index) -> dict[str, torch.Tensor]:
        epoch, index = key if isinstance(key, tuple) else (0, key)
        number, chosen = self.windows[index]
        record, settings = self.records[number], self.settings
        rng = np.random.default_rng([self.seed, epoch if self.augment else 0, index])
        ground = record.ground_height + rng.normal(0, settings.ground_sigma_m)
        heights = None
        if self.augment:
            chosen = [chosen[0], *(chosen[0] if rng.random() < settings.drop_share else i for i in chosen[1:])]
            low, high = height_range(float(record.world_from_camera[chosen[0], 2, 3] - ground))
            heights = (low * rng.uniform(0.8, 1.3), high * rng.uniform(0.8, 1.3))
        found = self.estimated.get(number)
        placed = np.ones(len(chosen), bool) if found is None else np.isfinite(found[chosen, 0, 0])
        chosen = [i if ok and placed[0] else chosen[0] for i, ok in zip(chosen, placed, strict=True)]
        poses, images, cameras, depth = self._frames(record, chosen)
        priors = disturbed(poses, settings.position_sigma_m, settings.rotation_sigma_deg, rng)
        seen_from = poses if found is None else found[chosen]
        if not placed[0]:
            seen_from = np.repeat(priors[:1], len(chosen), axis=0)
        sample, world_from_window = window_sample(
            images, cameras, seen_from, ground, prior_world_from_camera=priors, heights=heights
        )
        scale = float(sample["scale"])
        if found is not None:
            sample["true_camera_from_window"] = camera_from_window(poses, world_from_window, scale).astype(np.float32)
            sample["placed"] = placed
        if self.augment:
            if settings.colour_sigma:
                sample["images"] = recoloured(sample["images"], settings.colour_sigma, rng)
            sample["images"] = relit(sample["images"], settings.light_sigma, rng)
            turns = np.degrees(settings.camera_sigma_px / cameras[0].fx)
            shaken = disturbed(poses, 0.0, turns, rng)
            shaken[0] = poses[0]  # depth belongs to the reference frame
            shaken[[i == chosen[0] for i in chosen]] = poses[0]
            sample["camera_from_window"] = camera_from_window(shaken, world_from_window, scale).astype(np.float32)
        sample["depth"] = depth / np.float32(scale)
        area = footprint(cameras[0], seen_from[0], ground)
        for name in ("reference", "reference_again") if self.twice else ("reference",):
            sample[name] = reference_points(record, area, world_from_window, scale, settings.points, rng)
        if self.augment and rng.random() < 0.5:
            sample = mirrored(sample)
        tensors = {name: torch.from_numpy(np.array(value)) for name, value in sample.items()}
        for name, value in (
            ("scene", int(record.facts["scene"])),
            ("style", self.styles.index(str(record.facts.get("style", "")))),
            ("index", index),
        ):
            tensors[name] = torch.tensor(value)
        return tensors

    def _frames(self, record: Record, chosen: list[int]) -> tuple[Array, list[NDArray], list[Camera], NDArray]:
        """Poses, images, cameras and depth of frames; images are means over ``shrink`` x ``shrink`` pixels."""
        poses, n = np.asarray(record.world_from_camera[chosen]), self.settings.shrink
        images, cameras = [np.asarray(record.images[i]) for i in chosen], [record.cameras[i] for i in chosen]
        depth = np.asarray(record.depth[chosen], np.float32)
        if n == 1:
            return poses, images, cameras, depth
        height, width = images[0].shape[0] // n, images[0].shape[1] // n
        blocks = [image.reshape(height, n, width, n, 3).mean((1, 3)).round().astype(np.uint8) for image in images]
        return poses, blocks, [c.resized(width, height) for c in cameras], depth[:, n // 2 :: n, n // 2 :: n]


def _windows(record: Record, settings: WindowSettings) -> list[list[int]]:
    """The frames of each window, the reference first."""
    poses, count = np.asarray(record.world_from_camera), settings.frames
    windows = []
    for reference in range(len(record)):
        if settings.choice == "overlap":
            chosen = choose_frames(reference, count, record.cameras, poses, record.ground_height)
        else:
            strip = np.flatnonzero(record.strips == record.strips[reference])
            start = min(reference, max(int(strip[-1]) - count + 1, int(strip[0])))
            chosen = [reference] + [i for i in range(start, start + count) if i in strip and i != reference]
        windows.append([*chosen, *[reference] * (count - len(chosen))][:count])
    return windows


def reference_points(
    record: Record, area: NDArray, world_from_window: NDArray, scale: float, count: int, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Points [count, 3] in window units, uniform in world x, y over an area [4, 2] on the top surface.

    Where the reference covers only a part of the area, all points lie on that part.

    Raises:
        InputError: the reference covers less than a tenth of the area.
    """
    shape, low, high = polygons(area[None])[0], area.min(0), area.max(0)
    kept: list[NDArray] = []
    drawn = found = 0
    while found < count:
        world = rng.uniform(low, high, (2 * count, 2))
        world = world[shapely.contains_xy(shape, world[:, 0], world[:, 1])]
        drawn += len(world)
        kept.append(np.column_stack([world, record.surface(world)]))
        kept[-1] = kept[-1][np.isfinite(kept[-1][:, 2])]
        found += len(kept[-1])
        if drawn > 10 * count and found < 0.1 * drawn:
            raise InputError(
                "The reference covers less than a tenth of a window's ground: give a reference cloud of the whole "
                "flight, or leave out the frames beyond it."
            )
    return to_window(np.concatenate(kept)[:count], world_from_window, scale).astype(np.float32)


def disturbed(poses: NDArray, position_sigma_m: float, rotation_sigma_deg: float, rng: np.random.Generator) -> NDArray:
    """Poses [n, 4, 4] with independent normal errors for each frame and axis, as GPS and gimbal would tell them."""
    noisy = poses.copy()
    turns = Rotation.from_rotvec(np.radians(rng.normal(0, rotation_sigma_deg, (len(poses), 3)))).as_matrix()
    noisy[:, :3, :3] = noisy[:, :3, :3] @ turns
    noisy[:, :3, 3] += rng.normal(0, position_sigma_m, (len(poses), 3))
    return noisy


def relit(images: NDArray[np.float32], sigma: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """Images [K, 3, H, W] in 0..1, each under another exposure, white balance and contrast."""
    gain = np.exp(rng.normal(0, sigma, (len(images), 1, 1, 1)) + rng.normal(0, sigma / 3, (len(images), 3, 1, 1)))
    gamma = np.exp(rng.normal(0, sigma, (len(images), 1, 1, 1)))
    return np.clip(gain * np.maximum(images, 1e-4) ** gamma, 0, 1).astype(np.float32)


def recoloured(images: NDArray[np.float32], sigma: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """Images [K, 3, H, W] in 0..1, all with the same other colours: surfaces that the trained styles do not have.

    Channels are mixed about their mean by a matrix that is the identity within ``sigma``, and all scaled by one factor.
    """
    mixing = (np.eye(3) + rng.normal(0, sigma, (3, 3))) * np.exp(rng.normal(0, sigma))
    mean = images.mean((0, 2, 3), keepdims=True)
    mixed = np.einsum("ij,kjhw->kihw", mixing, images - mean)
    return np.clip(mixed + mean, 0, 1).astype(np.float32)


def mirrored(sample: dict[str, NDArray]) -> dict[str, NDArray]:
    """The window as a mirror shows it: left and right are swapped in the world and so in every image."""
    swapped = dict(sample)
    width = sample["images"].shape[3]
    for name in ("images", "depth"):
        swapped[name] = np.ascontiguousarray(sample[name][..., ::-1])
    swapped["intrinsics"] = sample["intrinsics"].copy()
    swapped["intrinsics"][:, 0, 2] = width - sample["intrinsics"][:, 0, 2]
    swap = np.array([-1, 1, 1, 1], np.float32)
    for name in ("camera_from_window", "prior_from_window"):
        swapped[name] = sample[name] * swap[:, None] * swap
    for name in ("reference", "reference_again"):
        if name in sample:
            swapped[name] = sample[name] * swap[:3]
    return swapped


class WindowSampler(Sampler[Index]):
    """Orders the windows of an epoch by (seed, epoch) alone and shares them among processes.

    It yields (epoch, index), so that a dataset in another process knows the epoch; Lightning calls ``set_epoch``.
    """

    def __init__(self, size: int, *, seed: int, shuffle: bool, rank: int = 0, world: int = 1) -> None:
        self.size, self.seed, self.shuffle, self.rank, self.world = size, seed, shuffle, rank, world
        self.epoch = 0

    def set_epoch(self, epoch: int) -> None:
        self.epoch = epoch

    def __len__(self) -> int:
        return -(-self.size // self.world)

    def __iter__(self) -> Iterator[Index]:
        order = np.arange(self.size)
        if self.shuffle:
            order = np.random.default_rng([self.seed, self.epoch]).permutation(self.size)
        padded = np.resize(order, len(self) * self.world)  # every process takes equally many steps
        for index in padded[self.rank :: self.world]:
            yield self.epoch, int(index)
