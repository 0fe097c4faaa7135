"""The generator: moves a uniform initial cloud to the surface that a window's frames see."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from overfly.errors import InputError
from overfly.networks.blocks import Part, ResidualBlock, UpsamplingBlock, grid_side
from overfly.networks.encoder import Encoder

POSE = 14
"""Numbers that describe a frame's camera: position, rotation and the two focal lengths over the image's size."""


class Generator(Part):
    """The generator of section 3.2.1 with the sizes of Figure 2.

    Decisions where the paper is silent or contradicts itself:

    - *A sequence of frames*: every frame's DFV and camera pass a fully connected layer, the mean over the frames a
      second one; the result is the window's DFV. So any number of frames gives one cloud.
    - *DFV concatenated to each point of the initial cloud*: one shared fully connected layer on [DFV, x, y, z];
      the DFV's share is computed once, which is the same. The paper says that the result has size 1024 x 1, which a
      DFV of 1024 and 3 coordinates cannot have.
    - *Ten residual blocks identical to the encoder's*: the same class and width. The 1024 points of the initial cloud
      stand in a 32 x 32 grid, which makes them a feature map, so the encoder's two-dimensional weights fit as they are
      (:meth:`start_from`).
    - *Sub-pixel convolution with two fully connected and two max-pooling layers*: two upsampling blocks (as in SRGAN),
      each followed by a fully connected layer over the 64 x 64 candidates and a max-pooling that lets the strongest
      candidate of each point's four through, so that 1024 points remain.
    - *Three FC + ReLU, then FC and max-pooling -> 1024 x 3*: shared over points; the last layer offers ``candidates``
      moves per point and coordinate, of which the largest is taken. The moves start small and are added to the
      initial cloud.

    Args:
        features: size of a frame's DFV.
        points: number of points, a square number.
        width: channels of the residual blocks, one of the encoder's widths.
        blocks: number of residual blocks.
        upsampled_width: channels of the 64 x 64 candidates.
        head_width: width of the three fully connected layers.
        candidates: moves among which the last max-pooling chooses.
    """

    def __init__(
        self,
        *,
        features: int,
        points: int,
        width: int,
        blocks: int,
        upsampled_width: int,
        head_width: int,
        candidates: int,
    ) -> None:
        super().__init__()
        self.side, self.width, self.candidates = grid_side(points), width, candidates
        self.frame_head = nn.Sequential(nn.Linear(features + POSE, features), nn.PReLU())
        self.fusion = nn.Sequential(nn.Linear(features, features), nn.PReLU())
        self.from_features = nn.Linear(features, width)
        self.from_point = nn.Linear(3, width, bias=False)
        self.activation = nn.PReLU(width)
        self.blocks = nn.Sequential(*[ResidualBlock(width=width) for _ in range(blocks)])
        upsampling: list[nn.Module] = []
        for inputs, outputs in ((width, width), (width, head_width)):
            upsampling += [UpsamplingBlock(inputs=inputs, outputs=upsampled_width)]
            upsampling += [nn.Conv2d(upsampled_width, outputs, 1), nn.MaxPool2d(2)]
        self.upsampling = nn.Sequential(*upsampling)
        self.head = nn.Sequential(*[m for _ in range(3) for m in (nn.Linear(head_width, head_width), nn.ReLU())])
        self.last = nn.Linear(head_width, 3 * candidates)
        with torch.no_grad():  # the first cloud is nearly the initial one
            self.last.weight.mul_(0.1)
            self.last.bias.zero_()

    def forward(
        self, initial: Tensor, features: Tensor, camera_from_window: Tensor, intrinsics: Tensor, image_size: Tensor
    ) -> Tensor:
        """One cloud per window.

        Args:
            initial: the initial cloud [B, points, 3], window units, row by row of its grid.
            features: DFVs [B, K, features].
            camera_from_window: [B, K, 4, 4].
            intrinsics: [B, K, 3, 3], pixels.
            image_size: width and height [2], pixels.

        Returns:
            Points [B, points, 3], window units; point i belongs to point i of the initial cloud.
        """
        code = self.code(features, camera_from_window, intrinsics, image_size)
        entry = self.from_features(code)[:, None] + self.from_point(initial)  # [B, N, C]
        grid = entry.unflatten(1, (self.side, self.side)).permute(0, 3, 1, 2)  # [B, C, side, side], channels last
        grid = self.upsampling(self.blocks(self.activation(grid)))
        moves = self.last(self.head(grid.permute(0, 2, 3, 1).flatten(1, 2)))  # [B, N, 3 candidates]
        return initial + moves.unflatten(-1, (3, self.candidates)).amax(-1)

    def code(self, features: Tensor, camera_from_window: Tensor, intrinsics: Tensor, image_size: Tensor) -> Tensor:
        """The window's dense feature vector [B, features] from those of its frames and their cameras."""
        rotation = camera_from_window[..., :3, :3]
        position = -(rotation.transpose(-1, -2) @ camera_from_window[..., :3, 3:])[..., 0]
        focal = torch.stack([intrinsics[..., 0, 0], intrinsics[..., 1, 1]], -1) / image_size
        cameras = torch.cat([position, rotation.flatten(-2), focal], -1)  # [B, K, POSE]
        fused: Tensor = self.fusion(self.frame_head(torch.cat([features, cameras], -1)).mean(1))
        return fused

    @torch.no_grad()
    def start_from(self, encoder: Encoder) -> str:
        """Copy the encoder's residual blocks, batch statistics included, into the generator's.

        Blocks of the generator's width are taken in turn: with four of them, the ten start as 1 2 3 4 1 2 3 4 1 2.

        Returns:
            One line that says what was copied.

        Raises:
            InputError: no block of the encoder has the generator's width.
        """
        fitting = {i: block for i, block in enumerate(encoder.blocks, 1) if block.width == self.width}
        if not fitting:
            widths = [block.width for block in encoder.blocks]
            raise InputError(
                f"The generator's blocks have {self.width} channels and start from the encoder's, which have {widths}: "
                f"set model.generator.width to one of these."
            )
        order = [list(fitting)[j % len(fitting)] for j in range(len(self.blocks))]
        for block, source in zip(self.blocks, order, strict=True):
            block.load_state_dict(fitting[source].state_dict())
        return f"generator: its {len(order)} residual blocks start as the encoder's blocks {' '.join(map(str, order))}"
