"""How good a mesh is: the shape against a true cloud, within the ground that the rough mesh covers."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from overfly.cloud import Cloud
from overfly.errors import InputError
from overfly.mesh import Mesh
from overfly.metrics.functional import distances

SAMPLES = 200_000
"""Points drawn from a mesh to measure it."""

CELL_M = 2.0
"""Side of the plan cells by which the covered ground is told, metres."""

THRESHOLD_M = 0.5


class ShapeMeasure:
    """Distances between meshes and the true surface, over the ground that a first mesh covers.

    Args:
        truth: points on the true surface, in the meshes' frame.
        mesh: true points outside the plan cells in which it has some of its surface do not count, now and later.

    Raises:
        InputError: the mesh covers none of the true points.
    """

    def __init__(self, truth: Cloud, mesh: Mesh) -> None:
        surface = np.concatenate([mesh.vertices, mesh.sample(SAMPLES, np.random.default_rng(0)).points])[:, :2]
        low = surface.min(0)
        cells = np.floor((surface - low) / CELL_M).astype(np.int64)
        covered = np.zeros(cells.max(0) + 1, bool)
        covered[tuple(cells.T)] = True
        places = np.floor((truth.points[:, :2] - low) / CELL_M).astype(np.int64)
        inside = ((places >= 0) & (places < covered.shape)).all(1)
        inside[inside] = covered[tuple(places[inside].T)]
        if not inside.any():
            raise InputError(
                "The reference cloud and the mesh cover no common ground: give both in the frame of the cameras."
            )
        self.truth: NDArray[np.float64] = truth.points[inside]

    def __call__(self, vertices: ArrayLike, faces: ArrayLike) -> dict[str, float]:
        """Chamfer distance (mean, both directions added), F-score, median distances; of points uniform by area."""
        mesh = Mesh(np.asarray(vertices, np.float64), np.asarray(faces, np.int32))
        points = mesh.sample(SAMPLES, np.random.default_rng(0)).points
        found = distances(points, self.truth)
        return {
            "chamfer_m": found.chamfer_m,
            "chamfer_m2": found.chamfer_m2,
            f"fscore_{THRESHOLD_M:g}m": found.fscore(THRESHOLD_M),
            "accuracy_m": found.accuracy_m(),
            "completeness_m": found.completeness_m(),
        }
