"""The true surface of a scene as a measure: exact distances to its triangles, and exact counts of who sees what.

Nothing is sampled, so the spacing of a reference cloud has no part in the distances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from overfly.flights.reference import seen
from overfly.geometry import Array, Camera
from overfly.scenes import Renderer, Scene

REACH_M = 50.0
"""Farther from every surface than this, a point's distance is infinite."""

FINER = 4
"""Visibility is judged on depth maps with so many times the image's pixels, one of them is the tolerance at edges."""


@wp.kernel
def find_nearest(
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    reach: wp.float32,
    place: wp.array(dtype=wp.vec3),
    rise: wp.array(dtype=wp.float32),
    upward: wp.array(dtype=wp.float32),
):
    i = wp.tid()
    point = points[i]
    query = wp.mesh_query_point_no_sign(mesh, point, reach)
    if query.result:
        place[i] = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
        upward[i] = wp.abs(wp.mesh_eval_face_normal(mesh, query.face)[2])
    for side in range(2):
        ray = wp.mesh_query_ray(mesh, point, wp.vec3(0.0, 0.0, 1.0 - 2.0 * wp.float32(side)), reach)
        if ray.result:
            rise[i] = wp.min(rise[i], ray.t)


@dataclass(frozen=True)
class Nearest:
    """The surface nearest to each point.

    Attributes:
        place: [N, 3] nearest point of the surface, metres; NaN where none is within reach.
        distance: [N] to it, metres; inf where there is none.
        rise: [N] to the nearest surface straight above or below, metres; inf where there is none.
        upward: [N] cosine of the nearest triangle's slope: 1 is level, 0 a wall.
    """

    place: Array
    distance: Array
    rise: Array
    upward: Array


class Surface:
    """All triangles of a scene."""

    def __init__(self, scene: Scene) -> None:
        self.renderer = Renderer(scene)
        vertices = wp.array(scene.vertices.astype(np.float32), dtype=wp.vec3, device="cpu")
        self.mesh = wp.Mesh(vertices, wp.array(scene.faces.ravel(), dtype=wp.int32, device="cpu"))

    def nearest(self, points: Array) -> Nearest:
        """Where the surface is nearest to each of the points [N, 3]."""
        count = len(points)
        place = wp.full(count, wp.vec3(np.nan, np.nan, np.nan), dtype=wp.vec3, device="cpu")
        rise = wp.full(count, np.inf, dtype=wp.float32, device="cpu")
        upward = wp.zeros(count, dtype=wp.float32, device="cpu")
        asked = wp.array(points.astype(np.float32), dtype=wp.vec3, device="cpu")
        inputs = [self.mesh.id, asked, REACH_M, place, rise, upward]
        wp.launch(find_nearest, dim=count, inputs=inputs, device="cpu")
        found = place.numpy().astype(np.float64)
        distance = np.linalg.norm(found - points, axis=1)
        return Nearest(found, np.where(np.isnan(distance), np.inf, distance), rise.numpy(), upward.numpy())

    def count_views(self, points: Array, cameras: Sequence[Camera], poses: Sequence[Array]) -> NDArray[np.int64]:
        """The number of frames that see each of the surface's points [N, 3]: inside the image, nothing before them."""
        count = np.zeros(len(points), np.int64)
        for camera, pose in zip(cameras, poses, strict=True):
            fine = camera.resized(FINER * camera.width, FINER * camera.height)
            count += seen(points, self.renderer.depth(fine, pose), fine, pose)
        return count
