"""Which frames see which points of a cloud, and the colours they give them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from overfly.data.footprints import sees
from overfly.geometry import Camera, invert, project, transform

Image = NDArray[np.uint8]


class View(Protocol):
    """A frame with its camera, as :class:`overfly.flights.Frame`."""

    @property
    def camera(self) -> Camera | None: ...

    @property
    def world_from_camera(self) -> NDArray | None: ...

    def image(self) -> Image: ...


def count_views(points: NDArray, views: Sequence[View]) -> NDArray[np.int64]:
    """The number of frames that see each point [N]: inside the image and not behind other points.

    Occlusion is tested on a coarse z-buffer of the points themselves, about two points a cell.
    """
    seen = np.zeros(len(points), np.int64)
    for view in views:
        camera, world_from_camera = view.camera, view.world_from_camera
        assert camera is not None
        assert world_from_camera is not None
        inside = np.flatnonzero(sees(points, camera, world_from_camera))
        if not len(inside):
            continue
        pixels, depth = project(points[inside], camera, world_from_camera)
        side = max(1.0, np.sqrt(2 * camera.width * camera.height / len(inside)))
        columns = int(camera.width / side) + 1
        column, row = (pixels // side).astype(np.int64).T
        cell = row * columns + column
        nearest = np.full(cell.max() + 1, np.inf)
        np.minimum.at(nearest, cell, depth)
        slack = 3 * side / camera.fx * depth  # within a cell, steep ground may differ by its width
        seen[inside[depth <= nearest[cell] + slack]] += 1
    return seen


def colorize(points: NDArray, views: Sequence[View], owners: NDArray) -> NDArray[np.uint8]:
    """The colour of each point [N, 3] from its owner frame, else from the frame that sees it nearest to the middle.

    Each image is read once.
    """
    best = np.full(len(points), -1)
    off_centre = np.full(len(points), np.inf)
    for index, view in enumerate(views):
        camera, world_from_camera = view.camera, view.world_from_camera
        assert camera is not None
        assert world_from_camera is not None
        inside = np.flatnonzero(sees(points, camera, world_from_camera))
        local = transform(invert(world_from_camera), points[inside])
        distance = np.hypot(local[:, 0], local[:, 1]) / local[:, 2]
        distance = np.where(owners[inside] == index, -1.0, distance)
        closer = distance < off_centre[inside]
        best[inside[closer]], off_centre[inside[closer]] = index, distance[closer]
    colors = np.zeros((len(points), 3), np.uint8)
    for index in np.unique(best[best >= 0]).tolist():
        view, mine = views[index], np.flatnonzero(best == index)
        assert view.camera is not None
        assert view.world_from_camera is not None
        pixels, _ = project(points[mine], view.camera, view.world_from_camera)
        image = view.image()
        row = np.clip(pixels[:, 1].astype(int), 0, image.shape[0] - 1)
        column = np.clip(pixels[:, 0].astype(int), 0, image.shape[1] - 1)
        colors[mine] = image[row, column]
    return colors
