"""The CSV logger, and the end of every logger of a run."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities import rank_zero_only

from overfly.tables import Row, read_rows, write_rows


class MetricsCsv(Logger):
    """``metrics.csv`` in the run folder: one line an epoch, one column a metric.

    A resumed run goes on in the same file: lines of epochs that are trained again are replaced.
    """

    def __init__(self, *, folder: Path | str) -> None:
        super().__init__()
        self.path = Path(folder) / "metrics.csv"
        self.rows: dict[int, Row] = {int(row["epoch"]): row for row in read_rows(self.path)}

    @property
    def name(self) -> str:
        return "csv"

    @property
    def version(self) -> str:
        return ""

    @rank_zero_only
    def log_hyperparams(self, *args: Any, **kwargs: Any) -> None:
        """Nothing: the configuration stands beside this file."""

    @rank_zero_only
    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        kept = {key: float(value) for key, value in metrics.items() if "/" in key}
        if kept and "epoch" in metrics:
            epoch = int(metrics["epoch"])
            self.rows[epoch] = {**self.rows.get(epoch, {}), "epoch": epoch, **kept}
            self.save()

    @rank_zero_only
    def save(self) -> None:
        write_rows(self.path, [self.rows[epoch] for epoch in sorted(self.rows)])


def finish_loggers(loggers: Iterable[Logger]) -> None:
    """Close every logger inside the job that opened it: in a sweep, the next job must not write to it."""
    for logger in loggers:
        logger.finalize("success")
        if type(logger).__name__ == "WandbLogger":
            import wandb

            wandb.finish()
