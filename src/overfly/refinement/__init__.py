"""SS-GAN-3D: a rough mesh is refined until renderings of it look like the photographs."""

from overfly.refinement.module import PhotographModule

__all__ = ["PhotographModule"]
