"""Laying one cloud upon another before they are compared: always explicit, and the transform is always reported.

The search is a trimmed, symmetric point-to-plane ICP from several starts. The starts come from height maps: aerial
clouds of one place differ by metres in height (barometer, geoid) and in plan (GPS), which nearest neighbours alone do
not bridge. Everything is deterministic.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from overfly.cloud import voxel_thin
from overfly.errors import unknown
from overfly.geometry import invert, transform
from overfly.metrics.functional import PARALLEL_FROM, as_points

Array = NDArray[np.float64]

MODES = ("none", "shift", "rigid", "similarity")
"""Nothing; a translation; and a rotation; and a scale."""

KEPT = 0.7
"""Share of the pairs that count: the rest, the farthest, is taken as change, noise or missing coverage."""

COARSE_POINTS, FINE_POINTS = 6_000, 40_000


def align(cloud: Any, reference: Any, mode: str) -> tuple[Array, Array]:
    """Lay ``cloud`` upon ``reference``.

    ``shift`` bridges offsets of about a quarter of the extent, or any offset if the clouds do not overlap at all.
    ``rigid`` and ``similarity`` start from that shift and correct rotations of about 10 degrees and scales of about 5 %:
    a cloud without GPS, in a frame of its own, has to be brought near its place first.

    Args:
        cloud, reference: points [N, 3] and [M, 3].
        mode: one of ``MODES``.

    Returns:
        The transform reference-from-cloud [4, 4] and the transformed points [N, 3].

    Raises:
        InputError: the mode is unknown, or a cloud is empty, of another shape or not finite.
    """
    if mode not in MODES:
        raise unknown("The alignment", mode, MODES)
    points, target = as_points(cloud, "The cloud"), as_points(reference, "The reference")
    if mode == "none":
        return np.eye(4), points.copy()
    centre = np.round(np.median(target, axis=0))  # rotations about a far origin would lose digits
    found = _align(points - centre, target - centre, mode)
    away, back = np.eye(4), np.eye(4)
    away[:3, 3], back[:3, 3] = -centre, centre
    matrix = back @ found @ away
    return matrix, transform(found, points - centre) + centre


def _align(points: Array, target: Array, mode: str) -> Array:
    coarse = _Pair.thinned(points, target, COARSE_POINTS)
    # The shift comes first in every mode: a rotation must not make up for a wrong start.
    tried = [coarse.refine(start, "shift") for start in starts(points, target)]
    best = min(tried, key=coarse.misfit)
    fine = _Pair.thinned(points, target, FINE_POINTS)
    best = fine.refine(best, "shift")
    if mode == "shift":
        return best
    best = fine.refine(best, "rigid")
    return best if mode == "rigid" else fine.refine(best, "similarity")


def starts(points: Array, target: Array) -> list[Array]:
    """Candidate translations [4, 4] from height maps of two resolutions, and the two plain ones: none, and the centre."""
    extent = float(np.ptp(target[:, :2], axis=0).max())
    low, high = target.min(0), target.max(0)
    overlapping = (points[:, :2].min(0) < high[:2]).all() and (points[:, :2].max(0) > low[:2]).all()
    middle = (low + high) / 2 - (points.min(0) + points.max(0)) / 2
    first = np.zeros(3) if overlapping else middle
    shifts = [first]
    if extent > 0:
        rough = _by_heights(points, target, first, extent / 32, 8)
        shifts += [_by_heights(points, target, start, extent / 128, 6) for start in (first, rough)]
    shifts += [] if overlapping else [np.median(target, axis=0) - np.median(points, axis=0)]
    matrices = np.tile(np.eye(4), (len(shifts), 1, 1))
    matrices[:, :3, 3] = shifts
    return list(matrices)


def _by_heights(points: Array, target: Array, start: Array, cell: float, reach: int) -> Array:
    """The shift within ``reach`` cells of ``start`` in plan under which two height maps agree best, with its height."""
    low = target[:, :2].min(0)
    size = np.ceil(np.ptp(target[:, :2], axis=0) / cell).astype(int) + 1
    wanted = _height_map(target, low, cell, size)
    given = _height_map(points + start, low - reach * cell, cell, size + 2 * reach)
    needed = 0.5 * np.isfinite(wanted).sum()  # half of the reference has to be covered, or as much as ever is
    covers, scores, heights, steps = [], [], [], []
    for i in range(2 * reach + 1):
        for j in range(2 * reach + 1):
            difference = wanted - given[i : i + size[0], j : j + size[1]]
            difference = difference[np.isfinite(difference)]
            if not difference.size:
                continue
            height = float(np.median(difference))
            residual = np.sort(np.abs(difference - height))[: max(1, int(KEPT * difference.size))]
            covers.append(difference.size)
            scores.append(residual.mean())
            heights.append(height)
            steps.append((reach - i, reach - j))
    if not covers:
        return start
    enough = np.array(covers) >= min(needed, 0.8 * max(covers))
    best = int(np.argmin(np.where(enough, scores, np.inf)))
    return start + [steps[best][0] * cell, steps[best][1] * cell, heights[best]]


def _height_map(points: Array, low: Array, cell: float, size: NDArray[np.int64]) -> Array:
    """Mean height of the points in each square cell [size], NaN where there are none."""
    index = np.floor((points[:, :2] - low) / cell).astype(np.int64)
    inside = ((index >= 0) & (index < size)).all(axis=1)
    flat = index[inside, 0] * size[1] + index[inside, 1]
    count = np.bincount(flat, minlength=size[0] * size[1])
    total = np.bincount(flat, points[inside, 2], minlength=size[0] * size[1])
    with np.errstate(invalid="ignore"):
        return (total / np.where(count, count, np.nan)).reshape(size[0], size[1])


@dataclass
class _Pair:
    """Two clouds thinned to comparable density, with what the iterations need."""

    points: Array
    target: Array
    normals: Array
    weights: Array
    points_tree: cKDTree
    target_tree: cKDTree

    @classmethod
    def thinned(cls, points: Array, target: Array, n: int) -> _Pair:
        size = max(_voxel_for(points, n), _voxel_for(target, n))
        points, target = (p[voxel_thin(p, size)] if size else p for p in (points, target))
        tree = cKDTree(target)
        normals, weights = _normals(target, tree)
        return cls(points, target, normals, weights, cKDTree(points), tree)

    def refine(self, start: Array, mode: str, iterations: int = 60) -> Array:
        """Trimmed point-to-plane ICP over the pairs of both directions, from ``start``."""
        matrix = start.copy()
        extent = float(np.linalg.norm(np.ptp(self.target, axis=0))) or 1.0
        for _ in range(iterations):
            moved, index = self._pairs(matrix)
            step = _step(moved, self.target[index], self.normals[index], self.weights[index], mode)
            matrix = step @ matrix
            change = np.abs(step[:3, :3] - np.eye(3)).max() * extent + np.abs(step[:3, 3]).max()
            if change < 1e-6 * extent:
                break
        return matrix

    def misfit(self, matrix: Array) -> float:
        """Mean distance of the pairs that count."""
        moved, index = self._pairs(matrix)
        return float(np.linalg.norm(moved - self.target[index], axis=1).mean())

    def _pairs(self, matrix: Array) -> tuple[Array, NDArray[np.int64]]:
        """Transformed points of the cloud [P, 3] and the indices of their partners in the target [P]."""
        moved = transform(matrix, self.points)
        forward, nearest = _query(self.target_tree, moved)
        _, nearest_back = _query(self.points_tree, transform(invert(matrix), self.target))
        backward = np.linalg.norm(moved[nearest_back] - self.target, axis=1)
        keep = np.flatnonzero(forward <= np.quantile(forward, KEPT))
        keep_back = np.flatnonzero(backward <= np.quantile(backward, KEPT))
        return (
            np.concatenate([moved[keep], moved[nearest_back[keep_back]]]),
            np.concatenate([nearest[keep], keep_back]),
        )


def _voxel_for(points: Array, n: int) -> float:
    """Voxel edge that leaves at most about ``n`` points; 0 if they are few enough."""
    if len(points) <= n:
        return 0.0
    # Clouds of landscapes are surfaces: four times the points per halved edge.
    plan = np.sort(np.ptp(points, axis=0))[1:]
    size = float(np.sqrt(max(plan[0], plan[1] / n) * plan[1] / n))
    while len(voxel_thin(points, size)) > n:
        size *= 1.2
    return size


def _normals(points: Array, tree: cKDTree, neighbours: int = 12) -> tuple[Array, Array]:
    """Surface normals [M, 3] by principal components, and how flat the surface is there, 0..1 [M]."""
    k = min(neighbours, len(points))
    near = points[_query(tree, points, k)[1].reshape(len(points), k)]
    near = near - near.mean(1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))
    flatness = 1 - np.sqrt(np.clip(values[:, 0], 0, None) / np.maximum(values[:, 1], 1e-12))
    return vectors[:, :, 0], np.clip(flatness, 0.05, 1)


def _step(moved: Array, target: Array, normals: Array, weights: Array, mode: str) -> Array:
    """The small transform [4, 4] that brings points to their partners' planes, in least squares.

    A weak point-to-point term holds the directions that planes leave free, such as sliding on flat ground.
    """
    origin = moved.mean(0)
    local = moved - origin
    # Columns: translation x, y, z; rotation about x, y, z; scale. d(moved) = t + w x local + s local
    columns = np.zeros((len(local), 3, {"shift": 3, "rigid": 6, "similarity": 7}[mode]))
    columns[:, [0, 1, 2], [0, 1, 2]] = 1
    if mode != "shift":
        x, y, z = local.T
        columns[:, 1, 3], columns[:, 2, 3] = -z, y
        columns[:, 0, 4], columns[:, 2, 4] = z, -x
        columns[:, 0, 5], columns[:, 1, 5] = -y, x
    if mode == "similarity":
        columns[:, :, 6] = local
    gap = target - moved
    plane = np.einsum("nij,ni->nj", columns, normals)
    weak = 0.01
    left = (plane * weights[:, None]).T @ plane + weak * np.einsum("nik,nij->kj", columns, columns)
    right = plane.T @ (weights * (gap * normals).sum(1)) + weak * np.einsum("nij,ni->j", columns, gap)
    # lstsq: a single point, or points on a line, leave rotations without any hold
    solution = np.linalg.lstsq(left, right)[0]
    matrix = np.eye(4)
    if mode != "shift":
        matrix[:3, :3] = _rotation(solution[3:6])
    if mode == "similarity":
        matrix[:3, :3] *= np.exp(np.clip(solution[6], -0.1, 0.1))
    matrix[:3, 3] = solution[:3] + origin - matrix[:3, :3] @ origin
    return matrix


def _rotation(vector: Array) -> Array:
    """Rotation [3, 3] about ``vector`` [3] by its length in radians, at most 0.2."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(vector * min(1.0, 0.2 / max(float(np.linalg.norm(vector)), 1e-12))).as_matrix()


def _query(tree: cKDTree, queries: Array, k: int = 1) -> tuple[Array, NDArray[np.int64]]:
    distance, index = tree.query(queries, k=k, workers=-1 if len(queries) > PARALLEL_FROM else 1)
    return np.asarray(distance), np.asarray(index)
