"""Networks: plain modules without training code (see :mod:`overfly.stages`)."""

from overfly.networks.critic import Critic
from overfly.networks.gan_decoder import GanDecoder
from overfly.networks.local_decoder import LocalDecoder
from overfly.networks.mesh_generator import FreeVertices, MeshGenerator
from overfly.networks.sweep_decoder import SweepDecoder

__all__ = ["Critic", "FreeVertices", "GanDecoder", "LocalDecoder", "MeshGenerator", "SweepDecoder"]
