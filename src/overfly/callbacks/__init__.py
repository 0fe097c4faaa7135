"""What is written while training: metrics, curves, pictures and predictions."""

from overfly.callbacks.curves import Curves
from overfly.callbacks.loggers import MetricsCsv, finish_loggers
from overfly.callbacks.pictures import Pictures, Predictions
from overfly.callbacks.progress import EpochLines, Progress
from overfly.callbacks.refinement import RefinementResults

__all__ = [
    "Curves", "EpochLines", "MetricsCsv", "Pictures", "Predictions", "Progress", "RefinementResults", "finish_loggers",
]  # fmt: skip
