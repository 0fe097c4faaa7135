"""The residual encoder: dense features, global descriptor, dense feature vector and geometric correction."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from overfly.errors import InputError
from overfly.networks.blocks import ConvolutionBlock, Part, ResidualBlock
from overfly.networks.heads import OwnHeads, Pyramid
from overfly.networks.poses import relative

STRIDE = 16
"""Pixels of the image to one cell of the last block's feature map."""

MATCH_STRIDE = 2
"""Pixels of the image to one cell of the match map."""

CONTEXT_STRIDE = 4
"""Pixels of the image to one cell of the context map."""

CORRECTION_SIZE = 0.02
"""Usual size of a correction, in radians and window units: 1 degree, or 1 m at 60 m per unit."""


class DenseMaps(NamedTuple):
    """What the encoder knows about the places in M images.

    Attributes:
        compared: [M, C, H / 2, W / 2], unit vectors, which a sweep compares; cell (row, column) is centred on pixel
            (2 column + 1, 2 row + 1).
        context: [M, C, H / 4, W / 4]: what a place is, with its surroundings.
        match_map: as ``compared``, for key points and correspondences; the same map without heads of their own.
    """

    compared: Tensor
    context: Tensor
    match_map: Tensor


class Encoded(NamedTuple):
    """What the encoder knows about M images.

    Attributes:
        match_map: [M, C, H / 2, W / 2], unit vectors; cell (row, column) is centred on pixel (2 column + 1, 2 row + 1).
        pooled: [M, P], the max-pooled last feature map.
        features: [M, features], the paper's dense feature vector (DFV).
        descriptor: [M, D], unit vectors: images of the same place have similar ones.
    """

    match_map: Tensor
    pooled: Tensor
    features: Tensor
    descriptor: Tensor


