"""What reads the encoder's maps: dense features at two resolutions, and a place's descriptor pooled from local ones."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from overfly.networks.blocks import ConvolutionBlock


class Pyramid(nn.Module):
    """Sums block outputs at 1/2, 1/4 and 1/8 of the image, the coarser two through a convolution block.

    Args:
        widths: channels of the three maps.
        channels: of the two results.
    """

    def __init__(self, *, widths: Sequence[int], channels: int) -> None:
        super().__init__()
        self.lateral = nn.ModuleList(nn.Conv2d(width, channels, 1) for width in widths)
        self.context = ConvolutionBlock(inputs=channels, outputs=channels)

    def forward(self, maps: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Unit vectors [M, channels, H / 2, W / 2] and context [M, channels, H / 4, W / 4]."""
        fine, middle, coarse = (layer(level) for layer, level in zip(self.lateral, maps, strict=True))
        context = self.context(F.interpolate(coarse, scale_factor=2, mode="bilinear", align_corners=False) + middle)
        wide = F.interpolate(context, scale_factor=2, mode="bilinear", align_corners=False)
        return F.normalize(wide + fine, dim=1), context


class PlaceHead(nn.Module):
    """Local features -> one descriptor of the place, wherever in the image its parts lie.

    Residuals to soft clusters are summed over the image (Arandjelovic et al. 2016, NetVLAD), normalised per cluster and
    projected: two images that share a strip of ground share the sums over that strip.

    Args:
        inputs: channels of the local features.
        clusters: number of clusters.
        outputs: size of the descriptor.
    """

    def __init__(self, *, inputs: int, clusters: int, outputs: int) -> None:
        super().__init__()
        self.assignment = nn.Conv2d(inputs, clusters, 1)
        self.centres = nn.Parameter(0.1 * torch.randn(clusters, inputs))
        self.projection = nn.Linear(clusters * inputs, outputs)

    def forward(self, local: Tensor) -> Tensor:
        """Local features [M, inputs, h, w] -> unit vectors [M, outputs]."""
        local = F.normalize(local, dim=1)
        share = self.assignment(local * 8).softmax(1).flatten(2)  # [M, clusters, h w]
        sums = share @ local.flatten(2).transpose(1, 2) - share.sum(2, keepdim=True) * self.centres
        return F.normalize(self.projection(F.normalize(sums, dim=2).flatten(1)), dim=1)


class OwnHeads(nn.Module):
    """Matching and retrieval with maps of their own, on block outputs that their gradients do not reach.

    What tells places apart best is not what measures parallax best: where one map served both, correspondences cost
    heights a fifth of their accuracy, or heights cost correspondences a third of theirs.
    """

    def __init__(self, *, widths: Sequence[int], channels: int, descriptor: int, clusters: int = 16) -> None:
        super().__init__()
        self.pyramid = Pyramid(widths=widths, channels=channels)
        self.place = PlaceHead(inputs=channels, clusters=clusters, outputs=descriptor)

    def forward(self, maps: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Match map, unit vectors [M, channels, H / 2, W / 2], and descriptor, unit vectors [M, descriptor]."""
        match_map, context = self.pyramid([level.detach() for level in maps])
        return match_map, self.place(context)
