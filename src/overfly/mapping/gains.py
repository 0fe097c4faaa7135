"""Exposure and sharpness of a flight's frames, each against the others: one number a frame from what they see alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from overfly.geometry import Array, Camera, project
from overfly.mapping.visibility import Image, View

SIDE = 320
"""Longest side of the images that are compared: small enough that a badly placed pixel shows the same ground."""

SAMPLES = 400
"""Points a frame, about."""

FEWEST = 12
"""Points that two frames must share to be compared."""

HOLD = 0.15
"""Weight of a gain of 1 against all comparisons of a frame: light that falls from one side makes each frame a little
brighter than the next one, which no pair can tell from exposure and which would add up along a strip."""

GATE = 0.1
"""Contradiction, in logarithms, from which on a comparison loses weight; well above what :data:`HOLD` leaves."""

LARGEST = 2.0
USABLE = (8, 247)
"""Values that are neither drowned nor burnt out."""


@dataclass(frozen=True)
class Gains:
    """Attributes:
    colors: [n, 3] factors of red, green and blue that make the frames alike; their mean brightness stays.
    sharpness: [n] contrast of fine detail against the other frames' of the same ground, the median frame's is 1.
    """

    colors: Array
    sharpness: Array


def balance(views: Sequence[View], outlines: Sequence[shapely.Geometry], points: Array) -> Gains:
    """Compare frames where they see the same points.

    The logarithms of the gains are the robust least-squares solution of one equation for each pair of frames: the
    median, over the points both see, of the logarithm of the ratio of their colours (Brown & Lowe 2007, section 6,
    solve the like for means). Medians forgive points that one of the two does not really see.

    Args:
        views: n frames with cameras; each image is read once.
        outlines: the ground each frame can see, polygons in the world's x, y.
        points: surface points [M, 3] all over the flight; a part is used.
    """
    tree = shapely.STRtree(shapely.points(points[:, :2]))
    frame, point = tree.query(np.asarray(outlines), predicate="contains")
    keep = max(1, round(len(point) / max(1, SAMPLES * len(views))))
    used = np.random.default_rng(0).integers(keep, size=len(points))[point] == 0
    frame, point = frame[used], point[used]
    seen: list[NDArray[np.int64]] = []
    values: list[Array] = []
    means = np.ones((len(views), 3))
    for i, view in enumerate(views):
        mine = np.sort(point[frame == i])
        image = view.image()
        inside, sample = _sample(image, view, points[mine])
        seen.append(mine[inside])
        values.append(sample)
        means[i] = np.maximum(image[::7, ::7].reshape(-1, 3).mean(0), 1)
    pairs, ratios, weights = _ratios(outlines, seen, values)
    logs = np.stack([_levelled(pairs, ratios[:, k], weights, len(views)) for k in range(4)], axis=1)
    colors = np.exp(np.clip(logs[:, :3], -np.log(LARGEST), np.log(LARGEST)))
    return Gains(colors * means.sum(0) / (means * colors).sum(0), np.exp(np.median(logs[:, 3]) - logs[:, 3]))


def _sample(image: Image, view: View, points: Array) -> tuple[NDArray[np.bool_], Array]:
    """Which of the points fall into the image [M], and the logarithms of red, green, blue and fine contrast there."""
    import cv2

    assert view.camera is not None
    assert view.world_from_camera is not None
    factor = min(1.0, SIDE / max(image.shape[:2]))
    size = max(1, round(image.shape[1] * factor)), max(1, round(image.shape[0] * factor))
    camera: Camera = view.camera.resized(*size)
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    detail = np.abs(cv2.Laplacian(gray, cv2.CV_32F)) + 1
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(float)
    fine = cv2.resize(detail, size, interpolation=cv2.INTER_AREA).astype(float)
    pixels, _ = project(points, camera, view.world_from_camera)
    with np.errstate(invalid="ignore"):
        inside = np.asarray(((pixels >= 0) & (pixels < size)).all(1))
    column, row = pixels[inside].astype(np.int64).T
    colors = small[row, column]
    with np.errstate(divide="ignore"):
        good = (colors > USABLE[0]) & (colors < USABLE[1])
        logs = np.where(good, np.log(colors), np.nan)
    return inside, np.column_stack([logs, np.log(fine[row, column])])


def _ratios(
    outlines: Sequence[shapely.Geometry], seen: list[NDArray[np.int64]], values: list[Array]
) -> tuple[NDArray[np.int64], Array, Array]:
    """Pairs of frames [m, 2], median logarithms of their ratio [m, 4] (NaN where unknown), weights [m]."""
    first, second = shapely.STRtree(outlines).query(np.asarray(outlines), predicate="intersects")
    pairs, ratios, weights = [], [], []
    for i, j in sorted(zip(first.tolist(), second.tolist())):
        if i >= j:
            continue
        _, a, b = np.intersect1d(seen[i], seen[j], assume_unique=True, return_indices=True)
        if len(a) < FEWEST:
            continue
        both = values[i][a] - values[j][b]
        known = np.isfinite(both).sum(0) >= FEWEST
        middle = np.full(4, np.nan)
        middle[known] = np.nanmedian(both[:, known], axis=0)
        pairs.append((i, j))
        ratios.append(middle)
        weights.append(min(1.0, len(a) / 100))
    return np.array(pairs, np.int64).reshape(-1, 2), np.array(ratios).reshape(-1, 4), np.array(weights)


def _levelled(pairs: NDArray[np.int64], ratios: Array, weights: Array, n: int) -> Array:
    """The numbers a [n] with a_i - a_j = -ratio for all pairs, by least squares with Huber's weights, held to 0."""
    from scipy.sparse import coo_array, diags_array
    from scipy.sparse.linalg import spsolve

    known = np.isfinite(ratios)
    (i, j), ratios, weights = pairs[known].T, ratios[known], weights[known]
    answer, trust = np.zeros(n), np.ones(len(ratios))
    hold = HOLD * np.maximum(np.bincount(i, weights, n) + np.bincount(j, weights, n), 1)
    for _ in range(10):
        w = weights * trust
        rows = np.concatenate([i, j, i, j])
        columns = np.concatenate([i, j, j, i])
        normal = coo_array((np.concatenate([w, w, -w, -w]), (rows, columns)), shape=(n, n)) + diags_array(hold)
        right = np.bincount(j, w * ratios, n) - np.bincount(i, w * ratios, n)
        answer = np.atleast_1d(spsolve(normal.tocsc(), right))
        off = np.abs(answer[i] - answer[j] + ratios)
        trust = np.minimum(1, GATE / np.maximum(off, 1e-9))
    return answer
