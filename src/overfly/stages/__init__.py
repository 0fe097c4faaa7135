"""Training stages: one LightningModule per phase."""

from overfly.stages.encoder import EncoderStage
from overfly.stages.full import FullStage
from overfly.stages.gan import GanStage
from overfly.stages.ssgan3d import SsGan3dStage

__all__ = ["EncoderStage", "FullStage", "GanStage", "SsGan3dStage"]
