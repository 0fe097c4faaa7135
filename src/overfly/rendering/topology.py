"""Which triangles of a mesh lie side by side: computed once, it holds however the vertices move."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from overfly.errors import InputError


class Topology(NamedTuple):
    """The connections of a triangle mesh with F faces; all tensors on one device.

    Side k of a face is the one opposite its corner k: from corner (k + 1) % 3 to corner (k + 2) % 3.

    Attributes:
        faces: [F, 3] int32 vertex indices.
        neighbours: [F, 3] int32, the face across side k; -1 without one.
        edges: [E, 2] int64, every edge once, lower vertex index first.
        pairs: [P, 2] int64, the two faces of every edge that has two.
        vertex_count: V.
    """

    faces: Tensor
    neighbours: Tensor
    edges: Tensor
    pairs: Tensor
    vertex_count: int

    def to(self, device: torch.device | str) -> Topology:
        """The same on another device."""
        parts = (self.faces, self.neighbours, self.edges, self.pairs)
        faces, neighbours, edges, pairs = (part.to(device) for part in parts)
        return Topology(faces, neighbours, edges, pairs, self.vertex_count)


def topology(faces: NDArray[np.integer] | Tensor, count_of_vertices: int) -> Topology:
    """The connections of faces [F, 3], on the device of ``faces`` (CPU for an array).

    A face that names a vertex twice has no area: it is kept, but has neither edges nor neighbours. Winding may differ.

    Raises:
        InputError: an index is out of range, or more than two faces share an edge.
    """
    device = faces.device if isinstance(faces, Tensor) else torch.device("cpu")
    corners = np.asarray(faces.detach().cpu() if isinstance(faces, Tensor) else faces).astype(np.int64)
    if not corners.size:
        corners = corners.reshape(0, 3)
    if corners.ndim != 2 or corners.shape[1] != 3:
        raise InputError(f"Faces have the shape {tuple(corners.shape)}: give triangles, [F, 3] vertex indices.")
    wrong = (corners < 0) | (corners >= count_of_vertices)
    if wrong.any():
        raise InputError(
            f"{int(wrong.any(1).sum())} faces name vertices outside 0 to {count_of_vertices - 1}: "
            "give the faces that belong to these vertices."
        )
    ends = np.sort(np.stack([corners[:, [1, 2]], corners[:, [2, 0]], corners[:, [0, 1]]], axis=1), axis=2)  # [F, 3, 2]
    proper = (ends[:, :, 0] != ends[:, :, 1]).all(1)
    side = (3 * np.flatnonzero(proper)[:, None] + np.arange(3)).ravel()  # face * 3 + k
    key = ends.reshape(-1, 2)[side] @ np.array([count_of_vertices, 1])
    order = np.argsort(key, kind="stable")
    key, side = key[order], side[order]
    first = np.flatnonzero(np.diff(key, prepend=-1))
    uses = np.diff(first, append=len(key))
    if (uses > 2).any():
        raise InputError(
            f"{int((uses > 2).sum())} edges are shared by more than two faces: split the mesh there, so that every "
            "edge has one face or two."
        )
    shared = first[uses == 2]
    one, other = side[shared], side[shared + 1]
    neighbours = np.full(3 * len(corners), -1, np.int32)
    neighbours[one], neighbours[other] = other // 3, one // 3

    def put(array: NDArray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(device)

    return Topology(
        faces=put(corners.astype(np.int32)),
        neighbours=put(neighbours.reshape(-1, 3)),
        edges=put(np.stack(np.divmod(key[first], max(count_of_vertices, 1)), axis=1)),
        pairs=put(np.stack([one, other], axis=1) // 3),
        vertex_count=count_of_vertices,
    )
