"""The mesh that a refinement moves: the network that holds it, its faces, and where it shall become finer."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from overfly import mesh_losses
from overfly.rendering.render import Rendered, Views, render
from overfly.rendering.subdivision import subdivide, wanted
from overfly.rendering.topology import Topology, topology

SUBDIVISIONS = 8
"""At most so many times edges are halved at the start of an epoch; each at most quadruples the faces."""


class Mesh(Protocol):
    """A mesh as :class:`overfly.mesh.Mesh` holds it."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    colors: NDArray[np.uint8] | None


class Prepared(NamedTuple):
    """A mesh that can be rendered: vertices [V, 3], local metres, colours [V, 3] in 0..1, and its connections."""

    vertices: Tensor
    colors: Tensor
    sides: Topology

    def seen_by(self, views: Views, background: Tensor | None = None) -> Rendered:
        """Rendered in some views."""
        return render(self.vertices, self.colors, self.sides, views, background=background)


def prepared(mesh: Mesh, device: torch.device | str) -> Prepared:
    """A mesh on a device, ready to be rendered."""
    assert mesh.colors is not None
    vertices = torch.from_numpy(np.asarray(mesh.vertices)).float().to(device)
    colors = torch.from_numpy(np.asarray(mesh.colors)).float().to(device) / 255
    faces = torch.from_numpy(np.asarray(mesh.faces)).int().to(device)
    return Prepared(vertices, colors, topology(faces, len(vertices)))


class RefinedMesh(nn.Module):
    """A generator's mesh and its faces, which become more. ``forward()``: vertices [V, 3] and colours [V, 3].

    Faces, lengths and errors travel with the weights, so that a resumed refinement goes on exactly where it was.

    Args:
        start: the mesh to begin with.
        generator: makes the network from vertices, colours and ``step`` (see :mod:`overfly.networks.mesh_generator`).
        step: metres per unit of its offsets.
    """

    sides: Topology
    edge_m: float
    error: NDArray[np.float64]

    def __init__(self, start: Prepared, *, generator: Callable[..., nn.Module], step: float) -> None:
        super().__init__()
        self.generator = generator(start.vertices, start.colors, step=step)
        self._connect(start.sides.faces)

    def forward(self) -> tuple[Tensor, Tensor]:
        vertices, colors = self.generator()
        return vertices, colors

    def prepared(self) -> Prepared:
        """The present mesh, with gradients."""
        vertices, colors = self()
        return Prepared(vertices, colors, self.sides)

    def _apply(self, *arguments: Any, **options: Any) -> RefinedMesh:
        super()._apply(*arguments, **options)
        self.sides = self.sides.to(next(self.generator.parameters()).device)
        return self

    @property
    def faces(self) -> Tensor:
        """[F, 3] int32."""
        return self.sides.faces

    def _connect(self, faces: Tensor) -> None:
        with torch.no_grad():
            vertices, _ = self()
        self.sides = topology(faces, len(vertices))
        a, b = self.sides.edges.unbind(1)
        self.edge_m = float((vertices[a] - vertices[b])[:, :2].norm(dim=1).median())
        self.forget_errors()

    def get_extra_state(self) -> dict[str, Any]:
        vertices = self.sides.vertex_count
        error = torch.from_numpy(self.error)
        return {"faces": self.faces, "vertices": vertices, "edge_m": self.edge_m, "error": error}

    def set_extra_state(self, state: Mapping[str, Any]) -> None:
        device = self.faces.device
        self.sides = topology(state["faces"].to(device), state["vertices"])
        self.edge_m, self.error = state["edge_m"], state["error"].cpu().numpy().copy()

    def forget_errors(self) -> None:
        """Begin anew to add up errors."""
        self.error = np.zeros(len(self.faces))

    @torch.no_grad()
    def add_error(self, rendered: Rendered, photograph: Tensor, valid: Tensor) -> None:
        """Add up each face's difference over the pixels that show it: where finer faces are worth their price."""
        shown = (rendered.face >= 0) & (valid > 0)
        difference = (rendered.image - photograph).abs().mean(1)
        faces, values = rendered.face[shown].cpu().numpy(), difference[shown].cpu().numpy()
        self.error += np.bincount(faces, values, len(self.error))

    def subdivide_to(self, budget: int, *, least: float) -> bool:
        """Halve edges, those of the largest errors first, until there are about ``budget`` faces.

        The longest come first where no errors are known: at the very start, and from the second round on.

        Args:
            budget: faces, at most; a mesh that has nine tenths of it is left.
            least: metres; edges shorter than twice this are left.

        Returns:
            Whether there are more faces, and new parameters.
        """
        start = len(self.faces)
        for _ in range(SUBDIVISIONS):
            faces, edges = (x.cpu().numpy().astype(np.int64) for x in (self.faces, self.sides.edges))
            if len(faces) > 0.9 * budget:
                break
            with torch.no_grad():
                vertices, _ = self()
            length = (vertices[edges[:, 0]] - vertices[edges[:, 1]]).norm(dim=1).cpu().numpy().astype(np.float64)
            error = self.error if self.error.any() else np.ones(len(faces))
            halved = wanted(faces, edges, error, length, budget=min(budget, 4 * len(faces)), least=least)
            if not halved.any():  # edges are as short as the pixels
                break
            parents, new = subdivide(faces, edges, halved, len(vertices))
            self.generator = cast(Any, self.generator).subdivided(torch.from_numpy(parents).to(vertices.device))
            self._connect(torch.from_numpy(new).int().to(vertices.device))
        return len(self.faces) > start

    def shape_terms(self, vertices: Tensor, weights: Mapping[str, float]) -> dict[str, Tensor]:
        """Those regularisers that have a weight, free of units: lengths in median edges."""
        terms = {}
        if weights["laplacian"]:
            squared = mesh_losses.laplacian(vertices, self.sides.edges)
            terms["laplacian"] = (squared / self.edge_m**2 + 1e-8).sqrt().mean()
        if weights["normal_consistency"]:
            faces = self.faces.long()
            terms["normal_consistency"] = mesh_losses.normal_consistency(vertices, faces, self.sides.pairs).mean()
        if weights["edge_length"]:
            terms["edge_length"] = (mesh_losses.edge_length(vertices, self.sides.edges) / self.edge_m**2).mean()
        return terms
