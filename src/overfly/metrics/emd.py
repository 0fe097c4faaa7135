"""Earth mover's distances, exact, with the convention in the name."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from overfly.metrics.base import CloudMetric, _per_pair
from overfly.metrics.functional import PAPER_POINTS, emd_m, subset


class EmdM(CloudMetric):
    """Mean distance over the best one-to-one assignment; metres.

    Clouds of more than ``points`` points are thinned to random subsets, as in :class:`EmdSum1024`.
    """

    def __init__(self, *, points: int = PAPER_POINTS, seed: int = 0, **kwargs: Any) -> None:
        super().__init__("emd_m", **kwargs)
        self.points, self.seed = points, seed

    def update(self, predicted: Tensor, target: Tensor, *, scale: Tensor | None = None) -> None:
        """Add a batch of pairs; ``scale`` as in the base class."""
        start = self.pairs
        factors = _per_pair(scale, "scale", len(predicted))
        values = [
            emd_of_subsets(p, t, self.points, self.seed, start + i) for i, (p, t) in enumerate(zip(predicted, target))
        ]
        self._add([v if f is None else v * f for v, f in zip(values, factors, strict=True)])


class EmdSum1024(CloudMetric):
    """The paper's Eq. 3: sum of distances over the best assignment of 1024 points, in the frame that is given.

    Subsets and smaller clouds as in :class:`overfly.metrics.chamfer.ChamferSum1024`.
    """

    def __init__(self, *, seed: int = 0, **kwargs: Any) -> None:
        super().__init__("emd_sum_1024", **kwargs)
        self.seed = seed

    def update(self, predicted: Tensor, target: Tensor) -> None:
        """Add a batch of pairs; there is no scale, because the paper's frame has none."""
        start = self.pairs
        values = [
            emd_of_subsets(p, t, PAPER_POINTS, self.seed, start + i) for i, (p, t) in enumerate(zip(predicted, target))
        ]
        self._add([PAPER_POINTS * v for v in values])


def emd_of_subsets(cloud: Any, reference: Any, points: int, *seed: int) -> float:
    """Mean distance over the best assignment of random subsets of ``points`` points, or as many as both clouds have."""
    n = min(points, len(cloud), len(reference))
    return emd_m(subset(cloud, n, *seed, 0), subset(reference, n, *seed, 1))
