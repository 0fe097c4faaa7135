"""Pictures of reference beside predicted cloud (the form of the paper's Figure 4), and predictions as files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from overfly.cloud import Cloud, write_cloud
from overfly.stages import GanStage

Batch = dict[str, torch.Tensor]


def plot_clouds(reference: NDArray, predicted: NDArray, image: NDArray, path: Path, title: str = "") -> None:
    """One picture: the reference frame, the reference and the predicted cloud by height, the prediction by error.

    Args:
        reference, predicted: [N, 3] metres in the window's frame.
        image: [H, W, 3] in 0..1.
        path: the PNG to write.
        title: what stands above.
    """
    from matplotlib.figure import Figure

    error = cKDTree(reference).query(predicted)[0]
    low, high = np.percentile(reference[:, 2], [2, 98])
    high = max(high, low + 1)
    figure = Figure(figsize=(15, 4), layout="constrained")
    if title:
        figure.suptitle(title, fontsize=10)
    first = figure.add_subplot(1, 4, 1)
    first.imshow(np.clip(image, 0, 1))
    first.set_axis_off()
    first.set_title("reference frame", fontsize=9)
    for place, (name, points, values, limits, colors) in enumerate(
        (
            ("reference cloud", reference, reference[:, 2], (low, high), "viridis"),
            ("predicted cloud", predicted, predicted[:, 2], (low, high), "viridis"),
            ("distance to the reference", predicted, error, (0, max(np.percentile(error, 95), 0.1)), "inferno"),
        ),
        start=2,
    ):
        axis: Any = figure.add_subplot(1, 4, place, projection="3d")
        drawn = axis.scatter(*points.T, c=values, s=4, cmap=colors, vmin=limits[0], vmax=limits[1], depthshade=False)
        axis.set_title(name, fontsize=9)
        axis.view_init(elev=40, azim=-70)
        width = float(np.abs(reference[:, :2]).max())
        axis.set(xlim=(-width, width), ylim=(-width, width), zlim=(low - 0.05 * width, low + 1.2 * width))
        axis.set_box_aspect((1, 1, 0.6))
        axis.tick_params(labelsize=6)
        figure.colorbar(drawn, ax=axis, shrink=0.6, label="height, m" if "cloud" in name else "m")
    figure.savefig(path, dpi=100)


class Pictures(L.Callback):
    """Pictures of a few validation windows every few epochs and after the last; also handed to the loggers.

    Stages whose network gives no points (the encoder) have none.
    """

    def __init__(self, *, folder: Path | str, windows: int, every_n_epochs: int) -> None:
        self.folder = Path(folder)
        self.windows = windows
        self.every_n_epochs = every_n_epochs
        self.batch: Batch | None = None

    def on_validation_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Batch, batch_idx: int, dataloader_idx: int = 0
    ) -> None:
        if batch_idx == 0:
            self.batch = {name: value[: self.windows].detach() for name, value in batch.items()}

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        due = (trainer.current_epoch + 1) % self.every_n_epochs == 0 or trainer.current_epoch + 1 == trainer.max_epochs
        if due and self.batch is not None and trainer.is_global_zero and not trainer.fast_dev_run:  # type: ignore[attr-defined]
            self._draw(trainer, pl_module, self.batch)

    def _draw(self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Batch) -> None:
        points = predicted_points(pl_module, batch)
        if points is None:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        for i, predicted in enumerate(points):
            scale = float(batch["scale"][i])
            path = self.folder / f"val_{i}.png"
            image = batch["images"][i, 0].permute(1, 2, 0).cpu().numpy()
            title = f"validation window {i}, epoch {trainer.current_epoch + 1}"
            plot_clouds(batch["reference"][i].cpu().numpy() * scale, predicted * scale, image, path, title)
            hand_over(trainer, f"val/cloud_{i}", path)


class Predictions(L.Callback):
    """The clouds of the first test windows as PLY, in metres, with the error's picture beside them."""

    def __init__(self, *, folder: Path | str, windows: int) -> None:
        self.folder = Path(folder)
        self.windows = windows

    def on_test_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: Batch,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        if batch_idx or not trainer.is_global_zero or trainer.fast_dev_run:  # type: ignore[attr-defined]
            return
        batch = {name: value[: self.windows] for name, value in batch.items()}
        points = predicted_points(pl_module, batch)
        if points is None:
            return
        split = ("test", "unseen")[dataloader_idx]
        self.folder.mkdir(parents=True, exist_ok=True)
        for i, predicted in enumerate(points):
            scale = float(batch["scale"][i])
            reference = batch["reference"][i].cpu().numpy() * scale
            write_cloud(Cloud(points=predicted.astype(np.float64) * scale), self.folder / f"{split}_{i}.ply")
            write_cloud(Cloud(points=reference.astype(np.float64)), self.folder / f"{split}_{i}_reference.ply")
            image = batch["images"][i, 0].permute(1, 2, 0).cpu().numpy()
            plot_clouds(reference, predicted * scale, image, self.folder / f"{split}_{i}.png", f"{split} window {i}")


def predicted_points(stage: L.LightningModule, batch: Batch) -> NDArray[np.float32] | None:
    """The stage's clouds for a batch [B, N, 3] in window units; None from a stage that predicts none."""
    if not isinstance(stage, GanStage):
        return None
    training = stage.training
    stage.eval()
    with torch.no_grad():
        points = stage(batch)["points"]
    stage.train(training)
    return np.asarray(points.float().cpu().numpy())


def hand_over(trainer: L.Trainer, name: str, path: Path) -> None:
    """Show a picture in those loggers that take pictures."""
    for logger in trainer.loggers:
        kind = type(logger).__name__
        if kind == "WandbLogger":
            logger.log_image(key=name, images=[str(path)])  # type: ignore[attr-defined]
        elif kind == "TensorBoardLogger":
            from PIL import Image

            pixels = np.asarray(Image.open(path).convert("RGB"))
            logger.experiment.add_image(name, pixels, trainer.current_epoch, dataformats="HWC")  # type: ignore[attr-defined]
