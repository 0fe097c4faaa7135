"""Where frames look: footprints on a ground plane, their overlaps, and the choice of the frames of a window."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

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
    altitude = pose[2, 3] - ground_height
    w, h = camera.width, camera.height
    directions = rays([[0, 0], [w, 0], [w, h], [0, h]], camera) @ pose[:3, :3].T  # [4, 3]
    if altitude <= 0 or (directions[:, 2] >= 0).all():
        return np.full((4, 2), np.nan)
    flat = np.linalg.norm(directions[:, :2], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        on_ground = np.where(directions[:, 2] < 0, altitude / -directions[:, 2], np.inf)
        at_reach = np.where(flat > 0, reach * altitude / flat, np.inf)
    return pose[:2, 3] + directions[:, :2] * np.minimum(on_ground, at_reach)[:, None]


def area(polygon: ArrayLike) -> float:
    """The area of a polygon [n, 2] (shoelace formula); 0 for NaN or fewer than three corners."""
    points = np.asarray(polygon, float)
    if len(points) < 3 or not np.isfinite(points).all():
        return 0.0
    x, y = (points - points[0]).T  # against cancellation at large coordinates
    return float(abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2)


def intersection(polygon: ArrayLike, convex: ArrayLike) -> Array:
    """The part of ``polygon`` [n, 2] inside the ``convex`` polygon [m, 2]: corners [k, 2], k = 0 where apart.

    Sutherland and Hodgman, "Reentrant polygon clipping" (1974).
    """
    clip = np.asarray(convex, float)
    x, y = (clip - clip[0]).T
    if np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)) < 0:
        clip = clip[::-1]  # counter-clockwise
    corners = [tuple(p) for p in np.asarray(polygon, float).tolist()]
    edges = clip.tolist()
    for (ax, ay), (bx, by) in zip(edges, edges[1:] + edges[:1], strict=True):
        kept: list[tuple[float, float]] = []
        side = [(bx - ax) * (py - ay) - (by - ay) * (px - ax) for px, py in corners]
        for i, (point, s) in enumerate(zip(corners, side, strict=True)):
            before, s_before = corners[i - 1], side[i - 1]
            if (s >= 0) != (s_before >= 0):
                t = s_before / (s_before - s)
                kept.append((before[0] + t * (point[0] - before[0]), before[1] + t * (point[1] - before[1])))
            if s >= 0:
                kept.append(point)
        corners = kept
        if not corners:
            break
    return np.array(corners, float).reshape(-1, 2)


def ground_overlaps(footprints: ArrayLike) -> Array:
    """Share of footprint i that lies inside footprint j.

    Args:
        footprints: [n, 4, 2] convex outlines, see :func:`footprint`; NaN sees nothing.

    Returns:
        [n, n] in 0..1, 1 on the diagonal; symmetric only where the footprints have equal areas.
    """
    outlines = np.asarray(footprints, float)
    areas = np.array([area(p) for p in outlines])
    low, high = outlines.min(1), outlines.max(1)
    with np.errstate(invalid="ignore"):
        near = ((low[:, None] < high[None]) & (low[None] < high[:, None])).all(-1)
    overlaps = np.eye(len(outlines))
    for i, j in np.argwhere(np.triu(near, 1)):
        common = area(intersection(outlines[i], outlines[j]))
        if common > 0:
            overlaps[i, j], overlaps[j, i] = common / areas[i], common / areas[j]
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
