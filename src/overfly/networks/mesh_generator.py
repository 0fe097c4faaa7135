"""The 3D generation networks of SS-GAN-3D: they hold one scene's mesh and are what its refinement trains.

Both know the rough mesh they start from and answer ``forward()`` with the present one: vertices [V, 3] in local metres
and colours [V, 3] in 0..1, float32. The faces do not change and are the caller's. Untrained, both return the rough mesh
bit for bit.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn.functional import leaky_relu, linear

COLOR_STEP = 0.1


class FreeVertices(nn.Module):
    """The mesh itself as parameters: an offset and a change of colour per vertex.

    Parameters are in units of ``step`` and ``color_step``, so that Adam, whose first steps are as long as its learning
    rate, moves a vertex by learning rate x step metres.

    Args:
        vertices: of the rough mesh [V, 3], local metres.
        colors: [V, 3] in 0..1.
        step: metres per unit of an offset, for instance the ground sampling distance.
        color_step: change of colour per unit.
    """

    vertices: Tensor
    colors: Tensor

    def __init__(self, vertices: Tensor, colors: Tensor, *, step: float, color_step: float = COLOR_STEP) -> None:
        super().__init__()
        _register(self, vertices, colors)
        self.step, self.color_step = step, color_step
        self.offsets = nn.Parameter(torch.zeros_like(self.vertices))
        self.color_offsets = nn.Parameter(torch.zeros_like(self.colors))

    def forward(self) -> tuple[Tensor, Tensor]:
        """The present vertices [V, 3], metres, and colours [V, 3]."""
        vertices = self.vertices + self.step * self.offsets
        return vertices, clamped(self.colors + self.color_step * self.color_offsets)

    @torch.no_grad()
    def subdivided(self, parents: Tensor) -> FreeVertices:
        """The same surface with more vertices: vertex i is the mean of vertices ``parents[i]`` [V_new, 2] int64.

        The present mesh becomes the rough mesh of the new module and all its parameters are 0.
        """
        vertices, colors = (_mean(values, parents) for values in self())
        return FreeVertices(vertices, colors, step=self.step, color_step=self.color_step)

    def _load_from_state_dict(self, state: dict[str, Any], prefix: str, *rest: Any) -> None:
        _resize(self, state, prefix)
        super()._load_from_state_dict(state, prefix, *rest)


class MeshGenerator(nn.Module):
    """A residual PReLU network over the vertices, the same for all of them (Fig. 2a has no text; the choice is ours).

    It sees a vertex of the rough mesh as Fourier features of its place (Tancik et al. 2020), its colour and a learned
    code, which is what can tell it from its neighbours; it answers with an offset and a change of colour. Compared with
    :class:`FreeVertices`, neighbours move together.

    Args:
        vertices: of the rough mesh [V, 3], local metres.
        colors: [V, 3] in 0..1.
        step: metres per unit of the network's offset.
        width: channels of the residual blocks.
        blocks: residual blocks.
        code: length of a vertex's code, 0 for none.
        frequencies: octaves of the Fourier features; the first wavelength is twice the mesh's longest side.
        color_step: change of colour per unit of the network's answer.
    """

    vertices: Tensor
    colors: Tensor
    centre: Tensor
    scale: Tensor
    features: Tensor

    def __init__(
        self,
        vertices: Tensor,
        colors: Tensor,
        *,
        step: float,
        width: int = 32,
        blocks: int = 4,
        code: int = 8,
        frequencies: int = 6,
        color_step: float = COLOR_STEP,
    ) -> None:
        super().__init__()
        _register(self, vertices, colors)
        self.options = {"step": step, "width": width, "blocks": blocks, "code": code}
        self.options |= {"frequencies": frequencies, "color_step": color_step}
        self.step, self.color_step, self.frequencies = step, color_step, frequencies
        low, high = self.vertices.amin(0), self.vertices.amax(0)
        self.register_buffer("centre", (low + high) / 2)
        self.register_buffer("scale", ((high - low).max() / 2).clamp(min=1e-6))  # metres, half of the longest side
        self.codes = nn.Parameter(torch.zeros(len(self.vertices), code))
        self.stem = nn.Linear(3 + 6 * frequencies + 3 + code, width)
        self.blocks = nn.Sequential(*(VertexBlock(width=width) for _ in range(blocks)))
        self.activation = PReLU()
        self.head = nn.Linear(width, 6)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)
        self.register_buffer("features", self._features(), persistent=False)

    def forward(self) -> tuple[Tensor, Tensor]:
        """The present vertices [V, 3], metres, and colours [V, 3]."""
        known = self.features.shape[1]  # the stem's input is (features, codes); the features need no gradient
        hidden = linear(self.features, self.stem.weight[:, :known], self.stem.bias)
        hidden = self.blocks(hidden + linear(self.codes, self.stem.weight[:, known:]))  # [V, width]
        offsets, color_offsets = self.head(self.activation(hidden)).chunk(2, 1)
        return self.vertices + self.step * offsets, clamped(self.colors + self.color_step * color_offsets)

    @torch.no_grad()
    def subdivided(self, parents: Tensor) -> MeshGenerator:
        """The same surface with more vertices: vertex i is the mean of vertices ``parents[i]`` [V_new, 2] int64.

        The present mesh becomes the rough mesh of the new module, whose last layer is therefore reset to 0; its other
        weights and the normalisation of places are kept, and codes are averaged like the rest.
        """
        vertices, colors = (_mean(values, parents) for values in self())
        with torch.random.fork_rng(devices=[]):  # the new module's random weights are overwritten
            new = MeshGenerator(vertices, colors, **self.options)  # type: ignore[arg-type]
        for name in ("stem", "blocks", "activation"):
            getattr(new, name).load_state_dict(getattr(self, name).state_dict())
        new.codes.copy_(_mean(self.codes, parents))
        new.centre.copy_(self.centre)
        new.scale.copy_(self.scale)
        new = new.to(self.vertices.device)
        new.features = new._features()
        return new

    def _features(self) -> Tensor:
        """What does not change of the network's input [V, 6 + 6 frequencies]: place, its Fourier features, colour."""
        place = (self.vertices - self.centre) / self.scale  # -1..1
        octaves = math.pi * 2.0 ** torch.arange(self.frequencies, device=place.device)
        angles = (place[:, :, None] * octaves).flatten(1)
        return torch.cat([place, angles.sin(), angles.cos(), self.colors], 1)

    def _load_from_state_dict(self, state: dict[str, Any], prefix: str, *rest: Any) -> None:
        _resize(self, state, prefix)
        super()._load_from_state_dict(state, prefix, *rest)
        self.features = self._features()


