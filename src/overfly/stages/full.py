"""Phase three: encoder, generator and discriminator together."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor

from overfly.stages.gan import GanStage
from overfly.stages.stage import Batch
from overfly.stages.supervision import encoder_terms


class FullStage(GanStage):
    """Joint training: the generator's optimiser moves the encoder too, which keeps its own loss terms.

    *Accuracy* is the mean of two shares: of predicted points within 2 % of the footprint's width of the reference
    (``precision_2pct``), and the reverse (``recall_2pct``).

    Args:
        pixels: correspondences drawn per pair of frames and step.
        others: see :class:`overfly.stages.gan.GanStage`.
    """

    terms: ClassVar[tuple[str, ...]] = (*GanStage.terms, "correspondence", "matching", "retrieval", "correction")
    accuracy: ClassVar[str] = "near_2pct"
    loss: ClassVar[str] = "loss_generator"

    def __init__(self, *, pixels: int, **others: Any) -> None:
        super().__init__(freeze_encoder=False, **others)
        self.pixels = pixels

    def more_terms(self, output: dict[str, Any], batch: Batch, random: torch.Generator) -> dict[str, Tensor]:
        terms = super().more_terms(output, batch, random)
        encoded = output if "match_map" in output else self.network.encode(batch)  # type: ignore[operator]
        return {**terms, **encoder_terms(encoded, batch, self.weights, pixels=self.pixels, random=random)}
