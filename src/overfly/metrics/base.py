"""What the metric classes share: one value per pair of clouds, summed over batches and processes."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar

import torch
from torch import Tensor
from torchmetrics import Metric

from overfly.metrics.functional import Distances, distances


class CloudMetric(Metric):
    """The mean over pairs of clouds of one value per pair.

    ``update`` takes batches ``predicted`` [B, N, 3] and ``target`` [B, M, 3] (or lists of clouds of differing size);
    ``scale`` [B], metres per unit of the points, turns window units into metres; without it the points are in metres.
    Metrics that share a ``MetricCollection`` search the neighbours of a batch only once.
    """

    is_differentiable = False
    full_state_update = False
    higher_is_better: bool | None = False
    total: Tensor
    count: Tensor

    _last: ClassVar[tuple[list[Tensor], list[Distances]] | None] = None

    def __init__(self, key: str, **kwargs: Any) -> None:
        """``key``: the name under which the value is logged; it carries the convention and the unit, and no dot."""
        super().__init__(**kwargs)
        self.key = key
        # The names of states hold the key: MetricCollection merges metrics whose states have equal names and, after
        # the first batch, equal values, as two F-scores of 0 would have.
        self._names = f"{key}_total", f"{key}_count"
        for name in self._names:
            self.add_state(name, torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    def compute(self) -> Tensor:
        """The mean over all pairs so far; NaN before the first."""
        total, count = (getattr(self, name) for name in self._names)
        return total / count

    @property
    def pairs(self) -> int:
        """How many pairs were added since the last reset."""
        return int(getattr(self, self._names[1]).item())

    def _add(self, values: list[float]) -> None:
        for name, amount in zip(self._names, (sum(values), len(values)), strict=True):
            setattr(self, name, getattr(self, name) + amount)

    @staticmethod
    def _distances(predicted: Tensor, target: Tensor) -> list[Distances]:
        """Distances of each pair; those of the last batch are kept for the next metric that asks for the same."""
        if len(predicted) != len(target):
            raise ValueError(f"Pairs of clouds are compared, but there are {len(predicted)} and {len(target)} clouds.")
        batch = [*predicted, *target]
        last = CloudMetric._last
        if last is None or len(last[0]) != len(batch) or not all(map(_same, last[0], batch)):
            found = [distances(p, t) for p, t in zip(predicted, target)]
            last = CloudMetric._last = ([points.detach().clone() for points in batch], found)
        return last[1]


class LengthMetric(CloudMetric):
    """A cloud metric whose value follows from the distances alone."""

    def update(self, predicted: Tensor, target: Tensor, *, scale: Tensor | None = None) -> None:
        """Add a batch of pairs."""
        found = self._distances(predicted, target)
        factors = _per_pair(scale, "scale", len(found))
        self._add([self.value(d if f is None else d.scaled(f)) for d, f in zip(found, factors, strict=True)])

    @abstractmethod
    def value(self, found: Distances) -> float:
        """The value of one pair, from its distances in metres."""


def _same(a: Tensor, b: Tensor) -> bool:
    return a.device == b.device and a.dtype == b.dtype and torch.equal(a, b)


def _per_pair(values: Tensor | None, what: str, n: int) -> list[float | None]:
    if values is None:
        return [None] * n
    listed = torch.as_tensor(values).detach().double().reshape(-1).tolist()
    if len(listed) != n:
        raise ValueError(f"{what} has {len(listed)} values for {n} pairs of clouds: give one per pair.")
    return listed
