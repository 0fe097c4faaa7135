"""Points on the surfaces of a scene."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from overfly.errors import InputError
from overfly.scenes.scene import Scene


def sample_faces(
    scene: Scene, n: int, rng: np.random.Generator
) -> tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.float64]]:
    """Draw ``n`` points uniformly by area from the faces within the scene's extent.

    Returns:
        Faces [n], barycentrics of the second and third vertex [n, 2], and points [n, 3] in metres.
    """
    corners = scene.vertices[scene.faces]  # [F, 3, 3]
    edges = corners[:, 1:] - corners[:, :1]
    areas = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    x_min, y_min, x_max, y_max = scene.extent
    middle = corners.mean(1)
    inside = (middle[:, 0] >= x_min) & (middle[:, 0] <= x_max) & (middle[:, 1] >= y_min) & (middle[:, 1] <= y_max)
    total = np.cumsum(np.where(inside, areas, 0.0))
    if not total[-1] > 0:
        raise InputError(f"The scene {scene.name} has no surface within its extent: nothing can be sampled.")
    face = np.searchsorted(total, rng.random(n) * total[-1], side="right").clip(0, len(total) - 1)
    weights = rng.random((n, 2))
    outside = weights.sum(1) > 1
    weights[outside] = 1 - weights[outside]
    points = corners[face, 0] + (weights[:, :, None] * edges[face]).sum(1)
    return face.astype(np.int32), weights.astype(np.float32), points
