"""The sweep generator: moves the uniform initial cloud along the reference's rays to the height where frames agree.

One coarse sweep over the whole range of heights, then the same fine sweep again and again, each time at twice the
image size, so that one set of weights serves every resolution.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from overfly.networks.blocks import ConvolutionBlock, Part, ResidualBlock
from overfly.networks.encoder import CONTEXT_STRIDE, MATCH_STRIDE
from overfly.networks.ground import pixel_centres, rays
from overfly.networks.sweep import agreement, canvas_to_reference, lines, pixels_per_height

SPREAD = 1.3
"""Sigma is this multiple of the expected error: of Laplace's distribution 73 % lie below it and 93 % below twice it. No
multiple gives both 68 % and 95 %, since errors have longer tails than Gauss's."""


class Level(NamedTuple):
    """One octave of a batch of windows.

    Attributes:
        size: width and height of the images.
        match: unit features of the aligned frames [B, K, C, h, w] at 1 / MATCH_STRIDE.
        context: features of the aligned reference frame [B, C, h, w] at 1 / CONTEXT_STRIDE.
        homographies: [B, K, 3, 3] of the aligned frames (``overfly.networks.ground.Aligned.intrinsics``).
        intrinsics: [B, K, 3, 3] of the images.
        camera_from_window: [B, K, 4, 4].
    """

    size: tuple[int, int]
    match: Tensor
    context: Tensor
    homographies: Tensor
    intrinsics: Tensor
    camera_from_window: Tensor


class Surface(NamedTuple):
    """Heights over the pixels of a level's reference image.

    Attributes:
        height: [B, H, W], window units.
        log_sigma: [B, H, W], logarithm of the expected absolute error in units of ``step``.
        confidence: [B, H, W], logit of the probability that the point is right.
        step: [B], the spacing of the hypotheses, window units.
        logits: [B, D, h, w] of the hypotheses, on the sweep's own grid.
        hypotheses: [B, D, h, w] their heights.
    """

    height: Tensor
    log_sigma: Tensor
    confidence: Tensor
    step: Tensor
    logits: Tensor
    hypotheses: Tensor

    @property
    def sigma(self) -> Tensor:
        """The error that about 70 % of the points stay below [B, H, W], window units."""
        return self.log_sigma.clamp(-6, 6).exp() * self.step[:, None, None] * SPREAD


class SweepGenerator(Part):
    """The paper's generator with a sweep in the place of the global feature vector.

    Args:
        channels: of the encoder's match and context maps.
        hypotheses: heights of the coarse sweep.
        groups: similarities per hypothesis.
        coarse_widths: channels of the coarse U-Net, from its finest to its coarsest level.
        fine_hypotheses: heights of a fine sweep.
        fine_step: their spacing, pixels of parallax.
        fine_width: channels of the fine network.
    """

    def __init__(
        self,
        *,
        channels: int,
        hypotheses: int,
        groups: int,
        coarse_widths: Sequence[int],
        fine_hypotheses: int,
        fine_step: float,
        fine_width: int,
    ) -> None:
        super().__init__()
        self.groups, self.hypotheses = groups, hypotheses
        self.fine_hypotheses, self.fine_step = fine_hypotheses, fine_step
        volume = 2 * groups + 1
        self.regularisation = nn.Sequential(
            nn.Conv3d(volume, 8, 3, padding=1), nn.BatchNorm3d(8), nn.PReLU(8),
            nn.Conv3d(8, 8, 3, padding=1), nn.BatchNorm3d(8), nn.PReLU(8),
            nn.Conv3d(8, 2, 3, padding=1),
        )  # fmt: skip
        self.coarse = UNet(
            inputs=2 * hypotheses + channels + 1, widths=coarse_widths, outputs=hypotheses + 3 + 9 * CONTEXT_STRIDE**2
        )
        self.fine = UNet(
            inputs=volume * fine_hypotheses + 2 * channels + 3,
            widths=(fine_width, fine_width + 16),
            outputs=fine_hypotheses + 3 + 9 * MATCH_STRIDE**2,
        )

    def forward(self, levels: Sequence[Level], height_range: Tensor) -> list[Surface]:
        """The surface at every sweep: first the coarse one, then a fine one for each level.

        Args:
            levels: from the smallest images to the largest.
            height_range: lowest and highest height [B, 2], window units.
        """
        surfaces = [self._coarse_sweep(levels[0], height_range)]
        for level in levels:
            surfaces.append(self._fine_sweep(level, surfaces[-1]))
        return surfaces

    def _coarse_sweep(self, level: Level, height_range: Tensor) -> Surface:
        width, height = level.size[0] // CONTEXT_STRIDE, level.size[1] // CONTEXT_STRIDE
        own = F.normalize(F.avg_pool2d(canvas_to_reference(level.match[:, 0], MATCH_STRIDE, level.size), 2), dim=1)
        low, high = height_range[:, :1], height_range[:, 1:]
        share = torch.linspace(0, 1, self.hypotheses, device=own.device)
        heights = low + (high - low) * share  # [B, D]
        planes = heights[..., None].expand(-1, -1, width * height)
        volume, visible = self._volume(level, own, planes)
        scores = self.regularisation(volume)  # [B, 2, D, h, w]
        views = _share(visible, own)
        context = canvas_to_reference(level.context, CONTEXT_STRIDE, level.size)
        out = self.coarse(torch.cat([scores.flatten(1, 2), context, views], 1))
        step = (high - low)[:, 0] / (self.hypotheses - 1)
        return _surface(out, planes.unflatten(2, (height, width)), step, CONTEXT_STRIDE, scores[:, 0])

    def _fine_sweep(self, level: Level, before: Surface) -> Surface:
        width, height = level.size[0] // MATCH_STRIDE, level.size[1] // MATCH_STRIDE
        start = F.adaptive_avg_pool2d(before.height.detach()[:, None], (height, width))
        own = canvas_to_reference(level.match[:, 0], MATCH_STRIDE, level.size)
        cast = self._lines(level, width, height)
        step = self.fine_step / pixels_per_height(cast, start.flatten(1))
        offsets = torch.arange(self.fine_hypotheses, device=own.device) - (self.fine_hypotheses - 1) / 2
        heights = start + offsets[:, None, None] * step[:, None, None, None]  # [B, D, h, w]
        volume, visible = self._volume(level, own, heights.flatten(2), cast)
        views = _share(visible, own)
        rough = (start - F.avg_pool2d(start, 5, 1, 2, count_include_pad=False)) / step[:, None, None, None]
        doubt = F.adaptive_avg_pool2d(before.log_sigma.detach()[:, None], (height, width))
        doubt = doubt + (before.step / step).log()[:, None, None, None]
        context = F.interpolate(
            canvas_to_reference(level.context, CONTEXT_STRIDE, level.size),
            scale_factor=2, mode="bilinear", align_corners=False,
        )  # fmt: skip
        state = [views, rough.clamp(-8, 8), doubt.clamp(-4, 4)]
        out = self.fine(torch.cat([volume.flatten(1, 2), own, context, *state], 1))
        return _surface(out, heights, step, MATCH_STRIDE, None)

    def _lines(self, level: Level, width: int, height: int):
        cells = pixel_centres(*level.size, width, height, level.match.device)
        cast = rays(cells, level.intrinsics[:, 0], level.camera_from_window[:, 0])
        return lines(cast, level.homographies, level.intrinsics, level.camera_from_window, level.size)

    def _volume(self, level: Level, own: Tensor, heights: Tensor, cast=None) -> tuple[Tensor, Tensor]:
        height, width = own.shape[-2:]
        cast = self._lines(level, width, height) if cast is None else cast
        volume, visible = agreement(
            own.flatten(2), level.match[:, 1:], cast, heights, stride=MATCH_STRIDE, groups=self.groups
        )
        return volume.unflatten(3, (height, width)), visible


