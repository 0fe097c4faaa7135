"""`model=sweep_decoder`: Overfly's own network in the paper's frame; it measures heights instead of recalling them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from overfly.networks.discriminator import Discriminator
from overfly.networks.encoder import Encoder
from overfly.networks.ground import Aligned, align, align_depth, pixel_centres, rays
from overfly.networks.sweep import lines, seen
from overfly.networks.sweep_generator import Level, Surface, SweepGenerator


class SweepDecoder(nn.Module):
    """Windows of 1 to K frames with cameras -> a dense surface over the reference frame's pixels, and its cloud.

    Args:
        size: width and height of the images of the coarsest octave, multiples of 32: what the encoder's fully connected
            heads take. Images may be larger by factors of two; every octave is one more fine sweep.
        points: points of a cloud, a square number.
        features: size of the dense feature vector.
        encoder, generator, discriminator: the other sizes of the three parts, by their constructors' names.
    """

    predicts_surfaces = True
    """Whether its answer holds ``height``, ``sigma``, ``confidence`` and ``views`` of every pixel."""

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
        self.size, self.points = (int(size[0]), int(size[1])), points
        self.encoder = Encoder(size=size, features=features, **encoder)
        self.generator = SweepGenerator(channels=encoder["match_channels"], **generator)
        self.discriminator = Discriminator(**discriminator)
        for part in (self.encoder, self.generator.coarse, self.generator.fine):
            part.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def encode(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """What the encoder knows about the frames: their own descriptors, and match maps as seen from the reference.

        Args:
            batch: ``images`` [B, K, 3, H, W] in 0..1, ``intrinsics`` [B, K, 3, 3], ``prior_from_window`` [B, K, 4, 4],
                by which the frames are aligned; with ``depth``, the aligned depth is returned too.

        Returns:
            ``features``, ``descriptor``, ``correction`` as ``GanDecoder.encode``; ``match_map`` and ``compared``
            [B, K, C, h, w] of the aligned frames; ``match_depth`` and ``match_intrinsics``, by which these are judged.
        """
        images, intrinsics = self._octaves(batch["images"], batch["intrinsics"])[0]
        windows = images.shape[:2]
        encoded = self.encoder(images.flatten(0, 1))
        pooled = encoded.pooled.unflatten(0, windows)
        aligned = align(images, intrinsics, batch["prior_from_window"])
        maps = self.encoder.dense(aligned.images.flatten(0, 1))
        return {
            "features": encoded.features.unflatten(0, windows),
            "descriptor": encoded.descriptor.unflatten(0, windows),
            "correction": self.encoder.correction(pooled, batch["prior_from_window"]),
            "compared": maps.compared.unflatten(0, windows),
            **self._judged(maps.match_map.unflatten(0, windows), aligned, batch),
        }

    def forward(self, batch: Mapping[str, Tensor]) -> dict[str, Any]:
        """Measure the surface of a batch of windows.

        Args:
            batch: ``images`` [B, K, 3, H, W], ``intrinsics``, ``camera_from_window``, ``height_range`` [B, 2].

        Returns:
            ``points`` [B, points, 3]; ``descriptor`` [B, 1, D] of the reference; ``surfaces``, one a sweep, the last
            the best; ``height``, ``sigma`` (about 70 % of the errors are below it), ``confidence`` (0..1) and ``views``
            (frames that have the point inside) [B, H, W] over the reference image's pixels, window units.
        """
        levels = [self._level(batch, *octave) for octave in self._octaves(batch["images"], batch["intrinsics"])]
        surfaces = self.generator(levels, batch["height_range"])
        last, finest = surfaces[-1], levels[-1]
        reference = self._octaves(batch["images"][:, :1], batch["intrinsics"][:, :1])[0][0][:, 0]
        descriptor = self.encoder(reference).descriptor if reference.shape[-2:] == self.size[::-1] else None
        return {
            "points": self._cloud(last, finest),
            "surfaces": surfaces,
            "height": last.height,
            "sigma": last.sigma,
            "confidence": last.confidence.sigmoid(),
            "views": self._views(last, finest),
            **({} if descriptor is None else {"descriptor": descriptor[:, None]}),
        }

    def _octaves(self, images: Tensor, intrinsics: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Images and intrinsics at every octave, the smallest first: about ``size`` wide."""
        octaves = [(images, intrinsics)]
        scale = torch.tensor([0.5, 0.5, 1.0], device=images.device)[:, None]
        while octaves[0][0].shape[-1] >= 2 * self.size[0] * 0.75 and octaves[0][0].shape[-1] % 64 == 0:
            smaller = F.avg_pool2d(octaves[0][0].flatten(0, 1), 2).unflatten(0, images.shape[:2])
            octaves.insert(0, (smaller, octaves[0][1] * scale))
        return octaves

    def _level(self, batch: Mapping[str, Tensor], images: Tensor, intrinsics: Tensor) -> Level:
        poses = batch["camera_from_window"]
        with torch.no_grad():
            aligned = align(images, intrinsics, poses)
        windows = images.shape[:2]
        maps = self.encoder.dense(aligned.images.flatten(0, 1), matching=False)
        compared = maps.compared.unflatten(0, windows)
        context = maps.context.unflatten(0, windows)[:, 0]
        return Level(aligned.size, compared, context, aligned.intrinsics, intrinsics, poses)

    def _judged(self, match: Tensor, aligned: Aligned, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        judged = {"match_map": match, "match_intrinsics": aligned.intrinsics}
        if "depth" in batch:
            factor = batch["depth"].shape[-1] // aligned.size[0]
            depth = batch["depth"][..., factor // 2 :: factor, factor // 2 :: factor]
            judged["match_depth"] = align_depth(depth, aligned.pixels)
        return judged

    def _cloud(self, surface: Surface, level: Level) -> Tensor:
        width, height = level.size
        side = round(self.points**0.5)
        cells = pixel_centres(width, height, side, side, surface.height.device)
        size = torch.tensor([width, height], dtype=cells.dtype, device=cells.device)
        grid = (cells / size * 2 - 1)[None, :, None].expand(len(surface.height), -1, -1, -1)
        found = F.grid_sample(surface.height[:, None], grid, padding_mode="border", align_corners=False)[:, 0, :, 0]
        return rays(cells, level.intrinsics[:, 0], level.camera_from_window[:, 0]).at(found)

    @torch.no_grad()
    def _views(self, surface: Surface, level: Level) -> Tensor:
        width, height = level.size
        cells = pixel_centres(width, height, width, height, surface.height.device)
        cast = rays(cells, level.intrinsics[:, 0], level.camera_from_window[:, 0])
        cast_lines = lines(cast, level.homographies, level.intrinsics, level.camera_from_window, level.size)
        count = seen(cast_lines, surface.height.flatten(1)[:, None]).sum(1)[:, 0]
        return 1 + count.reshape(surface.height.shape)
