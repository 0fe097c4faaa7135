"""Small meshes and cameras for the tests of the renderer."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
import trimesh
from torch import Tensor

from overfly.geometry import look_at
from overfly.rendering import Topology, Views, topology


class Solid(NamedTuple):
    """A solid in front of a plane: vertices [V, 3] (the plane's four last), colours [V, 3], float64."""

    vertices: Tensor
    colors: Tensor
    topology: Topology


def make_solid(kind: str, seed: int = 0) -> Solid:
    """A "sphere" or a slanted "box" of about one unit, reddish, over a bluish ground at z = -1.3."""
    rng = np.random.default_rng(seed)
    if kind == "sphere":
        mesh = trimesh.creation.icosphere(3)
    else:
        mesh = trimesh.creation.box(extents=(1.2, 1.2, 1.2))
        mesh.apply_transform(trimesh.transformations.rotation_matrix(0.4, [1, 2, 0.5]))
    ground = np.array([[-4.0, -4, -1.3], [4, -4, -1.3], [4, 4, -1.3], [-4, 4, -1.3]])
    faces = np.concatenate([mesh.faces, len(mesh.vertices) + np.array([[0, 1, 2], [0, 2, 3]])])
    warm = [0.7, 0.5, 0.3] + 0.15 * mesh.vertices[:, ::-1] + 0.02 * rng.random((len(mesh.vertices), 3))
    cold = [0.1, 0.2, 0.5] + 0.1 * rng.random((4, 3))
    vertices = np.concatenate([mesh.vertices, ground])
    return Solid(torch.tensor(vertices), torch.tensor(np.concatenate([warm, cold])), topology(faces, len(vertices)))


def make_views(
    count: int, size: tuple[int, int] = (48, 40), scale: int = 1, dtype: torch.dtype = torch.float64
) -> Views:
    """Cameras around the origin, four units away, looking down at it; ``scale`` times the pixels, too."""
    poses = [
        np.linalg.inv(look_at([2.6 * np.cos(a), 2.6 * np.sin(a), 3.2], [0.1, 0, 0]))
        for a in 0.3 + 0.7 * np.arange(count)
    ]
    width, height = size
    k = torch.tensor([[1.2 * width, 0, width / 2], [0, 1.25 * width, height / 2], [0, 0, 1]], dtype=dtype)
    k[:2] *= scale
    return Views(k.repeat(count, 1, 1), torch.tensor(np.array(poses), dtype=dtype), (width * scale, height * scale))


def looking_along_z(size: tuple[int, int] = (16, 16), focal: float = 16.0) -> Views:
    """One camera at the origin whose axes are those of the vertices."""
    width, height = size
    k = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return Views(k[None], torch.eye(4)[None], size)
