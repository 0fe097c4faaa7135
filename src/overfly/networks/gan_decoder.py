"""`model=gan_decoder`: the paper's network as a whole, residual encoder, generator and discriminator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from overfly.networks.discriminator import Discriminator
from overfly.networks.encoder import Encoded, Encoder
from overfly.networks.generator import Generator
from overfly.networks.ground import initial_cloud


class GanDecoder(nn.Module):
    """The faithful network: windows of K frames with cameras -> clouds of ``points`` points in window units.

    Args:
        size: width and height of the images, multiples of 32.
        points: points of a cloud, a square number.
        features: size of the dense feature vector (1024 in the paper).
        encoder, generator, discriminator: the other sizes of the three parts, by their constructors' names.
    """

    image_size: Tensor

    def __init__(
        self,
        *,
        size: Sequence[int],
        points: int,
        features: int,
        encoder: Mapping[str, Any],
        generator: Mapping[str, Any],
        discriminator: Mapping[str, Any],
    ) -> None:
        super().__init__()
        self.points = points
        self.register_buffer("image_size", torch.tensor([float(n) for n in size]), persistent=False)
        self.encoder = Encoder(size=size, features=features, **encoder)
        self.generator = Generator(points=points, features=features, **generator)
        self.discriminator = Discriminator(**discriminator)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def encode(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """What the encoder knows about the frames of a batch of windows.

        Args:
            batch: ``images`` [B, K, 3, H, W] in 0..1; ``prior_from_window`` [B, K, 4, 4] for the
                correction, if at hand.

        Returns:
            ``features`` [B, K, features], ``descriptor`` [B, K, D], ``match_map`` [B, K, C, H / 2, W / 2] and, with
            priors, ``correction`` [B, K - 1, 6] (:meth:`overfly.networks.encoder.Encoder.correction`).
        """
        windows = batch["images"].shape[:2]
        encoded: Encoded = self.encoder(batch["images"].flatten(0, 1))
        output = {
            "features": encoded.features.unflatten(0, windows),
            "descriptor": encoded.descriptor.unflatten(0, windows),
            "match_map": encoded.match_map.unflatten(0, windows),
        }
        if "prior_from_window" in batch:
            pooled = encoded.pooled.unflatten(0, windows)
            output["correction"] = self.encoder.correction(pooled, batch["prior_from_window"])
        return output

    def forward(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Predict the clouds of a batch of windows.

        Args:
            batch: as :meth:`encode`, with ``intrinsics`` [B, K, 3, 3] and ``camera_from_window`` [B, K, 4, 4].

        Returns:
            What :meth:`encode` returns and ``points`` [B, points, 3] in window units.
        """
        output = self.encode(batch)
        cameras = batch["camera_from_window"], batch["intrinsics"]
        return {
            **output,
            "points": self.generator(initial_cloud(self.points, batch), output["features"], *cameras, self.image_size),
        }
