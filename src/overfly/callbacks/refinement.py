"""What a refinement leaves behind: the mesh before and after, both measured, and pictures of held-out photographs."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any, cast

import lightning as L
import numpy as np
import torch
from numpy.typing import NDArray

from overfly.callbacks.pictures import hand_over
from overfly.mesh import Mesh, write_mesh
from overfly.stages.refined_mesh import prepared
from overfly.stages.ssgan3d import SsGan3dStage

log = logging.getLogger("overfly")


class RefinementResults(L.Callback):
    """Writes ``start.ply`` and ``refined.ply`` in the frame of the cameras, and ``pictures/``; logs ``start/...``.

    Args:
        folder: of the run.
        photographs: held-out photographs of which pictures are made (any, if none is held out).
        every_n_epochs: epochs between pictures.
    """

    def __init__(self, *, folder: Path | str, photographs: int, every_n_epochs: int) -> None:
        self.folder = Path(folder)
        self.photographs, self.every_n_epochs = photographs, every_n_epochs
        self.start: dict[str, float] = {}
        self.before: list[NDArray[np.float32]] = []

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Measure and show the mesh that is started from, before anything moves."""
        stage, data = cast(SsGan3dStage, pl_module), cast(Any, trainer).datamodule
        start = prepared(data.mesh, stage.device)
        rows, self.before = [], []
        for batch in self._batches(trainer, stage):
            rows.append(stage.measure(batch, start))
            if len(self.before) < self.photographs:
                self.before.append(_image(stage.observe(batch, start)))
        self.start = {f"start/{name}": float(np.mean([float(row[name]) for row in rows])) for name in rows[0]}
        if data.shape is not None:
            found = data.shape(data.mesh.vertices, data.mesh.faces)
            self.start |= {f"start/{name}": value for name, value in found.items()}
        log.info("start: %s", _line(self.start, "start"))
        if not trainer.fast_dev_run and trainer.is_global_zero:  # type: ignore[attr-defined]
            write_mesh(_placed(data.mesh, data), self.folder / "start.ply")

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        pl_module.log_dict(self.start, on_step=False, on_epoch=True, batch_size=1)

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if not trainer.sanity_checking and (trainer.current_epoch + 1) % self.every_n_epochs == 0:
            self._draw(trainer, pl_module, trainer.current_epoch + 1)

    def on_fit_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Write the mesh; also where a run that is resumed had been killed between its last epoch and this."""
        stage = cast(SsGan3dStage, pl_module)
        if trainer.fast_dev_run or not trainer.is_global_zero or trainer.interrupted:  # type: ignore[attr-defined]
            return
        if not self.start:
            if (self.folder / "refined.ply").is_file():
                return
            self.on_train_start(trainer, pl_module)
        data = cast(Any, trainer).datamodule
        with torch.no_grad():
            vertices, colors = stage.mesh()
        mesh = Mesh(
            vertices.double().cpu().numpy(), stage.mesh.faces.cpu().numpy(), (colors * 255).round().byte().cpu().numpy()
        )
        write_mesh(_placed(mesh, data), self.folder / "refined.ply")
        self._draw(trainer, pl_module, trainer.current_epoch)  # counted up already
        values = {name: float(value) for name, value in trainer.callback_metrics.items()}
        log.info("refined: %s", _line(values, "val"))
        log.info("Stopped by %s; the mesh is %s", stage.stopped_by, self.folder / "refined.ply")

    def _batches(self, trainer: L.Trainer, stage: SsGan3dStage) -> Iterator[dict[str, torch.Tensor]]:
        for batch in cast(Any, trainer).datamodule.val_dataloader():
            yield {name: value.to(stage.device) for name, value in batch.items()}

    def _draw(self, trainer: L.Trainer, pl_module: L.LightningModule, epochs: int) -> None:
        stage, shots = cast(SsGan3dStage, pl_module), cast(Any, trainer).datamodule.photographs
        if trainer.fast_dev_run or not trainer.is_global_zero:  # type: ignore[attr-defined]
            return
        folder = self.folder / "pictures"
        folder.mkdir(parents=True, exist_ok=True)
        batches = islice(self._batches(trainer, stage), len(self.before))
        for i, (batch, before) in enumerate(zip(batches, self.before, strict=True)):
            index = int(batch["index"][0])
            kind = "not refined on" if shots.held_out[index] else "refined on"
            path = folder / f"photograph_{i}.png"
            plot_photograph(
                _image(batch["image"]), before, _image(stage.observe(batch)), path,
                f"{shots.names[index]}, {kind}; epoch {epochs}",
            )  # fmt: skip
            hand_over(trainer, f"val/photograph_{i}", path)


def plot_photograph(photograph: NDArray, start: NDArray, refined: NDArray, path: Path, title: str = "") -> None:
    """One picture: the photograph, both renderings, and the absolute error of both.

    Args:
        photograph, start, refined: [H, W, 3] in 0..1.
        path: the PNG to write.
        title: what stands above.
    """
    from matplotlib.figure import Figure

    height, width = photograph.shape[:2]
    figure = Figure(figsize=(15, 10 * height / width + 0.8), layout="constrained")
    figure.suptitle(title, fontsize=11)
    axes = figure.subplots(2, 3)
    for axis, (name, image) in zip(
        axes[0], (("photograph", photograph), ("start", start), ("refined", refined)), strict=True
    ):
        axis.imshow(np.clip(image, 0, 1))
        axis.set_title(name, fontsize=10)
    axes[1, 0].set_axis_off()
    errors = [np.abs(image - photograph).mean(2) for image in (start, refined)]
    limit = max(float(np.percentile(errors[0], 98)), 0.05)
    for axis, name, error in zip(axes[1, 1:], ("start", "refined"), errors, strict=True):
        drawn = axis.imshow(error, cmap="inferno", vmin=0, vmax=limit)
        axis.set_title(f"error of the {name} mesh's image, mean {error.mean():.3f}", fontsize=10)
    for axis in axes.ravel():
        axis.set_xticks([])
        axis.set_yticks([])
    figure.colorbar(drawn, ax=axes[1, 2], shrink=0.8, label="absolute difference, 0 to 1")
    figure.savefig(path, dpi=90)


def _image(images: torch.Tensor) -> NDArray[np.float32]:
    return np.asarray(images[0].permute(1, 2, 0).cpu().numpy())


def _placed(mesh: Mesh, data: Any) -> Mesh:
    """From the local frame into that of the cameras."""
    return Mesh(mesh.vertices + data.photographs.origin, mesh.faces, mesh.colors)


def _line(values: dict[str, float], split: str) -> str:
    shown = {
        "psnr_db": "PSNR {:.2f} dB", "ssim": "SSIM {:.3f}", "nc": "NC {:.4f}",
        "chamfer_m": "Chamfer {:.3f} m", "fscore_0.5m": "F-score at 0.5 m {:.3f}",
    }  # fmt: skip
    known = {name: values[f"{split}/{name}"] for name in shown if f"{split}/{name}" in values}
    return ", ".join(shown[name].format(value) for name, value in known.items())
