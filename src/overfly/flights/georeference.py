"""From the arbitrary frame of a reconstruction to local ENU metres, or at least to a levelled frame."""

from __future__ import annotations

import numpy as np

from overfly.errors import InputError
from overfly.geometry import Array, fit_similarity, pose, rotation_from_gimbal, transform

COLLINEAR = 0.08
"""Below this ratio of the horizontal spreads, positions lie on a line and do not say which way is up."""

LEAN_DEG, LEAN_GUESSED_DEG = 8.0, 20.0
"""A block whose up is this far from that of the gimbals, or of the cameras' x axes, was tilted by wrong heights."""

GROUP_M = 6.0
"""Heights within this range agree with one another."""

NOMINAL_HEIGHT = 100.0
"""Height of the cameras over the ground where the scale is unknown."""


def by_gps(positions: Array, told: Array, gimbals: list[tuple[float, float, float] | None], rotations: Array) -> Array:
    """The similarity [4, 4] that brings camera positions to their GPS positions.

    Args:
        positions: [n, 3] in the reconstruction's frame.
        told: [n, 3] local ENU metres, height NaN where GPS has none.
        gimbals: yaw, pitch, roll of each frame, or None.
        rotations: [n, 3, 3] reconstruction-from-camera.

    Frames far off the common fit (a wrong fix) lose their weight. Where the flight is a line or has no heights, the
    gimbals or the cameras' own up direction level it, and GPS gives scale, heading and place alone.

    Raises:
        InputError: fewer than two frames have GPS, or all at the same place.
    """
    known = np.isfinite(told[:, :2]).all(1)
    if known.sum() < 2 or np.ptp(told[known, :2], axis=0).max() < 1.0:
        raise InputError("The GPS positions are too few or all at one place, so they cannot scale the map.")
    if known.sum() >= 4 and not on_a_line(told) and np.isfinite(told[known, 2]).all():
        matrix = _robust(positions[known], told[known])
        if not _leans(matrix, gimbals, rotations):
            return matrix  # else some heights are so wrong that they tilt the block
    level = np.eye(4)
    level[:3, :3] = upright(gimbals, rotations)
    levelled = transform(level, positions)
    flat_from = np.column_stack([levelled[known, :2], np.zeros(known.sum())])
    flat_to = np.column_stack([told[known, :2], np.zeros(known.sum())])
    matrix = _robust(flat_from, flat_to) @ level
    heights = told[:, 2] - transform(matrix, positions)[:, 2]
    matrix[2, 3] += _commonest(heights[np.isfinite(heights)])
    return matrix


def _leans(matrix: Array, gimbals: list[tuple[float, float, float] | None], rotations: Array) -> bool:
    """Whether the frame that ``matrix`` leads to contradicts the cameras' own up direction."""
    if any(gimbal is not None for gimbal in gimbals):
        up, most = _up(gimbals, rotations), LEAN_DEG
    else:  # level cameras have their x axes in the horizontal plane
        right = rotations[:, :, 0]
        values, vectors = np.linalg.eigh(right.T @ right / len(right))
        up, most = -rotations[:, :, 2].mean(0), LEAN_GUESSED_DEG
        if values[1] >= 0.05:
            up = vectors[:, 0] * np.sign(vectors[:, 0] @ up)
        elif np.linalg.norm(right.mean(0)) > 0.5:
            return False  # all fly in one direction, and may look ahead: nothing tells
    up = matrix[:3, :3] @ up
    return bool(up[2] / np.linalg.norm(up) < np.cos(np.deg2rad(most)))


def _commonest(values: Array) -> float:
    """The middle of the largest group within :data:`GROUP_M`; 0 without values."""
    if not len(values):
        return 0.0
    ordered = np.sort(values)
    ends = np.searchsorted(ordered, ordered + GROUP_M, side="right")
    start = int((ends - np.arange(len(ordered))).argmax())
    return float(np.median(ordered[start : ends[start]]))


def on_a_line(told: Array) -> bool:
    """Whether GPS positions [n, 3] lie on a line in plan, so that they leave one tilt open."""
    known = told[np.isfinite(told[:, :2]).all(1), :2]
    spread = np.linalg.svd(known - known.mean(0), compute_uv=False)
    return bool(len(known) < 3 or spread[1] <= COLLINEAR * spread[0])


def level_line(positions: Array, gimbals: list[tuple[float, float, float] | None], rotations: Array) -> Array:
    """The rotation [4, 4] about the line of the cameras that brings their up direction as near to +z as it can."""
    middle = positions.mean(0)
    axis = np.linalg.svd(positions - middle, full_matrices=False)[2][0]
    up = _up(gimbals, rotations)
    across = np.cross(axis, [0.0, 0, 1])
    across /= max(float(np.linalg.norm(across)), 1e-12)
    above = np.cross(across, axis)
    angle = np.arctan2(up @ across, up @ above)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    matrix = np.eye(4)
    for sign in (1, -1):  # Rodrigues; the sense that takes the sideways part away
        turn = np.eye(3) + np.sin(sign * angle) * cross + (1 - np.cos(angle)) * cross @ cross
        if abs(turn @ up @ across) < 1e-6 + 1e-3 * abs(up @ across):
            matrix[:3, :3], matrix[:3, 3] = turn, middle - turn @ middle
    return matrix


