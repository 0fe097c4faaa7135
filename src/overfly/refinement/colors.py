"""Colours of a mesh from the photographs, and whether the two belong together."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import grid_sample

from overfly.data.photographs import Photographs
from overfly.errors import InputError
from overfly.mesh import Mesh
from overfly.rendering.render import Views, render
from overfly.rendering.topology import Topology

HIDDEN = 0.01
"""Share of its depth by which a vertex may lie behind what a photograph shows there."""

VALID = 0.999
"""Share of a colour that has to come from pixels that the photograph covers."""


def views_of(photographs: Photographs, chosen: NDArray) -> Views:
    """The cameras of some photographs."""
    return Views(
        torch.from_numpy(photographs.intrinsics[chosen]),
        torch.from_numpy(photographs.camera_from_local[chosen]),
        photographs.size,
    )


def check_overlap(mesh: Mesh, photographs: Photographs) -> None:
    """Refuse a mesh that the photographs do not show.

    Raises:
        InputError: fewer than one in a hundred vertices lies inside any photograph, with how far they miss.
    """
    width, height = photographs.size
    points = np.c_[mesh.vertices, np.ones(len(mesh.vertices))]
    seen, nearest = np.zeros(len(points), bool), np.inf
    for k, pose in zip(photographs.intrinsics, photographs.camera_from_local, strict=True):
        x, y, z = (points @ pose.T.astype(np.float64))[:, :3].T
        ahead = z > 0
        safe = np.where(ahead, z, 1.0)
        u, v = x / safe * k[0, 0] + k[0, 2], y / safe * k[1, 1] + k[1, 2]
        beside = np.maximum(np.maximum(-u, u - width), np.maximum(-v, v - height))
        seen |= ahead & (beside < 0)
        nearest = min(nearest, float(np.median(beside[ahead])) if ahead.any() else np.inf)
    if seen.mean() < 0.01:
        how = "lies behind every camera" if np.isinf(nearest) else f"misses the nearest by {nearest:,.0f} px (median)"
        raise InputError(
            f"The mesh and the photographs do not overlap: it {how}; give a mesh in the frame of the flight's "
            "cameras, or leave the mesh out to have one made."
        )


@torch.no_grad()
def colors_from(mesh: Mesh, topology: Topology, photographs: Photographs) -> NDArray[np.uint8]:
    """The mean colour at which the photographs that are not held out see each vertex [V, 3]; grey where none does."""
    vertices = torch.from_numpy(mesh.vertices).float()
    total, count = torch.zeros(len(vertices), 3), torch.zeros(len(vertices), 1)
    for index in np.flatnonzero(~photographs.held_out):
        view = views_of(photographs, np.array([index]))
        depth = render(vertices, torch.zeros_like(vertices), topology, view).depth.float()
        pose, k = view.camera_from_world[0], view.intrinsics[0]
        x, y, z = (vertices @ pose[:3, :3].T + pose[:3, 3]).unbind(1)
        safe = z.clamp(min=1e-3)
        size = torch.tensor(view.size)
        place = torch.stack([x / safe * k[0, 0] + k[0, 2], y / safe * k[1, 1] + k[1, 2]], 1) / size * 2 - 1
        grid = place[None, :, None]
        shown = grid_sample(depth[:, None], grid, mode="nearest", align_corners=False)[0, 0, :, 0]
        seen = (z > 0) & (place.abs() < 1).all(1) & (shown > 0) & (z - shown < HIDDEN * z)
        valid = torch.from_numpy(photographs.valid[index]).float()[None, None]
        seen &= grid_sample(valid, grid, align_corners=False)[0, 0, :, 0] > VALID
        image = torch.from_numpy(photographs.images[index])[None]
        found = grid_sample(image, grid, padding_mode="border", align_corners=False)[0, :, :, 0].T
        total += torch.where(seen[:, None], found, 0.0)
        count += seen[:, None]
    mean = torch.where(count > 0, total / count.clamp(min=1), 0.5)
    return (mean * 255).round().byte().numpy()
