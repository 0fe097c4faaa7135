"""The points that a frame may have inside it, without projecting all points of a flight into every frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from overfly.geometry import Array, Camera

GROUP = 128
"""Points in a group, about."""


class Groups:
    """Points [M, 3] in groups that lie together in plan, each in a sphere; whole groups are left out of a frame."""

    def __init__(self, points: Array) -> None:
        self.points = np.asarray(points, float)
        self._order = np.zeros(0, np.int64)
        if not len(self.points):
            return
        # Strips of whole groups from west to east, each cut into groups from south to north.
        rank = np.empty(len(self.points), np.int64)
        rank[np.argsort(self.points[:, 0], kind="stable")] = np.arange(len(rank))
        strip = rank // (GROUP * max(1, round(np.sqrt(len(rank) / GROUP))))
        self._order = np.lexsort((self.points[:, 1], strip))
        self._starts = np.arange(0, len(self.points), GROUP)
        ordered = self.points[self._order]
        low = np.minimum.reduceat(ordered, self._starts)
        high = np.maximum.reduceat(ordered, self._starts)
        self._centres, self._radii = (low + high) / 2, np.linalg.norm(high - low, axis=1) / 2

    def near(self, camera: Camera, world_from_camera: Array) -> NDArray[np.int64]:
        """Ascending numbers of points, among them all that the undistorted camera has inside its image."""
        if not len(self.points):
            return np.zeros(0, np.int64)
        local = (self._centres - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]
        # Inward normals of the four planes through the camera and a side of the image, and of the image plane.
        left, right = -camera.cx / camera.fx, (camera.width - camera.cx) / camera.fx
        top, bottom = -camera.cy / camera.fy, (camera.height - camera.cy) / camera.fy
        planes = np.array([[1, 0, -left], [-1, 0, right], [0, 1, -top], [0, -1, bottom], [0, 0, 1.0]])
        planes /= np.linalg.norm(planes, axis=1, keepdims=True)
        groups = np.flatnonzero((local @ planes.T >= -self._radii[:, None] * (1 + 1e-9)).all(1))
        at = (self._starts[groups][:, None] + np.arange(GROUP)).ravel()
        return np.sort(self._order[at[at < len(self._order)]])
