"""The reference cloud of a synthetic flight: points of the true surface that at least one frame sees."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import is_dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from overfly.cloud import Cloud
from overfly.errors import InputError
from overfly.flights.footprint import border_pixels
from overfly.geometry import Array, Camera, project, rays

if TYPE_CHECKING:
    from overfly.scenes import Scene

TOLERANCE_M = 0.05
ROUNDS = 6


def seen(points: Array, depth: NDArray[np.float32], camera: Camera, pose: Array) -> NDArray[np.bool_]:
    """Whether points [n, 3] lie in the image and nothing stands before them, up to one pixel at silhouettes."""
    near_image = project(points, camera.undistorted(), pose)[0] / [camera.width, camera.height]
    pixels, z = project(points, camera, pose)
    with np.errstate(invalid="ignore"):
        # The lens polynomial folds far points back into the image: the ideal ray must stay close to it, too.
        inside = ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(-1)
        inside &= (np.abs(near_image - 0.5) < 1).all(-1)
    index = np.flatnonzero(inside)
    column, row = np.floor(pixels[index]).astype(int).T
    furthest = maximum_filter(depth, size=3)[row, column]
    result = np.zeros(len(points), bool)
    result[index] = z[index] <= furthest + TOLERANCE_M
    return result


def reference_cloud(
    scene: Scene,
    camera: Camera,
    world_from_camera: Array,
    depth: Callable[[Array], NDArray[np.float32]],
    box: tuple[float, float, float, float],
    n: int,
    rng: np.random.Generator,
    progress: Callable[[Iterable], Iterable] = iter,
) -> Cloud:
    """About ``n`` points, uniform by area on the surfaces that the frames see, walls included.

    Args:
        scene: sampled inside ``box`` only.
        world_from_camera: [m, 4, 4].
        depth: depth map [H, W] of a pose.
        box: x_min, y_min, x_max, y_max of all footprints.
        n: points wanted.
        rng: of the samples.
        progress: wraps the loop over frames.

    Raises:
        InputError: the flight sees nothing of the scene.
    """
    part = _within(scene, box)
    points, colors = part.sample(2 * n, rng)
    inside = ((points[:, :2] >= box[:2]) & (points[:, :2] <= box[2:])).all(-1)
    points, colors = points[inside], colors[inside]
    visible = np.zeros(len(points), bool)
    for pose in progress(world_from_camera):
        open_ = np.flatnonzero(~visible)
        if not len(open_):
            break
        shown = depth(pose)
        away = np.abs(points[open_, :2] - pose[:2, 3]).max(1)
        open_ = open_[away <= _reach(shown, camera)]  # of a long flight most points are far from any one frame
        visible[open_[seen(points[open_], shown, camera, pose)]] = True
    points, colors = points[visible], colors[visible]
    if not len(points):
        raise InputError(f"The flight sees nothing of the scene {scene.name}: choose an area inside it.")
    return Cloud(points=points[:n], colors=colors[:n])


def _reach(depth: NDArray[np.float32], camera: Camera) -> float:
    """How far away the farthest thing is that a frame shows; infinite where it shows the sky."""
    corners = rays(border_pixels(camera), camera)
    farthest = float(np.linalg.norm(corners, axis=1).max())  # NaN where the lens has no ray for a corner
    reach = (float(depth.max(initial=0.0)) + TOLERANCE_M) * farthest
    return reach if np.isfinite(reach) else float("inf")


def _within(scene: Any, box: tuple[float, float, float, float]) -> Any:
    """The scene with its extent cut to ``box``, so that samples are not wasted beside the flight."""
    x0, y0, x1, y1 = scene.extent
    cut = (max(x0, box[0]), max(y0, box[1]), min(x1, box[2]), min(y1, box[3]))
    if not is_dataclass(scene) or cut[0] >= cut[2] or cut[1] >= cut[3]:
        return scene
    return replace(scene, extent=cut)  # type: ignore[type-var]
