"""Losses of a mesh's shape: pure, differentiable, one value per vertex, edge or pair of faces.

Vertices are [V, 3] in metres. Edges [E, 2] and faces [F, 3] hold int64 indices of vertices; no edge stands there twice.
"""

from __future__ import annotations

import torch
from torch import Tensor


def laplacian(vertices: Tensor, edges: Tensor) -> Tensor:
    """Squared distance of every vertex to the mean of its neighbours (the uniform umbrella operator).

    Zero where a vertex lies amid its neighbours, as on an evenly meshed plane; at an open border it pulls inwards.

    Returns:
        [V], square metres; 0 for vertices without an edge.
    """
    a, b = edges.unbind(1)
    difference = vertices.index_select(0, b) - vertices.index_select(0, a)  # [E, 3]
    total = torch.zeros_like(vertices).index_add(0, a, difference).index_add(0, b, -difference)
    count = torch.bincount(edges.flatten(), minlength=len(vertices)).clamp(min=1).to(vertices.dtype)
    return (total / count[:, None]).square().sum(1)


def normal_consistency(vertices: Tensor, faces: Tensor, pairs: Tensor) -> Tensor:
    """1 - cosine of the angle between the normals of adjacent faces.

    Args:
        vertices: [V, 3].
        faces: [F, 3], oriented alike (counter-clockwise seen from outside).
        pairs: the two faces at each inner edge, indices [P, 2].

    Returns:
        [P], 0 (flat) to 2 (folded); 0, without gradient, where a face has no area (below 1e-10 square metres).
    """
    a, b, c = (vertices.index_select(0, corner) for corner in faces.unbind(1))
    normals = torch.linalg.cross(b - a, c - a)  # [F, 3], twice the area long
    squared = normals.square().sum(1)
    sound = squared > (2e-10) ** 2
    normals = normals / torch.where(sound, squared, 1.0).sqrt()[:, None]
    first, second = pairs.unbind(1)
    cosine = (normals.index_select(0, first) * normals.index_select(0, second)).sum(1)
    return torch.where(sound[first] & sound[second], 1 - cosine, 0.0)


def edge_length(vertices: Tensor, edges: Tensor) -> Tensor:
    """Squared length of every edge [E], square metres; its variation over the mesh tells how even the meshing is."""
    a, b = edges.unbind(1)
    return (vertices.index_select(0, b) - vertices.index_select(0, a)).square().sum(1)
