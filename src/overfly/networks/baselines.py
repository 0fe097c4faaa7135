"""Answers that need no insight into the images: what a network has to beat.

- *flat ground*: the initial cloud, that is the ground at its prior height;
- *mean training cloud*: the best constant height of each initial point;
- *nearest training window*: the reference of the training window that looks most alike.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from overfly.errors import InputError
from overfly.networks.ground import initial_cloud


def mean_heights(windows: Iterable[Mapping[str, Tensor]], points: int) -> Tensor:
    """The mean height of each point of the initial cloud over training windows.

    Args:
        windows: batches with ``reference`` [B, N, 3] and what :func:`initial_cloud` takes.
        points: number of points of the initial cloud.

    Returns:
        [points]: the mean, over the windows, of the height of the reference point nearest in x, y.

    Raises:
        InputError: there is no window.
    """
    total, count = np.zeros(points), 0
    for batch in windows:
        for grid, reference in zip(initial_cloud(points, batch).double(), batch["reference"].double(), strict=True):
            total += heights_at(grid[:, :2].cpu().numpy(), reference.cpu().numpy())
            count += 1
    if not count:
        raise InputError("The mean training cloud needs a training window: give a training split with images.")
    return torch.from_numpy(total / count).float()


def lifted(cloud: Tensor, heights: Tensor) -> Tensor:
    """Clouds [B, N, 3] at other heights [N] or [B, N]."""
    return torch.cat([cloud[..., :2], heights.to(cloud).expand(cloud.shape[:2])[..., None]], -1)


def heights_at(xy: NDArray, points: NDArray) -> NDArray[np.float64]:
    """Height of the nearest point in x, y [M] at places [M, 2] of a cloud [N, 3]."""
    heights: NDArray[np.float64] = points[cKDTree(points[:, :2]).query(xy)[1], 2]
    return heights


def interpolated(xy: NDArray, points: NDArray, neighbours: int = 4) -> NDArray[np.float64]:
    """Height [M] at places [M, 2] between the points [N, 3] nearest in x, y, each weighing its inverse distance."""
    distance, index = cKDTree(points[:, :2]).query(xy, k=np.arange(1, min(neighbours, len(points)) + 1))
    weight = 1 / np.maximum(distance, 1e-9)
    heights: NDArray[np.float64] = (weight * points[index, 2]).sum(1) / weight.sum(1)
    return heights


class NearestWindow:
    """Answers with the reference of the training window whose reference frame has the most similar descriptor."""

    def __init__(self) -> None:
        self.descriptors: list[Tensor] = []
        self.references: list[Tensor] = []

    def add(self, output: Mapping[str, Tensor], batch: Mapping[str, Tensor]) -> None:
        """Remember training windows: the network's ``descriptor`` [B, K, D], the batch's ``reference`` [B, N, 3]."""
        self.descriptors.append(output["descriptor"][:, 0].cpu())
        self.references.append(batch["reference"].cpu())

    def __call__(self, output: Mapping[str, Tensor]) -> Tensor:
        """Clouds [B, N, 3], window units.

        Raises:
            InputError: nothing was added.
        """
        if not self.descriptors:
            raise InputError("There is no training window to choose from: give a training split with images.")
        similarity = output["descriptor"][:, 0].cpu() @ torch.cat(self.descriptors).T
        return torch.cat(self.references)[similarity.argmax(1)]
