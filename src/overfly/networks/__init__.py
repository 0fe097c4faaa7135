"""Networks: plain modules without training code (see :mod:`overfly.stages`)."""

from overfly.networks.gan_decoder import GanDecoder

__all__ = ["GanDecoder"]
