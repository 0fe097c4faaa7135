"""Where frames look: footprints on a ground plane, their overlaps, and the choice of the frames of a window."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from overfly.flights.footprint import meet_ground, polygons
from overfly.geometry import Array, Camera, pixel_grid, project, rays

REACH = 4.0
"""Footprints end at this multiple of the altitude, where a camera looks to the horizon."""


def footprint(camera: Camera, world_from_camera: ArrayLike, ground_height: float, reach: float = REACH) -> Array:
    """The image's outline on the plane z = ``ground_height``.

    Args:
        camera: its lens distortion is honoured at the four corners, edges are taken as straight.
        world_from_camera: [4, 4].
        ground_height: metres, in the world's z.
        reach: rays to and over the horizon end at ``reach`` x altitude from the camera.

    Returns:
        World x, y [4, 2] of the image's top left, top right, bottom right, bottom left corner; all NaN where the
        camera stands under the plane or sees nothing of it.
    """
    pose = np.asarray(world_from_camera, float)
    w, h = camera.width, camera.height
    directions = rays([[0, 0], [w, 0], [w, h], [0, h]], camera) @ pose[:3, :3].T  # [4, 3]
    if pose[2, 3] <= ground_height or (directions[:, 2] >= 0).all():
        return np.full((4, 2), np.nan)
    origins = np.broadcast_to(pose[:3, 3], directions.shape)
    level = (ground_height, ground_height)
    return meet_ground(origins, directions, lambda xy: np.full(len(xy), ground_height), level, reach)[:, :2]


def ground_overlaps(footprints: ArrayLike) -> Array:
    """Share of footprint i that lies inside footprint j.

    Args:
        footprints: [n, 4, 2] outlines, see :func:`footprint`; NaN sees nothing.

    Returns:
        [n, n] in 0..1, 1 on the diagonal; symmetric only where the footprints have equal areas.
    """
    outlines = np.asarray(footprints, float)
    seeing = np.flatnonzero(np.isfinite(outlines).all((1, 2)))
    shapes = polygons(outlines[seeing])
    overlaps = np.eye(len(outlines))
    if len(seeing):
        a, b = shapely.STRtree(shapes).query(shapes, predicate="intersects")
        overlaps[seeing[a], seeing[b]] = shapely.area(shapely.intersection(shapes[a], shapes[b])) / shapely.area(
            shapes[a]
        )
        overlaps[np.diag_indices(len(outlines))] = 1
    return np.clip(overlaps, 0, 1)


def sees(points: ArrayLike, camera: Camera, world_from_camera: ArrayLike) -> NDArray[np.bool_]:
    """Whether world points [..., 3] fall inside the image (occlusion ignored) [...]."""
    # The lens polynomial folds far outside the image back into it: the ideal ray must also stay in the field of view.
    ideal, _ = project(points, camera.undistorted(), world_from_camera)
    with np.errstate(invalid="ignore"):
        size = np.array([camera.width, camera.height])
        wide = (np.abs(ideal - size / 2) < size).all(-1)
        if not camera.is_distorted:
            return np.asarray(((ideal >= 0) & (ideal < size)).all(-1))
        pixels, _ = project(points, camera, world_from_camera)
        return np.asarray(wide & ((pixels >= 0) & (pixels < size)).all(-1))


def choose_frames(
    reference: int,
    count: int,
    cameras: Sequence[Camera],
    world_from_camera: ArrayLike,
    ground_height: float,
    *,
    samples: int = 12,
    base_to_height: tuple[float, float] = (0.3, 0.9),
) -> list[int]:
    """The frames of a window: the reference and those that best see its ground from elsewhere, also across strips.

    Greedy: each next frame is the one that adds most to the ground of the reference frame that is seen again (a second
    sight of a cell counts 0.3, a third 0.1), weighed by its base-to-height ratio.

    Args:
        reference: index of the reference frame.
        count: frames wanted, K.
        cameras: n cameras.
        world_from_camera: [n, 4, 4].
        ground_height: metres.
        samples: side of the sample grid on the reference's image.
        base_to_height: the range in which a base is best: shorter ones measure height worse, longer ones match worse.

    Returns:
        Indices, the reference first; fewer than ``count`` where no other frame sees this ground.
    """
    poses = np.asarray(world_from_camera, float)
    cells = ground_samples(cameras[reference], poses[reference], ground_height, samples)
    altitude = max(poses[reference, 2, 3] - ground_height, 1e-9)
    bases = np.linalg.norm(poses[:, :3, 3] - poses[reference, :3, 3], axis=1) / altitude
    low, high = base_to_height
    quality = np.minimum(np.clip(bases / low, 0, 1), np.clip(high / np.maximum(bases, 1e-9), 0, 1))
    # A frame further away than two reaches cannot see the same ground.
    candidates = [i for i in np.flatnonzero((bases > 1e-6) & (bases < 2 * REACH)).tolist() if i != reference]
    seen_by = {i: sees(cells, cameras[i], poses[i]) for i in candidates}
    chosen, times = [reference], np.zeros(len(cells), int)
    worth = np.array([1.0, 0.3, 0.1, 0.03])
    while len(chosen) < count:
        best, best_gain = -1, 0.0
        for i in candidates:
            gain = quality[i] * worth[np.minimum(times, 3)][seen_by[i]].sum()
            if i not in chosen and gain > best_gain:
                best, best_gain = i, float(gain)
        if best < 0:
            break
        chosen.append(best)
        times = times + seen_by[best]
    return chosen


def ground_samples(camera: Camera, world_from_camera: ArrayLike, ground_height: float, samples: int = 12) -> Array:
    """Ground points [m, 3] under a regular grid of image points; those beyond :data:`REACH` are left out."""
    pose = np.asarray(world_from_camera, float)
    altitude = pose[2, 3] - ground_height
    pixels = (pixel_grid(samples, samples) / samples * [camera.width, camera.height]).reshape(-1, 2)
    directions = rays(pixels, camera) @ pose[:3, :3].T
    directions = directions[directions[:, 2] < 0]
    points = pose[:3, 3] + directions * (altitude / -directions[:, 2:])
    near = np.linalg.norm(points[:, :2] - pose[:2, 3], axis=1) <= REACH * altitude
    return points[near]
