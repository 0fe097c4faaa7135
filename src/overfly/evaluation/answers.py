"""What every method says of a batch of windows, in one form, so that all are measured alike."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from overfly.errors import InputError
from overfly.evaluation.semi_global import semi_global
from overfly.mapping.sweep import PER_FRAME, reference_alone
from overfly.networks.baselines import NearestWindow, interpolated, lifted, mean_heights
from overfly.networks.blocks import grid_side
from overfly.networks.correlation import Heights, correlation_sweep
from overfly.networks.ground import initial_cloud, pixel_centres, rays
from overfly.stages.surfaces import RIGHT_PX, true_heights

Batch = Mapping[str, Tensor]


def as_true(batch: Batch) -> dict[str, Tensor]:
    """The windows as the true cameras see them, where methods were given estimated ones."""
    return {**batch, "camera_from_window": batch.get("true_camera_from_window", batch["camera_from_window"])}


@dataclass(frozen=True)
class Answer:
    """Clouds and surfaces of B windows, in window units.

    Attributes:
        points: the clouds [B, N, 3].
        height: of the surface at every pixel of the reference image [B, H, W].
        sigma: 68 % of the errors shall be below it [B, H, W]; None if the method does not say.
        confidence: probability that the height is right [B, H, W]; None if the method does not say.
        right_within: the error up to which a height is right.
        measured: pixels that were measured and not filled in [B, H, W]; None if the method does not say.
        views: frames that have the place inside, the reference included [B, H, W]; None if the method does not say.
        alone: height that the reference image suggests without the others [B, H, W]; None if the method does not say.
    """

    points: Tensor
    height: Tensor
    sigma: Tensor | None = None
    confidence: Tensor | None = None
    right_within: float = 0.0
    measured: Tensor | None = None
    views: Tensor | None = None
    alone: Tensor | None = None


class Baselines:
    """The answers that need no trained network of their own.

    Args:
        train: batches of the training windows; none for a network whose training data are not at hand: then neither
            their mean nor the nearest of them is an answer.
        encoder: whose descriptors find the nearest of them.
        points: of a cloud, a square number.
    """

    def __init__(self, train: Iterable[Batch] | None, encoder: Network, points: int) -> None:
        self.points, self.encoder = points, encoder
        self.nearest = NearestWindow()
        self.mean = None if train is None else mean_heights(self._remembered(train), points)

    def _remembered(self, train: Iterable[Batch]) -> Iterator[Batch]:
        for batch in train:
            self.nearest.add(self.encoder.describe(batch), batch)
            yield batch

    def __call__(self, batch: Batch) -> dict[str, Answer]:
        """Answers by name, from the least insight to the most, and the two floors of the sampling."""
        flat = initial_cloud(self.points, batch)
        height, width = batch["images"].shape[-2:]
        zero = batch["images"].new_zeros(len(flat), height, width)
        answers = {FLAT: Answer(flat, zero)}
        if self.mean is not None:
            side = grid_side(self.points)
            mean = F.interpolate(self.mean.to(flat).reshape(1, 1, side, side), (height, width), mode="bilinear")
            answers["mean training cloud"] = Answer(lifted(flat, self.mean), mean[0].expand_as(zero))
            nearest = self.nearest(self.encoder.describe(batch)).to(flat)
            answers["nearest training window"] = _of_cloud(nearest, batch)
        return answers | {
            "correlation sweep": self._of_heights(correlation_sweep(batch), batch),
            "semi-global stereo": self._of_heights(semi_global(batch), batch),
            FLOOR: self._exact(batch),
            "floor: second sample": _of_cloud(batch["reference_again"], batch),
        }

    def _of_heights(self, found: Heights, batch: Batch) -> Answer:
        return Answer(on_grid(found.height, batch, self.points), found.height, measured=found.measured)

    def _exact(self, batch: Batch) -> Answer:
        batch = as_true(batch)
        height, width = batch["images"].shape[-2:]
        true, known = true_heights(batch, width, height)
        true = torch.where(known, true, torch.zeros_like(true))
        return Answer(on_grid(true, batch, self.points), true)


FLAT = "flat ground"
FLOOR = "floor: exact heights"


class Network:
    """A trained network, given windows of the size that it was trained with.

    Args:
        network: of :mod:`overfly.networks`; put into evaluation mode.
        width: of the images that it was trained with, pixels.
    """

    def __init__(self, network: nn.Module, width: int) -> None:
        self.network, self.width = network.eval(), width

    @torch.no_grad()
    def __call__(self, batch: Batch) -> Answer:
        height, width = batch["images"].shape[-2:]
        output = self.network(self.sized(batch))
        if "height" not in output:
            return _of_cloud(output["points"], batch)
        maps = {name: _enlarged(output[name], (height, width)) for name in ("height", "sigma", "confidence")}
        within = RIGHT_PX * 2 / output["height"].shape[2]
        views = F.interpolate(output["views"][:, None].float(), (height, width), mode="nearest")[:, 0]
        alone = maps["height"]
        if batch["images"].shape[1] > 1 and bool((views < 2).any()):
            alone = _enlarged(self.network(self.sized(reference_alone(batch)))["height"], (height, width))
        return Answer(output["points"], **maps, right_within=within, views=views, alone=alone)

    @torch.no_grad()
    def encode(self, batch: Batch) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """What its encoder says of all frames, and the windows as it saw them."""
        seen = self.sized(batch)
        output: dict[str, Tensor] = self.network.encode(seen)  # type: ignore[operator]
        return output, seen

    def describe(self, batch: Batch) -> dict[str, Tensor]:
        """``descriptor`` [B, 1, D] of the reference frames, the other frames left aside."""
        return self.encode(reference_alone({name: batch[name] for name in PER_FRAME}))[0]

    def sized(self, batch: Batch) -> dict[str, Tensor]:
        """The windows at the image size that the network was trained with.

        Raises:
            InputError: this size is not that of the windows divided by a whole number.
        """
        width = batch["images"].shape[-1]
        factor = width // self.width
        if factor * self.width != width:
            raise InputError(
                f"A network for images {self.width} pixels wide cannot take windows {width} pixels wide: "
                f"set image_size so that its width is {self.width} or a multiple of it."
            )
        if factor == 1:
            return dict(batch)
        images = F.avg_pool2d(batch["images"].flatten(0, 1), factor).unflatten(0, batch["images"].shape[:2])
        shrunk = batch["intrinsics"] * batch["intrinsics"].new_tensor([1 / factor, 1 / factor, 1])[:, None]
        sized = {**batch, "images": images, "intrinsics": shrunk}
        if "depth" in batch:
            sized["depth"] = batch["depth"][..., factor // 2 :: factor, factor // 2 :: factor]
        return sized


def on_grid(heights: Tensor, batch: Batch, points: int) -> Tensor:
    """Points [B, N, 3] of a surface [B, H, W]: at the pixels in which the initial cloud's cells have their centres."""
    height, width = heights.shape[-2:]
    side = grid_side(points)
    cells = pixel_centres(width, height, side, side, heights.device).long()  # column, row
    cast = rays(cells + 0.5, batch["intrinsics"][:, 0], batch["camera_from_window"][:, 0])
    return cast.at(heights[:, cells[:, 1], cells[:, 0]])


def _of_cloud(points: Tensor, batch: Batch) -> Answer:
    """A cloud and the surface between its points: that is all a method of 1024 points says of the other pixels."""
    height, width = batch["images"].shape[-2:]
    cells = pixel_centres(width, height, width, height, points.device)
    feet = rays(cells, batch["intrinsics"][:, 0], batch["camera_from_window"][:, 0]).foot[..., :2]
    pairs: Any = zip(feet.cpu().numpy(), points.cpu().numpy(), strict=True)
    surfaces = np.stack([interpolated(xy, cloud).reshape(height, width) for xy, cloud in pairs])
    return Answer(points, torch.from_numpy(surfaces).to(points))


def _enlarged(values: Tensor, size: tuple[int, int]) -> Tensor:
    if values.shape[-2:] == size:
        return values
    return F.interpolate(values[:, None], size, mode="bilinear", align_corners=False)[:, 0]
