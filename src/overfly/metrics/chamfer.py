"""Chamfer distances, with the convention in the name."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from overfly.metrics.base import CloudMetric, LengthMetric
from overfly.metrics.functional import PAPER_POINTS, Distances, chamfer_sum, subset


class ChamferM2(LengthMetric):
    """Mean squared distance to the nearest neighbour, both directions added; square metres (PyTorch3D's)."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("chamfer_m2", **kwargs)

    def value(self, found: Distances) -> float:
        return found.chamfer_m2


class ChamferM(LengthMetric):
    """Mean distance to the nearest neighbour, both directions added; metres (Open3D's, point-cloud-utils')."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("chamfer_m", **kwargs)

    def value(self, found: Distances) -> float:
        return found.chamfer_m


class ChamferSum1024(CloudMetric):
    """The paper's Eq. 2: sum of squared distances, both directions, over 1024 points, in the frame that is given.

    Larger clouds are thinned to random subsets that depend only on ``seed`` and on the number of the pair since the
    last reset; the sum of smaller ones is scaled up to 1024 points.
    """

    def __init__(self, *, seed: int = 0, **kwargs: Any) -> None:
        super().__init__("chamfer_sum_1024", **kwargs)
        self.seed = seed

    def update(self, predicted: Tensor, target: Tensor) -> None:
        """Add a batch of pairs; there is no scale, because the paper's frame has none."""
        start = self.pairs
        self._add([chamfer_sum_1024(p, t, self.seed, start + i) for i, (p, t) in enumerate(zip(predicted, target))])


def chamfer_sum_1024(cloud: Any, reference: Any, *seed: int) -> float:
    """The paper's Eq. 2 over subsets of 1024 points, or of as many as both clouds have, scaled up to 1024."""
    n = min(PAPER_POINTS, len(cloud), len(reference))
    return chamfer_sum(subset(cloud, n, *seed, 0), subset(reference, n, *seed, 1)) * PAPER_POINTS / max(n, 1)