def _robust(source: Array, target: Array) -> Array:
    """A similarity by iteratively reweighted least squares (Cauchy weights at the median residual)."""
    weights = np.ones(len(source))
    flat = not np.any(target[:, 2]) and not np.any(source[:, 2])
    matrix = np.eye(4)
    for _ in range(30):
        matrix = _fit_flat(source, target, weights) if flat else fit_similarity(source, target, weights=weights)
        away = np.linalg.norm(transform(matrix, source) - target, axis=1)
        weights = 1 / (1 + (away / max(2 * float(np.median(away)), 1e-6)) ** 2)
    return matrix


def _fit_flat(source: Array, target: Array, weights: Array) -> Array:
    """Heading, scale and shift in the plane, as one complex regression."""
    w = weights / weights.sum()
    a, b = source[:, 0] + 1j * source[:, 1], target[:, 0] + 1j * target[:, 1]
    mean_a, mean_b = (w * a).sum(), (w * b).sum()
    turn = (w * np.conj(a - mean_a) * (b - mean_b)).sum() / (w * np.abs(a - mean_a) ** 2).sum()
    shift = mean_b - turn * mean_a
    matrix = np.eye(4) * abs(turn)
    matrix[3, 3] = 1
    matrix[:2, :2] = [[turn.real, -turn.imag], [turn.imag, turn.real]]
    matrix[:2, 3] = shift.real, shift.imag
    return matrix


def upright(gimbals: list[tuple[float, float, float] | None], rotations: Array) -> Array:
    """The rotation [3, 3] that turns the reconstruction's up to +z."""
    return _to_z(_up(gimbals, rotations))


def _up(gimbals: list[tuple[float, float, float] | None], rotations: Array) -> Array:
    """The reconstruction's up direction [3]: by gimbals, else against the mean view."""
    ups = [
        rotation @ rotation_from_gimbal(*gimbal)[2]  # the world's z in camera axes
        for gimbal, rotation in zip(gimbals, rotations, strict=True)
        if gimbal is not None
    ]
    return np.asarray(np.mean(ups, axis=0) if ups else -rotations[:, :, 2].mean(0))


def _to_z(up: Array) -> Array:
    up = up / np.linalg.norm(up)
    axis = np.array([1.0, 0, 0]) if abs(up[0]) < 0.9 else np.array([0, 1.0, 0])
    x = np.cross(axis, up)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def moved_poses(matrix: Array, poses: Array) -> Array:
    """Poses [n, 4, 4] in the frame that a similarity [4, 4] leads to."""
    turn = matrix[:3, :3] / np.cbrt(np.linalg.det(matrix[:3, :3]))
    return np.stack([pose(turn @ old[:3, :3], transform(matrix, old[:3, 3])) for old in poses])


def by_ground(positions: Array, points: Array, rotations: Array, seed: int) -> Array:
    """Level a reconstruction without GPS by the plane of its ground points; the cameras stand 100 units above it.

    Args:
        positions: [n, 3] of the cameras.
        points: [m, 3] sparse points.
        rotations: [n, 3, 3] reconstruction-from-camera.
        seed: of the random planes that are tried.
    """
    rng = np.random.default_rng(seed)
    view = rotations[:, :, 2].mean(0)
    view /= max(float(np.linalg.norm(view)), 1e-9)  # on an orbit the views all but cancel out
    spread = float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))
    best, normal, offset = -1, -view, 0.0
    for _ in range(2000):
        three = points[rng.choice(len(points), 3, replace=False)]
        candidate = np.cross(three[1] - three[0], three[2] - three[0])
        length = np.linalg.norm(candidate)
        if length < 1e-12:
            continue
        candidate = candidate / length
        candidate = candidate if candidate @ view < 0 else -candidate
        if candidate @ view > -0.5:  # more than 60 degrees off the mean view: a wall
            continue
        inside = int((np.abs((points - three[0]) @ candidate) < 0.03 * spread).sum())
        if inside > best:
            best, normal, offset = inside, candidate, float(three[0] @ candidate)
    near = points[np.abs(points @ normal - offset) < 0.03 * spread]
    if len(near) >= 10:  # the plane of all that are near it
        _, _, axes = np.linalg.svd(near - near.mean(0), full_matrices=False)
        normal, offset = axes[2] * np.sign(axes[2] @ normal), float(near.mean(0) @ axes[2] * np.sign(axes[2] @ normal))
    matrix = np.eye(4)
    scale = NOMINAL_HEIGHT / max(float(np.median(positions @ normal - offset)), 1e-9)
    matrix[:3, :3] = scale * _to_z(normal)
    middle = transform(matrix, positions).mean(0)
    matrix[:2, 3] = -middle[:2]
    matrix[2, 3] = -scale * offset
    return matrix
