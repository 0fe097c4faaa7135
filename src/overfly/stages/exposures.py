"""How much brighter or darker than the mesh each photograph is as a whole."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from overfly import image_losses
from overfly.stages.shots import Shot

SMOOTHING = 0.2
"""Share of a newly found gain that is taken over in a step."""


class Exposures(nn.Module):
    """Gains of the photographs, smoothed over the steps; their mean over all that are refined on stays 1.

    With a gain of its own for each step the colours would be free to drift: whatever is too dark would be lit.

    Args:
        held_out: [n] photographs that no gain is ever estimated of.
    """

    log_gains: Tensor

    def __init__(self, held_out: NDArray[np.bool_]) -> None:
        super().__init__()
        self.refined_on = int((~held_out).sum())
        self.register_buffer("log_gains", torch.zeros(len(held_out), 3))

    @torch.no_grad()
    def forward(self, image: Tensor, shot: Shot, mask: Tensor) -> Tensor:
        """Gains [B, 3] by which renderings [B, 3, H, W] are compared with their photographs, after one more look."""
        found = image_losses.gains(image, shot.image, mask).log()
        self.log_gains[shot.indices] += SMOOTHING * (found - self.log_gains[shot.indices])
        mean = self.log_gains.sum(0) / self.refined_on  # those of photographs that are held out are 0
        return (self.log_gains[shot.indices] - mean).exp()
