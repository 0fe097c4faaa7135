"""The differentiable mesh renderer: images whose gradients reach vertices, colours and camera poses."""

from overfly.rendering.render import Rendered, Views, render
from overfly.rendering.topology import Topology, topology

__all__ = ["Rendered", "Topology", "Views", "render", "topology"]
