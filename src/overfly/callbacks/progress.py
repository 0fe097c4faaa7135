"""The progress bar: to stderr, and silent where nobody looks."""

from __future__ import annotations

import logging
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import RichProgressBar

log = logging.getLogger("overfly")


class Progress(RichProgressBar):
    """A rich progress bar on stderr, which leaves stdout to results and is off when stderr is no terminal."""

    def __init__(self) -> None:
        super().__init__(console_kwargs={"stderr": True}, leave=False)

    @property
    def is_enabled(self) -> bool:
        import sys

        return sys.stderr.isatty() and super().is_enabled

    def get_metrics(self, trainer: L.Trainer, pl_module: L.LightningModule) -> dict[str, Any]:
        metrics = super().get_metrics(trainer, pl_module)
        metrics.pop("v_num", None)
        return metrics


class EpochLines(L.Callback):
    """One log line an epoch: ``train.log``, and a run without a terminal, show how training goes."""

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        shown = ("train/loss", "val/loss", "val/accuracy", "val/chamfer_m2")
        metrics = trainer.callback_metrics
        values = ", ".join(f"{key} {float(metrics[key]):.4g}" for key in shown if key in metrics)
        log.info("epoch %d of %s: %s", trainer.current_epoch + 1, trainer.max_epochs, values)
