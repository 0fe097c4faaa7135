"""Networks: plain modules without training code (see :mod:`overfly.stages`)."""

from overfly.networks.gan_decoder import GanDecoder
from overfly.networks.local_decoder import LocalDecoder
from overfly.networks.sweep_decoder import SweepDecoder

__all__ = ["GanDecoder", "LocalDecoder", "SweepDecoder"]
