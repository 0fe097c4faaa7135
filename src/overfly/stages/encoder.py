"""Phase one: the encoder learns correspondences, retrieval and geometric correction."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from overfly.errors import InputError
from overfly.stages.retrieval import RetrievalTop1
from overfly.stages.stage import TEST_SPLITS, Batch, Stage
from overfly.stages.supervision import correction_errors, encoder_terms, matching_counts, repeated

TRAIN_ACCURACY_EVERY = 4
"""Training batches to one on which the accuracy is measured: matching costs a sixth of a step."""


class EncoderStage(Stage):
    """Trains ``network.encoder`` on InfoNCE at true correspondences, the retrieval loss and the correction loss.

    *Accuracy* is the share of key points whose nearest neighbour in the overlapping frame lies within 2 px of the
    truth; ``retrieval_top1`` is the share of frames whose nearest other frame, among all of the split, sees
    common ground.

    Args:
        pixels: correspondences drawn per pair of frames and step.
        keypoints: key points per frame on which the accuracy is measured.
        others: see :class:`overfly.stages.stage.Stage`.
    """

    terms = ("correspondence", "matching", "retrieval", "correction")

    def __init__(self, *, pixels: int, keypoints: int, **others: Any) -> None:
        super().__init__(**others)
        self.pixels, self.keypoints = pixels, keypoints
        self.top1 = nn.ModuleDict({split: RetrievalTop1() for split in ("val", *TEST_SPLITS)})

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return self.optimizer_factory(self.part("encoder").parameters())

    def training_step(self, batch: Batch, batch_idx: int) -> None:
        loss, output = self._loss(batch, self.random(batch_idx), "train")
        self.optimise(self.optimizers(), loss, batch_idx, ["encoder"])
        if batch_idx % TRAIN_ACCURACY_EVERY == 0:
            self._accuracy(output, batch, "train")

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        self._evaluate(batch, batch_idx, "val")

    def test_step(self, batch: Batch, batch_idx: int, dataloader_idx: int = 0) -> None:
        self._evaluate(batch, batch_idx, self.test_split(dataloader_idx))

    def on_validation_epoch_end(self) -> None:
        self._retrieval("val")

    def on_test_epoch_end(self) -> None:
        for split in TEST_SPLITS:
            self._retrieval(split)

    def _loss(self, batch: Batch, random: torch.Generator, split: str) -> tuple[Tensor, dict[str, Tensor]]:
        windows, frames = batch["images"].shape[:2]
        if frames < 2:
            raise InputError("The encoder learns from pairs of images, so a window needs two or more: set frames=3.")
        output = self.network.encode(batch)  # type: ignore[operator]
        terms = encoder_terms(output, batch, self.weights, pixels=self.pixels, random=random)
        loss = self.total(terms)
        self.report(split, {"loss": loss.detach(), **{f"loss_{k}": v.detach() for k, v in terms.items()}}, windows)
        return loss, output

    @torch.no_grad()
    def _accuracy(self, output: dict[str, Tensor], batch: Batch, split: str) -> None:
        right, visible = matching_counts(output, batch, self.keypoints)
        self.report(split, {"accuracy": right / max(visible, 1)}, visible)

    def _evaluate(self, batch: Batch, batch_idx: int, split: str) -> None:
        _, output = self._loss(batch, self.random(batch_idx, epoch=0), split)
        self._accuracy(output, batch, split)
        self.report(split, correction_errors(output, batch), len(batch["images"]))
        top1 = self.top1[split]
        assert isinstance(top1, RetrievalTop1)
        overlaps = batch["overlaps"].masked_fill(repeated(batch), -1.0)
        top1.update(output["descriptor"], overlaps, batch["scene"])

    def _retrieval(self, split: str) -> None:
        top1 = self.top1[split]
        assert isinstance(top1, RetrievalTop1)
        if not top1.update_called:
            return
        value = top1.compute()
        top1.reset()
        if torch.isfinite(value):
            self.report(split, {"retrieval_top1": value}, 1)
