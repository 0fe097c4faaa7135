"""Training stages: one LightningModule per phase."""

from overfly.stages.encoder import EncoderStage
from overfly.stages.full import FullStage
from overfly.stages.gan import GanStage

__all__ = ["EncoderStage", "FullStage", "GanStage"]
