"""Windows of recorded flights as a map-style dataset, with randomness that depends on (seed, epoch, index) alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch.utils.data import Dataset, Sampler

from overfly.data.footprints import choose_frames
from overfly.data.record import Record, read_record
from overfly.data.windows import to_window, to_world, window_sample
from overfly.errors import InputError

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
        poses = np.asarray(record.world_from_camera[chosen])
        ground = record.ground_height + rng.normal(0, settings.ground_sigma_m)
        sample, world_from_window = window_sample(
            [np.asarray(record.images[i]) for i in chosen],
            [record.cameras[i] for i in chosen],
            poses,
            ground,
            prior_world_from_camera=_disturb(poses, settings, rng),
        )
        scale = float(sample["scale"])
        sample["depth"] = np.asarray(record.depth[chosen], np.float32) / np.float32(scale)
        sample["reference"] = reference_points(record, world_from_window, scale, settings.points, rng)
        if self.twice:
            sample["reference_again"] = reference_points(record, world_from_window, scale, settings.points, rng)
        tensors = {name: torch.from_numpy(np.array(value)) for name, value in sample.items()}
        for name, value in (
            ("scene", int(record.facts["scene"])),
            ("style", self.styles.index(str(record.facts.get("style", "")))),
            ("index", index),
        ):
            tensors[name] = torch.tensor(value)
        return tensors


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
    record: Record, world_from_window: NDArray, scale: float, count: int, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Points [count, 3] in window units, uniform in x, y over [-1, 1]^2 on the top surface.

    Where the reference covers only a part of the square, all points lie on that part.

    Raises:
        InputError: the reference covers less than a tenth of the square.
    """
    kept: list[NDArray] = []
    for attempt in range(20):
        square = np.concatenate([rng.uniform(-1, 1, (count, 2)), np.zeros((count, 1))], axis=1)
        world = to_world(square, world_from_window, scale)
        world[:, 2] = record.surface(world[:, :2])
        kept.append(world[np.isfinite(world[:, 2])])
        found = sum(map(len, kept))
        if found >= count:
            points = to_window(np.concatenate(kept)[:count], world_from_window, scale)
            return points.astype(np.float32)
        if attempt == 9 and found < count:
            break
    raise InputError(
        "The reference covers less than a tenth of a window's ground: give a reference cloud of the whole flight, "
        "or leave out the frames beyond it."
    )


def _disturb(poses: NDArray, settings: WindowSettings, rng: np.random.Generator) -> NDArray:
    """Poses as GPS and gimbal would tell them: independent normal errors for each frame."""
    noisy = poses.copy()
    turns = Rotation.from_rotvec(np.radians(rng.normal(0, settings.rotation_sigma_deg, (len(poses), 3)))).as_matrix()
    noisy[:, :3, :3] = noisy[:, :3, :3] @ turns
    noisy[:, :3, 3] += rng.normal(0, settings.position_sigma_m, (len(poses), 3))
    return noisy


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
