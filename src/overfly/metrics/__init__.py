"""How good a cloud is: pure functions (``functional``), and one torchmetrics class per metric.

``functional`` needs no torch; the classes are imported when they are first asked for, so that the command line and
:func:`overfly.metrics.evaluate.evaluate` start quickly.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchmetrics import MetricCollection

    from overfly.metrics.base import CloudMetric
    from overfly.metrics.chamfer import ChamferM, ChamferM2, ChamferSum1024
    from overfly.metrics.emd import EmdM, EmdSum1024
    from overfly.metrics.lengths import Accuracy, Completeness, HausdorffM
    from overfly.metrics.shares import FScore, Precision, Recall

_HOMES = {
    "base": ("CloudMetric",),
    "chamfer": ("ChamferM", "ChamferM2", "ChamferSum1024"),
    "emd": ("EmdM", "EmdSum1024"),
    "lengths": ("Accuracy", "Completeness", "HausdorffM"),
    "shares": ("FScore", "Precision", "Recall"),
}

__all__ = [
    "Accuracy",
    "ChamferM",
    "ChamferM2",
    "ChamferSum1024",
    "CloudMetric",
    "Completeness",
    "EmdM",
    "EmdSum1024",
    "FScore",
    "HausdorffM",
    "Precision",
    "Recall",
    "collection",
]


def collection(*metrics: CloudMetric) -> MetricCollection:
    """A ``MetricCollection`` under the metrics' own keys; ``.clone(prefix="val/")`` makes one per split."""
    from torchmetrics import MetricCollection

    return MetricCollection({metric.key: metric for metric in metrics})


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(f"overfly.metrics.{home}"), name)
    raise AttributeError(f"module 'overfly.metrics' has no attribute {name!r}")
