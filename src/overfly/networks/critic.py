"""The critic of SS-GAN-3D: scores how real an observation looks."""

from __future__ import annotations

from torch import Tensor, nn

from overfly.errors import InputError
from overfly.networks.blocks import Part

STAGES = {18: (2, 2, 2, 2), 50: (3, 4, 6, 3), 101: (3, 4, 23, 3)}  # residual blocks (He et al. 2016, Table 1)


class Critic(Part):
    """A residual network (He et al. 2016) without any normalisation and with PReLU for ReLU (section 3.4).

    Batch normalisation would tie the scores of a batch together, while the gradient penalty needs one score per image.
    What normalisation did for depth is left to the start: the last convolution of each of the L residual branches is
    scaled by 1 / sqrt(L), so that activations and gradients neither grow nor vanish with depth. The scores of an
    untrained critic have a slope of order 1 (0.1 to 10) with respect to patches of 64 to 128 pixels.

    Args:
        depth: layers, 18 (basic blocks), 50 or 101 (bottlenecks).
        width: channels of the stem, 64 in the paper.
        inputs: channels of the images.

    Raises:
        InputError: another depth.
    """

    def __init__(self, *, depth: int, width: int = 64, inputs: int = 3) -> None:
        super().__init__()
        if depth not in STAGES:
            allowed = ", ".join(map(str, STAGES))
            raise InputError(
                f"A critic of depth {depth} does not exist: take depth=18, the fastest, or one of {allowed}."
            )
        block, expansion = (BasicBlock, 1) if depth == 18 else (BottleneckBlock, 4)
        scale = sum(STAGES[depth]) ** -0.5
        self.stem = nn.Sequential(
            convolution(inputs, width, 7, stride=2), nn.PReLU(width), nn.MaxPool2d(3, stride=2, padding=1)
        )
        blocks: list[nn.Module] = []
        channels = width
        for stage, count in enumerate(STAGES[depth]):
            for i in range(count):
                inner = width << stage
                blocks.append(block(inputs=channels, width=inner, stride=2 if stage and not i else 1, scale=scale))
                channels = inner * expansion
        self.blocks = nn.Sequential(*blocks)
        self.head = nn.Linear(channels, 1)
        nn.init.normal_(self.head.weight, std=4 * channels**-0.5)  # makes up for the mean over all places
        nn.init.zeros_(self.head.bias)

    def forward(self, images: Tensor) -> Tensor:
        """Scores [B] of images [B, inputs, H, W] in 0..1, higher for what looks real; any size from 32 pixels."""
        features = self.blocks(self.stem(2 * images - 1))  # [B, C, H / 32, W / 32]
        scores: Tensor = self.head(features.mean((2, 3)))[:, 0]
        return scores


class ShortcutBlock(nn.Module):
    """PReLU(shortcut + branch): the shortcut is a strided 1 x 1 convolution where shapes differ."""

    def __init__(self, branch: nn.Sequential, *, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.branch = branch
        same = inputs == outputs and stride == 1
        self.shortcut = nn.Identity() if same else convolution(inputs, outputs, 1, stride=stride, gain=1.0)
        self.activation = nn.PReLU(outputs)

    def forward(self, features: Tensor) -> Tensor:
        out: Tensor = self.activation(self.shortcut(features) + self.branch(features))
        return out


class BasicBlock(ShortcutBlock):
    """Two convolutions, the second started at ``scale``: [B, inputs, H, W] -> [B, width, H / stride, W / stride]."""

    def __init__(self, *, inputs: int, width: int, stride: int, scale: float) -> None:
        branch = nn.Sequential(
            convolution(inputs, width, 3, stride=stride),
            nn.PReLU(width),
            convolution(width, width, 3, gain=scale),
        )
        super().__init__(branch, inputs=inputs, outputs=width, stride=stride)


class BottleneckBlock(ShortcutBlock):
    """1 x 1, 3 x 3, 1 x 1, the last started at ``scale``: [B, inputs, H, W] -> [B, 4 width, H / stride, W / stride]."""

    def __init__(self, *, inputs: int, width: int, stride: int, scale: float) -> None:
        branch = nn.Sequential(
            convolution(inputs, width, 1),
            nn.PReLU(width),
            convolution(width, width, 3, stride=stride),
            nn.PReLU(width),
            convolution(width, 4 * width, 1, gain=scale),
        )
        super().__init__(branch, inputs=inputs, outputs=4 * width, stride=stride)


def convolution(inputs: int, outputs: int, kernel: int, *, stride: int = 1, gain: float | None = None) -> nn.Conv2d:
    """A padded convolution with bias, started so that its outputs vary ``gain`` times as much as its inputs.

    By default the gain makes up for a PReLU at its initial slope of 0.25 (He et al. 2015).
    """
    layer = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2)
    gain = nn.init.calculate_gain("leaky_relu", 0.25) if gain is None else gain
    nn.init.normal_(layer.weight, std=gain * (inputs * kernel * kernel) ** -0.5)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
    return layer
