"""A knoll whose height and colour are known everywhere, six small photographs of it, and a flat mesh to refine."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from overfly.cloud import Cloud, write_cloud
from overfly.flights import Frame, write_flight
from overfly.geometry import Array, Camera, on_plane, pixel_grid, pose, rays, rotation_from_gimbal
from overfly.mesh import Mesh, write_mesh

KNOWN_WARNINGS = [
    pytest.mark.filterwarnings("ignore:.*isinstance.treespec, LeafSpec:FutureWarning"),
    pytest.mark.filterwarnings("ignore:.*isinstance.treespec, LeafSpec:DeprecationWarning"),
    pytest.mark.filterwarnings("ignore:.*does not have many workers"),
    pytest.mark.filterwarnings("ignore:.*module.s. in eval mode at the start of training"),
    pytest.mark.filterwarnings("ignore:Checkpoint directory .* exists and is not empty"),
]
"""Of Lightning, in a training through the real command."""

CAMERA = Camera(96, 64, 96.0, 96.0, 48.0, 32.0)
ALTITUDE = 40.0
SHIFT = np.array([1000.0, -500.0, 200.0])
"""Where the knoll stands in the frame of the cameras."""


class Photographed(NamedTuple):
    """What a refinement is given, and the truth."""

    flight: Path
    mesh: Path
    reference: Path
    frames: list[Frame]


def height(xy: Array) -> Array:
    """Metres: a knoll of 2 m."""
    return np.asarray(2.0 * np.exp(-(xy**2).sum(-1) / (2 * 6.0**2)))


def color(xy: Array) -> Array:
    """[..., 3] in 0..1: waves of 3 to 12 m, the same from everywhere."""
    rng = np.random.default_rng(2)
    turn, phase = rng.uniform(0, 2 * np.pi, (2, 3, 12))
    number = 2 * np.pi / np.geomspace(3, 12, 12)
    angle = xy[..., :1, None] * (number * np.cos(turn)) + xy[..., 1:, None] * (number * np.sin(turn)) + phase
    return np.asarray(0.5 + 0.12 * np.sin(angle).sum(-1)).clip(0, 1)


def photograph(camera: Camera, world_from_camera: Array, supersample: int = 2) -> np.ndarray:
    """[H, W, 3] uint8 of the knoll at the frame's zero."""
    fine = camera.resized(camera.width * supersample, camera.height * supersample)
    pixels = pixel_grid(fine.width, fine.height)
    direction = rays(pixels, fine) @ world_from_camera[:3, :3].T
    centre = world_from_camera[:3, 3]
    points = on_plane(pixels, fine, world_from_camera, 0.0)
    for _ in range(20):
        points = centre + direction * ((height(points[..., :2]) - centre[2]) / direction[..., 2])[..., None]
    small = color(points[..., :2]).reshape(camera.height, supersample, camera.width, supersample, 3).mean((1, 3))
    return np.rint(small * 255).astype(np.uint8)


def flat_mesh(cell: float = 2.0, *, colored: bool = True, half: tuple[float, float] = (22.0, 16.0)) -> Mesh:
    """The ground without its knoll, in the knoll's own frame, in the colours of its vertices."""
    x, y = (np.arange(-h, h + cell / 2, cell) for h in half)
    xy = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    corner = (np.arange(len(y) - 1)[:, None] * len(x) + np.arange(len(x) - 1)).ravel()
    quads = np.stack([corner, corner + 1, corner + len(x) + 1, corner + len(x)], 1)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32)
    colors = np.rint(color(xy) * 255).astype(np.uint8) if colored else None
    return Mesh(np.c_[xy, np.zeros(len(xy))], faces, colors)


def moved(mesh: Mesh) -> Mesh:
    """Into the frame of the cameras."""
    return Mesh(mesh.vertices + SHIFT, mesh.faces, mesh.colors)


def make_photographed(folder: Path, *, cell: float = 2.0, count: int = 6, colored: bool = True) -> Photographed:
    """Write flight, rough mesh and reference: two strips of three photographs, 80 % forward overlap."""
    places = [(x, y) for y in (-3.0, 3.0) for x in (-6.0, 0.0, 6.0)][:count]
    own = [pose(rotation_from_gimbal(0, -90, 0), [x, y, ALTITUDE]) for x, y in places]
    images = [photograph(CAMERA, p) for p in own]
    given = [pose(p[:3, :3], p[:3, 3] + SHIFT) for p in own]
    frames = write_flight(folder / "flight", images, [CAMERA] * count, given)
    write_mesh(moved(flat_mesh(cell, colored=colored)), folder / "rough.ply")
    xy = np.random.default_rng(1).uniform([-18, -12], [18, 12], (20_000, 2))
    write_cloud(Cloud(np.c_[xy, height(xy)] + SHIFT), folder / "truth.ply")
    return Photographed(folder / "flight", folder / "rough.ply", folder / "truth.ply", frames)