class Encoder(Part):
    """Four residual blocks (section 3.1) with the heads that the paper names.

    Decisions where the paper is silent:

    - A 5 x 5 convolution of stride 2 comes first and a strided convolution block before each of the other three
      residual blocks (maps at 1/2, 1/4, 1/8, 1/16): residual blocks at full resolution cost twenty times as much.
    - *Key points and correspondences* come from a dense match map at half resolution, the sum of the block outputs
      at 1/2, 1/4 and 1/8, the coarser two through a convolution block, normalised
      (see :mod:`overfly.networks.matching`).
    - *Max-pooling and fully connected*: the last map is max-pooled 2 x 2 and, positions kept, goes through one fully
      connected layer to the DFV.
    - *Image retrieval layer*: a fully connected layer from the DFV to a normalised global descriptor.
    - With ``own_heads`` matching and retrieval read the blocks' outputs through layers of their own instead
      (:class:`overfly.networks.heads.OwnHeads`).
    - *Geometric correction*: the pooled maps of a frame and of its window's reference frame and the prior relative pose
      go through two fully connected layers to a motion that corrects the prior (rotation vector, translation).

    Args:
        size: width and height of the images, multiples of 32.
        widths: channels of the four residual blocks.
        features: size of the DFV.
        descriptor: size of the global descriptor.
        match_channels: size of the match map's descriptors.
        correction_width: width of the correction's hidden layer.
        own_heads: whether matching and retrieval have maps of their own.

    Raises:
        InputError: the image size is not a multiple of 32, or there are not four widths.
    """

    def __init__(
        self,
        *,
        size: Sequence[int],
        widths: Sequence[int],
        features: int,
        descriptor: int,
        match_channels: int,
        correction_width: int,
        own_heads: bool = False,
    ) -> None:
        super().__init__()
        width, height = size
        if width % 32 or height % 32 or min(width, height) < 32:
            raise InputError(
                f"The network takes images whose width and height are multiples of 32, not {width} x {height}: "
                f"set image_size=[{max(32, round(width / 32) * 32)},{max(32, round(height / 32) * 32)}]."
            )
        if len(widths) != 4:
            raise InputError(f"The encoder has four residual blocks, so widths takes four numbers, not {list(widths)}.")
        self.size = (width, height)
        self.stem = ConvolutionBlock(inputs=3, outputs=widths[0], kernel=5, stride=2)
        self.blocks = nn.ModuleList(ResidualBlock(width=w) for w in widths)
        self.downsampling = nn.ModuleList(ConvolutionBlock(inputs=a, outputs=b, stride=2) for a, b in pairwise(widths))
        self.pyramid = Pyramid(widths=widths[:3], channels=match_channels)
        pooled = widths[3] * (width // 32) * (height // 32)
        self.feature_head = nn.Sequential(nn.Linear(pooled, features), nn.PReLU())
        self.own_heads = (
            OwnHeads(widths=widths[:3], channels=match_channels, descriptor=descriptor) if own_heads else None
        )
        self.retrieval_head = None if own_heads else nn.Linear(features, descriptor)
        last = nn.Linear(correction_width, 6)
        self.correction_head = nn.Sequential(nn.Linear(2 * pooled + 12, correction_width), nn.PReLU(), last)
        with torch.no_grad():  # no correction is the best first guess
            last.weight.mul_(0.1)
            last.bias.zero_()

    def _load_from_state_dict(self, state: dict[str, Any], prefix: str, *rest: Any) -> None:
        """Also from the names of runs that were made before the pyramid was a part of its own."""
        for name in [name for name in state if name.startswith((f"{prefix}lateral.", f"{prefix}context."))]:
            state[f"{prefix}pyramid.{name.removeprefix(prefix)}"] = state.pop(name)
        super()._load_from_state_dict(state, prefix, *rest)

    def forward(self, images: Tensor) -> Encoded:
        """Encode M images [M, 3, H, W] in 0..1."""
        width, height = self.size
        if images.shape[-2:] != (height, width):
            raise InputError(
                f"This network was built for images of {width} x {height} pixels, not {images.shape[-1]} x "
                f"{images.shape[-2]}: resize the images, or set image_size."
            )
        maps = self._maps(images, 4)
        pooled = F.max_pool2d(maps[3], 2).flatten(1)
        features = self.feature_head(pooled)
        if self.own_heads is not None:
            match_map, descriptor = self.own_heads(maps[:3])
        else:
            assert self.retrieval_head is not None
            match_map, descriptor = self.pyramid(maps[:3])[0], F.normalize(self.retrieval_head(features), dim=1)
        return Encoded(match_map, pooled, features, descriptor)

    def dense(self, images: Tensor, *, matching: bool = True) -> DenseMaps:
        """The dense maps alone, of M images [M, 3, H, W] in 0..1 of any size whose sides are multiples of 8.

        Without ``matching`` the match map is not computed; ``compared`` stands in its place.
        """
        maps = self._maps(images, 3)
        compared, context = self.pyramid(maps)
        match_map = self.own_heads(maps)[0] if matching and self.own_heads is not None else compared
        return DenseMaps(compared, context, match_map)

    def _maps(self, images: Tensor, blocks: int) -> list[Tensor]:
        """The outputs of the first residual blocks."""
        x = self.stem((images.contiguous(memory_format=torch.channels_last) - 0.5) * 4)  # about unit variance
        maps: list[Tensor] = []
        for i in range(blocks):
            x = self.blocks[i](self.downsampling[i - 1](x) if i else x)
            maps.append(x)
        return maps

    def correction(self, pooled: Tensor, prior_from_window: Tensor) -> Tensor:
        """The geometric correction of each frame's prior pose relative to the reference frame.

        Args:
            pooled: [B, K, P] of the frames.
            prior_from_window: [B, K, 4, 4].

        Returns:
            Motions [B, K - 1, 6] of frames 1 to K - 1 (rotation vector in radians, translation in window units).
        """
        prior = relative(prior_from_window)[:, 1:, :3].flatten(2)  # [B, K - 1, 12]
        reference = pooled[:, :1].expand_as(pooled[:, 1:])
        motions: Tensor = self.correction_head(torch.cat([pooled[:, 1:], reference, prior], -1))
        return motions * CORRECTION_SIZE
