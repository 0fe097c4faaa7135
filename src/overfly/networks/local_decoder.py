"""`model=local_decoder`: each point of the initial cloud looks at its own place in every frame, at one height only.

It stands between the faithful network, which sees the window as one vector, and the sweep decoder, which looks at
every place at many heights: what it gains over the first is locality, what it lacks to the second is the search.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

from overfly.networks.blocks import Part, grid_side
from overfly.networks.discriminator import Discriminator
from overfly.networks.encoder import Encoder
from overfly.networks.ground import initial_cloud
from overfly.networks.matching import sample


class LocalGenerator(Part):
    """Moves every point by what the frames show at its place on the ground plane.

    Args:
        points: number of points, a square number.
        channels: of the encoder's match maps.
        width: of the shared fully connected layers.
        layers: their number.
    """

    def __init__(self, *, points: int, channels: int, width: int, layers: int) -> None:
        super().__init__()
        grid_side(points)
        sizes = [2 * channels + 4, *[width] * layers]
        self.layers = nn.Sequential(*[part for a, b in pairwise(sizes) for part in (nn.Linear(a, b), nn.PReLU())])
        self.last = nn.Linear(width, 3)
        with torch.no_grad():  # the first cloud is nearly the initial one
            self.last.weight.mul_(0.1)
            self.last.bias.zero_()

    def forward(self, initial: Tensor, match_map: Tensor, camera_from_window: Tensor, intrinsics: Tensor) -> Tensor:
        """One cloud per window.

        Args:
            initial: the initial cloud [B, N, 3], window units.
            match_map: of the frames [B, K, C, h, w].
            camera_from_window: [B, K, 4, 4].
            intrinsics: [B, K, 3, 3], pixels.

        Returns:
            Points [B, N, 3], window units; point i belongs to point i of the initial cloud.
        """
        mean, spread, share = shown(initial, match_map, camera_from_window, intrinsics)
        moves: Tensor = self.last(self.layers(torch.cat([mean, spread, share, initial], -1)))
        return initial + moves


def shown(
    points: Tensor, match_map: Tensor, camera_from_window: Tensor, intrinsics: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """What the frames that have a point inside their image show there.

    Args:
        points: [B, N, 3], window units.
        match_map: of the frames [B, K, C, h, w].
        camera_from_window: [B, K, 4, 4].
        intrinsics: [B, K, 3, 3], pixels.

    Returns:
        Mean and standard deviation of the features over these frames [B, N, C] (0 where there is none), and the share
        of all frames that they are [B, N, 1].
    """
    local = torch.einsum("bkij,bnj->bkni", camera_from_window[..., :3, :3], points)
    local = local + camera_from_window[:, :, None, :3, 3]
    at = local @ intrinsics.transpose(-1, -2)
    ahead = at[..., 2] > 1e-4
    pixels = at[..., :2] / at[..., 2:].clamp(min=1e-4)
    size = 2 * intrinsics.new_tensor([match_map.shape[-1], match_map.shape[-2]])  # the map has half the image's size
    inside = (ahead & ((pixels > 0) & (pixels < size)).all(-1))[..., None].to(match_map)  # [B, K, N, 1]
    found = sample(match_map.flatten(0, 1), pixels.flatten(0, 1)).unflatten(0, match_map.shape[:2])
    count = inside.sum(1).clamp(min=1)
    mean = (found * inside).sum(1) / count
    variance = ((found - mean[:, None]).square() * inside).sum(1) / count
    return mean, (variance + 1e-6).sqrt() * (inside.sum(1) > 0), inside.mean(1)


class LocalDecoder(nn.Module):
    """Windows of K frames with cameras -> clouds of ``points`` points in window units.

    Args:
        size: width and height of the images, multiples of 32.
        points: points of a cloud, a square number.
        features: size of the dense feature vector (retrieval and correction).
        encoder, generator, discriminator: the other sizes of the three parts, by their constructors' names.
    """

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
        self.encoder = Encoder(size=size, features=features, **encoder)
        self.generator = LocalGenerator(points=points, channels=encoder["match_channels"], **generator)
        self.discriminator = Discriminator(**discriminator)
        self.encoder.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def encode(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """What the encoder knows about the frames: as :meth:`overfly.networks.gan_decoder.GanDecoder.encode`."""
        windows = batch["images"].shape[:2]
        encoded = self.encoder(batch["images"].flatten(0, 1))
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
        points = self.generator(initial_cloud(self.points, batch), output["match_map"], *cameras)
        return {**output, "points": points}
