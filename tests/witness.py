"""What each process of a training saw and had: for tests of several processes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import lightning as L


class Witness(L.Callback):
    """Writes ``<rank>.json``: for each step the windows of the batch and a sum over each part's weights."""

    def __init__(self, *, folder: str) -> None:
        self.folder = Path(folder)
        self.steps: list[dict[str, Any]] = []

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        sums = {
            name: sum(p.detach().double().abs().sum().item() for p in part.parameters())
            for name, part in pl_module.network.named_children()  # type: ignore[union-attr, operator]
        }
        stage = type(pl_module).__name__
        self.steps.append({"stage": stage, "windows": sorted(batch["index"].tolist()), "weights": sums})

    def on_fit_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        path = self.folder / f"{type(pl_module).__name__}_{trainer.global_rank}_of_{trainer.world_size}.json"
        path.write_text(json.dumps(self.steps))
