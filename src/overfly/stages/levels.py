"""From coarse to fine: which level of a refinement an epoch belongs to, how long its steps are, when it is enough."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from overfly.errors import InputError

LEAST_RATE = 0.1
"""Share of the learning rate that is left at the end of a level."""


PATIENCE = 3
"""Epochs in which the overall loss must not have fallen any more, to have converged."""


class Level(NamedTuple):
    """Faces of the mesh, about, and how many times images are reduced."""

    faces: int
    shrink: int


class Levels:
    """Levels that share the epochs equally.

    Args:
        epochs: in all levels together.
        levels: for each its ``faces`` and ``shrink``.

    Raises:
        InputError: there is no level, fewer epochs than levels, or a level without its two positive numbers.
    """

    def __init__(self, epochs: int, levels: Sequence[Mapping[str, int]]) -> None:
        if not levels:
            raise InputError("stage.levels is empty: give at least one, for instance [{faces: 20000, shrink: 1}].")
        for level in levels:
            if set(level) != {"faces", "shrink"} or min(level.values()) < 1:
                raise InputError(
                    f"The level {dict(level)} is none: give faces and shrink, 1 or more each, "
                    "such as {faces: 20000, shrink: 2}."
                )
        if 0 < epochs < len(levels):
            raise InputError(
                f"{epochs} epochs are too few for {len(levels)} levels: set trainer.max_epochs={len(levels)} or more, "
                "or give fewer stage.levels."
            )
        self.epochs = epochs
        self.levels = [Level(int(level["faces"]), int(level["shrink"])) for level in levels]

    def __getitem__(self, index: int) -> Level:
        return self.levels[index]

    @property
    def last(self) -> int:
        """Index of the last level."""
        return len(self.levels) - 1

    def due(self, epoch: int) -> int:
        """Index of the level that an epoch belongs to."""
        return min(epoch * len(self.levels) // self.epochs, self.last)

    def rate(self, index: int, epoch: float) -> float:
        """Share of the learning rate in a level, after so many epochs of the whole run: it falls along a cosine."""
        share = self.epochs / len(self.levels)
        done = min(max((epoch - index * share) / share, 0.0), 1.0)
        return max((1 + math.cos(math.pi * done)) / 2, LEAST_RATE)


def converged(losses: Sequence[float], *, threshold: float | None, tolerance: float) -> bool:
    """Whether a level's loss has come to rest.

    Args:
        losses: mean of each of its epochs.
        threshold: the lowest of the last :data:`PATIENCE` has to be below it; None: whatever it is.
        tolerance: the loss fell by less than this share in them; 0: it never comes to rest.
    """
    if len(losses) <= PATIENCE or not tolerance:
        return False
    before, now = min(losses[:-PATIENCE]), min(losses[-PATIENCE:])
    return (threshold is None or now < threshold) and before - now < tolerance * abs(before)
