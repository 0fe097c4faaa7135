"""Precision, recall and F-score at thresholds in metres or in ground sampling distances."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

from torch import Tensor

from overfly.errors import InputError
from overfly.metrics.base import CloudMetric, _per_pair
from overfly.metrics.functional import Distances

UNITS = ("m", "gsd")


class _Share(CloudMetric):
    """A share of points nearer than a threshold (strictly).

    Args:
        threshold: the limit, above 0.
        unit: "m", or "gsd" for multiples of the metres per pixel that ``update`` is given.
    """

    higher_is_better = True
    name: str

    def __init__(self, threshold: float, *, unit: str = "m", **kwargs: Any) -> None:
        if unit not in UNITS or not threshold > 0:
            raise InputError(f"A threshold of {threshold} {unit} is none: give a number above 0 and the unit m or gsd.")
        super().__init__(f"{self.name}_{_label(threshold, unit)}", **kwargs)
        self.threshold, self.unit = threshold, unit

    def update(
        self, predicted: Tensor, target: Tensor, *, scale: Tensor | None = None, gsd: Tensor | None = None
    ) -> None:
        """Add a batch of pairs; ``gsd`` [B] is metres per pixel, needed for thresholds in that unit."""
        if self.unit == "gsd" and gsd is None:
            raise ValueError(f"{self.key} needs the ground sampling distance: call update(..., gsd=batch['gsd']).")
        found = self._distances(predicted, target)
        scales, gsds = _per_pair(scale, "scale", len(found)), _per_pair(gsd, "gsd", len(found))
        values = []
        for distances, factor, pixel in zip(found, scales, gsds, strict=True):
            limit = self.threshold * (pixel or 0.0) if self.unit == "gsd" else self.threshold
            values.append(self.share(distances if factor is None else distances.scaled(factor), limit))
        self._add(values)

    @abstractmethod
    def share(self, found: Distances, threshold_m: float) -> float:
        """The share of one pair, from its distances, at a threshold in metres."""


def _label(threshold: float, unit: str) -> str:
    """``1m``, ``25cm`` or ``2gsd``: without a dot, which names of modules must not have."""
    if unit == "m" and threshold != round(threshold):
        threshold, unit = threshold * 100, "cm"
    return f"{threshold:g}".replace(".", "_") + unit


class Precision(_Share):
    """Share of the predicted points that lie near the reference (accuracy as a share)."""

    name = "precision"

    def share(self, found: Distances, threshold_m: float) -> float:
        return found.precision(threshold_m)


class Recall(_Share):
    """Share of the reference points that lie near the prediction (completeness as a share)."""

    name = "recall"

    def share(self, found: Distances, threshold_m: float) -> float:
        return found.recall(threshold_m)


class FScore(_Share):
    """Harmonic mean of precision and recall, 0 where both are 0."""

    name = "fscore"

    def share(self, found: Distances, threshold_m: float) -> float:
        return found.fscore(threshold_m)
