"""The discriminator: tells reference clouds from generated ones."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from overfly.errors import InputError
from overfly.networks.blocks import Part


class Discriminator(Part):
    """A point-set version of SRGAN's discriminator (section 3.2.2): LeakyReLU(0.3), no max-pooling, sigmoid at the end.

    Convolutions of width 1 are shared by all points; where SRGAN strides over pixels, a strided convolution merges
    ``strides[i]`` neighbours, without overlap, so that no point is dropped. For that the points are put in Z-order of
    their x and y, which makes the answer independent of the order in which they come; the last layer is a mean.
    There is no batch normalisation: real and generated clouds would share its statistics.

    Args:
        widths: channels of the convolutions.
        strides: points merged by each of them (1 keeps all).
        head_width: width of the fully connected layer before the last.
    """

    def __init__(self, *, widths: Sequence[int], strides: Sequence[int], head_width: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for inputs, outputs, stride in zip([3, *widths[:-1]], widths, strides, strict=True):
            layers += [nn.Conv1d(inputs, outputs, kernel_size=stride, stride=stride), nn.LeakyReLU(0.3)]
        self.convolutions = nn.Sequential(*layers)
        self.head = nn.Sequential(nn.Linear(widths[-1], head_width), nn.LeakyReLU(0.3), nn.Linear(head_width, 1))

    def forward(self, points: Tensor) -> Tensor:
        """Probability [B] that clouds [B, N, 3] are real."""
        return torch.sigmoid(self.logits(points))

    def logits(self, points: Tensor) -> Tensor:
        """The same before the sigmoid [B]: what the losses take, because it neither overflows nor saturates."""
        ordered = points.gather(1, z_order(points)[..., None].expand_as(points))
        pooled = self.convolutions(ordered.transpose(1, 2)).mean(2)
        logits: Tensor = self.head(pooled)[:, 0]
        return logits


def patches(points: Tensor, count: int) -> Tensor:
    """Neighbourhoods of clouds, each about its own centre and at the scale of a whole cloud.

    Args:
        points: [B, N, 3].
        count: neighbourhoods of a cloud, a divisor of N; 1 leaves the clouds as they are.

    Returns:
        [B * count, N / count, 3]: consecutive points along :func:`z_order`.

    Raises:
        InputError: ``count`` does not divide N.
    """
    if count == 1:
        return points
    if count < 1 or points.shape[1] % count:
        raise InputError(f"{points.shape[1]} points do not split into {count} patches: give a divisor, such as 16.")
    ordered = points.gather(1, z_order(points)[..., None].expand_as(points))
    local = ordered.unflatten(1, (count, -1)).flatten(0, 1)
    return (local - local.mean(1, keepdim=True)) * count**0.5


@torch.no_grad()
def z_order(points: Tensor, limit: float = 2.0) -> Tensor:
    """The order [B, N] of points [B, N, 3] along a Z-shaped curve through x and y; equal places are ordered by z."""
    cells = ((points.clamp(-limit, limit) + limit) * ((1 << 15) - 1) / limit / 2).long()  # 15 bits each
    key = torch.zeros_like(cells[..., 0])
    for bit in range(15):
        key |= ((cells[..., 0] >> bit) & 1) << (2 * bit)
        key |= ((cells[..., 1] >> bit) & 1) << (2 * bit + 1)
    return ((key << 15) | cells[..., 2]).argsort(dim=1, stable=True)
