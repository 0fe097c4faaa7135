"""The building blocks that encoder and generator share (the paper's Figure 2: CB, RB, UB)."""

from __future__ import annotations

import hashlib

import torch
from torch import Tensor, nn

from overfly.errors import InputError


class Part(nn.Module):
    """A network part that counts the optimiser steps it was trained for.

    ``steps`` travels in the weights, so that whoever loads them can tell a trained part from an untouched one
    and never starts from random weights unknowingly.
    """

    steps: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("steps", torch.zeros((), dtype=torch.int64))


class ConvolutionBlock(nn.Sequential):
    """Convolution, batch normalisation, PReLU: [B, inputs, H, W] -> [B, outputs, H / stride, W / stride]."""

    def __init__(self, *, inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> None:
        super().__init__(
            nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False),
            nn.BatchNorm2d(outputs),
            nn.PReLU(outputs),
        )


class ResidualBlock(nn.Module):
    """Two convolutions with batch normalisation and a PReLU between, added to their input (SRGAN's form).

    [B, width, H, W] -> [B, width, H, W]. Encoder and generator use this very class, so that weights move between them.
    """

    def __init__(self, *, width: int) -> None:
        super().__init__()
        self.width = width
        self.residual = nn.Sequential(
            nn.Conv2d(width, width, 3, 1, 1, bias=False),
            nn.BatchNorm2d(width),
            nn.PReLU(width),
            nn.Conv2d(width, width, 3, 1, 1, bias=False),
            nn.BatchNorm2d(width),
        )

    def forward(self, features: Tensor) -> Tensor:
        return features + self.residual(features)


class UpsamplingBlock(nn.Sequential):
    """Sub-pixel convolution (Shi et al. 2016): [B, inputs, H, W] -> [B, outputs, 2 H, 2 W]."""

    def __init__(self, *, inputs: int, outputs: int) -> None:
        super().__init__(
            nn.Conv2d(inputs, 4 * outputs, 3, 1, 1),
            nn.PixelShuffle(2),
            nn.PReLU(outputs),
        )


def grid_side(points: int) -> int:
    """The side n of an n x n grid of ``points`` points; an InputError where there is none."""
    side = round(points**0.5)
    if side < 1 or side * side != points:
        near = max(1, side) ** 2
        raise InputError(f"points={points} is not a square number, which the initial cloud needs: take points={near}.")
    return side


def weights_key(network: nn.Module) -> str:
    """Hexadecimal digits that depend on all weights of a network."""
    digest = hashlib.sha256()
    for name, value in network.state_dict().items():
        digest.update(name.encode())
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()
