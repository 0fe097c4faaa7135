"""The F-score of the Tanks and Temples benchmark (Knapitsch et al. 2017), in its order of steps.

Place the reconstruction by a given transform, crop both clouds, thin both to the means of voxels of half the threshold,
then share of points nearer than the threshold (strictly): precision of the reconstruction, recall of the reference.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from overfly.errors import InputError
from overfly.geometry import transform
from overfly.metrics.functional import as_points, distances, harmonic


class Score(NamedTuple):
    """Shares 0..1; all 0 where cropping leaves one of the clouds empty."""

    precision: float
    recall: float
    fscore: float


def tanks_and_temples(
    cloud: Any,
    reference: Any,
    threshold_m: float,
    *,
    reference_from_cloud: ArrayLike | None = None,
    crop_polygon: ArrayLike | None = None,
    crop_heights: tuple[float, float] = (-np.inf, np.inf),
) -> Score:
    """Precision, recall and F-score at ``threshold_m``.

    Args:
        cloud, reference: points [N, 3] and [M, 3].
        threshold_m: the benchmark's tau, in the unit of the points.
        reference_from_cloud: [4, 4], for example from :func:`overfly.metrics.alignment.align`; None leaves the cloud.
        crop_polygon: corners [K, 2] in plan, in the reference's frame; None keeps everything.
        crop_heights: lowest and highest z that count.

    Raises:
        InputError: an empty cloud, a threshold that is not positive or a polygon with fewer than three corners.
    """
    if not 0 < threshold_m < np.inf:
        raise InputError(f"The threshold {threshold_m} is not a length: give metres above 0.")
    a, b = as_points(cloud, "The cloud"), as_points(reference, "The reference")
    if reference_from_cloud is not None:
        a = transform(reference_from_cloud, a)
    for_both = []
    for points in (a, b):
        inside = (points[:, 2] >= crop_heights[0]) & (points[:, 2] <= crop_heights[1])
        if crop_polygon is not None:
            inside &= _inside(points[:, :2], np.asarray(crop_polygon, float))
        for_both.append(points[inside])
    if not all(map(len, for_both)):
        return Score(0.0, 0.0, 0.0)
    found = distances(*(voxel_means(points, threshold_m / 2) for points in for_both))
    precision, recall = found.precision(threshold_m), found.recall(threshold_m)
    return Score(precision, recall, harmonic(precision, recall))


def voxel_means(points: NDArray[np.float64], size_m: float) -> NDArray[np.float64]:
    """The mean of the points of each voxel, as Open3D's ``voxel_down_sample``: the grid begins half a voxel below."""
    keys = np.floor((points - (points.min(0) - size_m / 2)) / size_m).astype(np.int64)
    _, voxel, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    low = points.min(0)  # sums of large coordinates would lose digits
    sums = [np.bincount(voxel.ravel(), column) for column in (points - low).T]
    return np.stack(sums, axis=1) / count[:, None] + low


def _inside(points: NDArray[np.float64], corners: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which of the points [N, 2] lie in the polygon [K, 2], by counting crossings of a ray in x."""
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
        raise InputError(f"The crop polygon has the shape {corners.shape}: give at least three corners [K, 2].")
    inside = np.zeros(len(points), bool)
    x, y = points.T
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0)):
        if y0 != y1:
            between = (y0 > y) != (y1 > y)
            inside ^= between & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return inside
