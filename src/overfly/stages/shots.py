"""Photographs as a step of a refinement sees them: reduced, with their cameras, and cut into patches for the critic."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from overfly.rendering.render import Rendered, Views
from overfly.stages.stage import Batch

COVERED = 0.999
"""Share above which a pixel counts as whole: shown by the mesh alone, or valid in all its parts."""


class Shot(NamedTuple):
    """B photographs of a batch.

    Attributes:
        image: [B, 3, H, W] in 0..1.
        valid: [B, H, W] 1 where the photograph is known, else 0.
        views: their cameras.
        indices: [B] in the flight; of a neighbour, that of the photograph it was drawn for.
    """

    image: Tensor
    valid: Tensor
    views: Views
    indices: Tensor

    def covered(self, rendered: Rendered) -> Tensor:
        """[B, H, W] 1 where the photograph is known and the mesh alone is seen, else 0; without gradient."""
        return self.valid * (rendered.coverage.detach() > COVERED)


def shot_of(batch: Batch, *, shrink: int = 1, of: str = "") -> Shot:
    """The photographs of a batch.

    Args:
        batch: of :class:`overfly.data.photographs.PhotographPairs`.
        shrink: images are means over so many pixels each way.
        of: "" for the photographs themselves, "other_" for their neighbours.
    """
    image, valid, intrinsics = batch[f"{of}image"], batch[f"{of}valid"].float(), batch[f"{of}intrinsics"]
    if shrink > 1:
        image = avg_pool2d(image, shrink)
        valid = (avg_pool2d(valid[:, None], shrink)[:, 0] > COVERED).float()
        intrinsics = intrinsics / torch.tensor([shrink, shrink, 1.0], device=intrinsics.device)[:, None]
    views = Views(intrinsics, batch[f"{of}camera_from_local"], (image.shape[3], image.shape[2]))
    return Shot(image, valid, views, batch["index"])


def patches(
    fake: Tensor, real: Tensor, mask: Tensor, *, count: int, size: int, random: torch.Generator
) -> tuple[Tensor, Tensor]:
    """The same places of rendering and photograph, drawn at random: the best covered of twice as many.

    Args:
        fake, real: [B, 3, H, W].
        mask: [B, H, W]; where it is 0, the rendering's patch shows the photograph.
        count: patches of each image.
        size: pixels; smaller where the images are.
        random: draws the places.

    Returns:
        Patches of ``fake`` and of ``real`` [B count, 3, size, size].
    """
    height, width = real.shape[2:]
    size = min(size, height, width)
    rows = torch.randint(height - size + 1, (len(real), 2 * count), generator=random).tolist()
    columns = torch.randint(width - size + 1, (len(real), 2 * count), generator=random).tolist()
    virtual, true = [], []
    for b in range(len(real)):
        places = [(slice(r, r + size), slice(c, c + size)) for r, c in zip(rows[b], columns[b], strict=True)]
        places.sort(key=lambda place: -float(mask[b][place].mean()))
        for place in places[:count]:
            known = mask[b][place]
            true.append(real[b][:, *place])
            virtual.append(fake[b][:, *place] * known + real[b][:, *place] * (1 - known))
    return torch.stack(virtual), torch.stack(true)
