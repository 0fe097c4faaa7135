"""Accuracy and completeness as lengths, and the Hausdorff distance."""

from __future__ import annotations

from typing import Any

from overfly.errors import InputError
from overfly.metrics.base import LengthMetric
from overfly.metrics.functional import Distances


class _Quantile(LengthMetric):
    """A quantile of the distances of each pair (default: the median), averaged over the pairs; metres."""

    name: str

    def __init__(self, quantile: float = 0.5, **kwargs: Any) -> None:
        if not 0 <= quantile <= 1:
            raise InputError(f"The quantile {quantile} is none: give a number from 0 to 1, such as 0.9.")
        label = "median" if quantile == 0.5 else f"p{quantile * 100:g}".replace(".", "_")
        super().__init__(f"{self.name}_{label}_m", **kwargs)
        self.quantile = quantile


class Accuracy(_Quantile):
    """Distances from the prediction to the reference."""

    name = "accuracy"

    def value(self, found: Distances) -> float:
        return found.accuracy_m(self.quantile)


class Completeness(_Quantile):
    """Distances from the reference to the prediction."""

    name = "completeness"

    def value(self, found: Distances) -> float:
        return found.completeness_m(self.quantile)


class HausdorffM(LengthMetric):
    """The largest distance from a point of either cloud to the other, averaged over the pairs; metres."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("hausdorff_m", **kwargs)

    def value(self, found: Distances) -> float:
        return found.hausdorff_m
