"""The one DataModule: windows of synthetic flights or of the user's own."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import lightning as L
import torch
from torch.utils.data import DataLoader

from overfly.data.dataset import WindowDataset, WindowSampler, WindowSettings
from overfly.errors import InputError

SPLITS = ("train", "val", "test", "unseen")


class Source(Protocol):
    """Where records of flights come from."""

    def prepare(self, split: str, limit: int | None = None) -> list[Path]:
        """Make or find the records of a split and return their folders; ``limit`` stops after so many flights."""

    def has(self, split: str) -> bool:
        """Whether the split has any flights."""


class FlightDataModule(L.LightningDataModule):
    """Loads windows of flights in batches: see ``overfly.data.dataset.WindowDataset`` for what a batch holds.

    Splits: ``train``, ``val``, ``test`` (other scenes of the trained styles) and ``unseen`` (styles never trained on).
    Testing runs over ``test`` and ``unseen``, in this order, where they exist.
    """

    def __init__(
        self, *, source: Source, windows: dict[str, Any], batch_size: int, workers: int, seed: int, root: Any = None
    ) -> None:
        super().__init__()
        self.source = source
        self.settings = WindowSettings(**windows)
        self.batch_size = batch_size
        self.workers = workers
        self.seed = seed
        self.datasets: dict[str, WindowDataset] = {}

    @property
    def has_test(self) -> bool:
        return bool(self.test_splits)

    @property
    def test_splits(self) -> list[str]:
        return [split for split in ("test", "unseen") if self.source.has(split)]

    def prepare_data(self) -> None:
        """Render what is not in the cache yet (once per machine, before any process reads it)."""
        for split in self._splits():
            self.source.prepare(split, self._limit())

    def setup(self, stage: str) -> None:
        for split in self._splits(stage):
            if split not in self.datasets:
                self.datasets[split] = self.dataset(split)

    def dataset(self, split: str) -> WindowDataset:
        """The windows of a split; a batch must fill at least once."""
        folders = self.source.prepare(split, self._limit())
        dataset = WindowDataset(
            folders, self.settings, seed=self.seed + 1000 * SPLITS.index(split), augment=split == "train"
        )
        if not len(dataset):
            raise InputError(f"The {split} flights hold no window: give more images.")
        return dataset

    def train_dataloader(self) -> DataLoader:
        return self.loader("train", shuffle=True)

    def val_dataloader(self) -> DataLoader:
        return self.loader("val")

    def test_dataloader(self) -> list[DataLoader]:
        return [self.loader(split) for split in self.test_splits]

    def loader(self, split: str, *, shuffle: bool = False) -> DataLoader:
        """A loader of one split; its order depends on the seed and the epoch alone, whatever the number of workers."""
        if split not in self.datasets:
            self.datasets[split] = self.dataset(split)
        dataset = self.datasets[split]
        rank, world = 0, 1
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            rank, world = torch.distributed.get_rank(), torch.distributed.get_world_size()
        if self.batch_size % world:
            raise InputError(
                f"A batch of {self.batch_size} windows does not split among {world} processes: "
                f"set data.batch_size={max(1, self.batch_size // world) * world}."
            )
        sampler = WindowSampler(len(dataset), seed=self.seed, shuffle=shuffle, rank=rank, world=world)
        return DataLoader(
            dataset,
            batch_size=min(self.batch_size // world, len(sampler)),
            sampler=sampler,
            num_workers=self.workers,
            drop_last=shuffle,  # batch normalisation of a single window is undefined
            pin_memory=torch.cuda.is_available(),
            persistent_workers=self.workers > 0,
        )

    def _splits(self, stage: str | None = None) -> list[str]:
        fitting, testing = ["train", "val"], self.test_splits
        return {"fit": fitting, "validate": ["val"], "test": testing}.get(stage or "", [*fitting, *testing])

    def _limit(self) -> int | None:
        """Under fast_dev_run one flight of each split is enough."""
        trainer = self.trainer
        return 1 if trainer is not None and trainer.fast_dev_run else None  # type: ignore[attr-defined]