class UNet(nn.Module):
    """Residual blocks at several octaves with sums across: [B, inputs, h, w] -> [B, outputs, h, w]."""

    def __init__(self, *, inputs: int, widths: Sequence[int], outputs: int) -> None:
        super().__init__()
        self.entry = ConvolutionBlock(inputs=inputs, outputs=widths[0], kernel=1)
        self.down = nn.ModuleList(ConvolutionBlock(inputs=a, outputs=b, stride=2) for a, b in pairwise(widths))
        self.blocks = nn.ModuleList(ResidualBlock(width=w) for w in widths)
        self.up = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in pairwise(widths))
        self.joined = nn.ModuleList(ResidualBlock(width=w) for w in widths[:-1])
        self.last = nn.Conv2d(widths[0], outputs, 1)
        with torch.no_grad():  # the first answer leans on nothing
            self.last.weight.mul_(0.1)
            nn.init.zeros_(self.last.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        x = self.entry(x.contiguous(memory_format=torch.channels_last))
        kept = []
        for i, block in enumerate(self.blocks):
            x = block(self.down[i - 1](x) if i else x)
            kept.append(x)
        for i in range(len(self.down) - 1, -1, -1):
            wider = F.interpolate(self.up[i](x), size=kept[i].shape[-2:], mode="bilinear", align_corners=False)
            x = self.joined[i](kept[i] + wider)
        out: Tensor = self.last(x)
        return out


def _surface(out: Tensor, heights: Tensor, step: Tensor, factor: int, scores: Tensor | None) -> Surface:
    """The answer of a sweep: the mean of the hypotheses about the most probable one, and a residual, upsampled."""
    d = heights.shape[1]
    logits, residual, log_sigma, confidence, mask = out.split([d, 1, 1, 1, out.shape[1] - d - 3], 1)
    if scores is not None:
        logits = logits + scores
    # Two surfaces may both be probable at an edge: their mean is neither.
    near = (torch.arange(d, device=out.device)[:, None, None] - logits.argmax(1, keepdim=True)).abs() <= 2
    weight = torch.where(near, logits, torch.full_like(logits, -1e4)).softmax(1)
    height = (weight * heights).sum(1, keepdim=True) + residual * step[:, None, None, None]
    fine, log_sigma, confidence = (_upsample(x, mask, factor) for x in (height, log_sigma, confidence))
    return Surface(fine, log_sigma, confidence, step, logits, heights)


def _share(visible: Tensor, own: Tensor) -> Tensor:
    """Share of the other frames [B, V, D, N] that see a ray at any height: [B, 1, h, w] like the features ``own``."""
    if not visible.shape[1]:
        return torch.zeros_like(own[:, :1])
    return visible.any(2).float().mean(1).unflatten(1, own.shape[-2:])[:, None]


def _upsample(x: Tensor, mask: Tensor, factor: int) -> Tensor:
    """Every fine pixel is a learned convex mean of the nine coarse ones around it (Teed and Deng 2020): [B, H, W]."""
    b, _, h, w = x.shape
    weight = mask.unflatten(1, (9, factor, factor)).softmax(1)
    around = F.unfold(F.pad(x, (1, 1, 1, 1), mode="replicate"), 3).reshape(b, 9, 1, 1, h, w)
    fine = (weight * around).sum(1)  # [B, factor, factor, h, w]
    return fine.permute(0, 3, 1, 4, 2).reshape(b, h * factor, w * factor)
