"""Evaluation: networks, classical methods and trivial answers on the same windows, in one table and one picture."""

from overfly.evaluation.answers import Baselines, Network
from overfly.evaluation.evaluate import evaluate

__all__ = ["Baselines", "Network", "evaluate"]