class VertexBlock(nn.Module):
    """Linear, PReLU, linear, added to their input: [V, width] -> [V, width]."""

    def __init__(self, *, width: int) -> None:
        super().__init__()
        self.residual = nn.Sequential(nn.Linear(width, width), PReLU(), nn.Linear(width, width))

    def forward(self, features: Tensor) -> Tensor:
        return features + self.residual(features)


class PReLU(nn.PReLU):
    """One slope for all channels (He et al. 2015); backwards on a CPU in half the time of torch's."""

    def forward(self, features: Tensor) -> Tensor:
        if features.device.type != "cpu":
            return super().forward(features)
        out: Tensor = _PReLU.apply(features, self.weight)
        return out


class _PReLU(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: Tensor, slope: Tensor) -> Tensor:
        ctx.save_for_backward(features, slope)
        return leaky_relu(features, slope.item())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        features, slope = ctx.saved_tensors
        to_slope = torch.dot(gradient.flatten(), features.clamp(max=0).flatten())
        return torch.ops.aten.leaky_relu_backward(gradient, features, slope.item(), False), to_slope.reshape(1)


def clamped(colors: Tensor) -> Tensor:
    """Colours within 0..1. A gradient that leads back inside passes, so that no colour is lost for good."""
    out: Tensor = _Clamp.apply(colors)
    return out


class _Clamp(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, colors: Tensor) -> Tensor:
        ctx.save_for_backward(colors)
        return colors.clamp(0, 1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (colors,) = ctx.saved_tensors
        outwards = ((colors > 1) & (gradient < 0)) | ((colors < 0) & (gradient > 0))  # descent goes against it
        return gradient.masked_fill(outwards, 0)


def _register(module: nn.Module, vertices: Tensor, colors: Tensor) -> None:
    if vertices.ndim != 2 or vertices.shape[1] != 3 or colors.shape != vertices.shape:
        raise ValueError(
            f"A mesh has vertices [V, 3] and colours [V, 3], not {tuple(vertices.shape)} and {tuple(colors.shape)}."
        )
    module.register_buffer("vertices", vertices.detach().float().clone())
    module.register_buffer("colors", colors.detach().float().clone())


def _mean(values: Tensor, parents: Tensor) -> Tensor:
    """The mean of both parents [V_new, 2] of values [V, C] -> [V_new, C]; exact where they are one and the same."""
    first, second = parents.unbind(1)
    return (values.index_select(0, first) + values.index_select(0, second)) / 2


@torch.no_grad()
def _resize(module: nn.Module, state: dict[str, Any], prefix: str) -> None:
    """Make room for a mesh that was subdivided after it was built, so that a resumed refinement finds its own."""
    for name, own in [*module.named_parameters(recurse=False), *module.named_buffers(recurse=False)]:
        saved = state.get(prefix + name)
        if saved is not None and saved.shape[1:] == own.shape[1:] and len(saved.shape) == 2:
            own.data = own.new_empty(saved.shape)
