"""Loss, accuracy, Chamfer and EMD over the epochs, in the form of the paper's Figure 3."""

from __future__ import annotations

from pathlib import Path

import lightning as L

from overfly.callbacks.loggers import MetricsCsv
from overfly.tables import Row, read_rows

PANELS = {
    "loss": ("loss", "loss"),
    "accuracy": ("accuracy", "accuracy"),
    "chamfer_m2": ("Chamfer distance, m² (mean squared)", "chamfer_m2"),
    "emd": ("EMD, sum over 1024", "emd_sum_1024"),
}
COLORS = {"train": "#4878a8", "val": "#d1603d"}


def plot_curves(stages: dict[str, list[Row]], path: Path) -> None:
    """Draw one line of panels a stage.

    Args:
        stages: for each stage its rows, as in metrics.csv (``epoch``, ``train/loss``, ``val/loss``, ...).
        path: the PNG to write.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(4 * len(PANELS), 2.9 * len(stages)), layout="constrained")
    axes = figure.subplots(len(stages), len(PANELS), squeeze=False)
    for line, (stage, rows) in enumerate(stages.items()):
        for axis, (title, key) in zip(axes[line], PANELS.values(), strict=True):
            drawn = False
            for split, color in COLORS.items():
                points = [(row["epoch"] + 1, row[f"{split}/{key}"]) for row in rows if f"{split}/{key}" in row]
                if points:
                    drawn = True
                    label = {"train": "training", "val": "validation"}[split]
                    axis.plot(*zip(*points), color=color, marker="o", markersize=2.5, label=label)
            if not drawn:
                axis.set_axis_off()
                continue
            axis.set(title=f"{stage}: {title}", xlabel="epoch")
            axis.title.set_fontsize(9)
            axis.xaxis.set_major_locator(MaxNLocator(integer=True))
            axis.grid(alpha=0.3)
            if key == "accuracy":
                axis.set_ylim(0, 1)
            axis.legend(fontsize=8, frameon=False)
    figure.savefig(path, dpi=110)


class Curves(L.Callback):
    """Writes ``curves.png`` after every fifth epoch and at the end of training."""

    def __init__(self, *, folder: Path | str) -> None:
        self.folder = Path(folder)

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if trainer.current_epoch % 5 == 4:
            self._draw(trainer, pl_module)

    def on_fit_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._draw(trainer, pl_module)

    def _draw(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if trainer.fast_dev_run or not trainer.is_global_zero:  # type: ignore[attr-defined]
            return
        rows = next((list(x.rows.values()) for x in trainer.loggers if isinstance(x, MetricsCsv)), [])
        rows = rows or read_rows(self.folder / "metrics.csv")
        if rows:
            plot_curves({type(pl_module).__name__.removesuffix("Stage").lower(): rows}, self.folder / "curves.png")
