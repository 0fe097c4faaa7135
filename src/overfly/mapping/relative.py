"""Matches of two frames that agree with one pose of the second to the first, near what GPS and gimbals tell of it.

Where frames overlap little, or look at the ground from far apart, most matches are wrong, and an essential matrix
that is free finds some dozen that agree by chance. One that stays near the priors has hardly any room for that: three
matches tell it, and how many more agree by chance is known beforehand (a contrario, Moisan & Stival 2004, section 4).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from overfly.geometry import Array
from overfly.mapping.overlays import Prior

TILT_DEG, YAW_DEG = 2.0, 4.0
"""Standard deviations of one frame's rotation against another's, about level axes and the vertical."""

GPS_M = (3.0, 5.0)
"""Standard deviations of a position, horizontal and vertical: consumer GPS."""

SIGMAS = 3.0
"""Matches farther than so many standard deviations off where the priors put them are wrong."""

HEIGHTS = (-0.3, 0.5)
"""Heights between which the ground and what stands on it lie, in the cameras' heights over it."""

WITHIN_PX, UNIT_PX = 2.0, 800
"""Off the epipolar line of an agreeing match, pixels of an image with that longest side; larger ones in proportion."""

DRAWN, HYPOTHESES, STEPS = 3, 400, 3
"""Matches of a hypothesis, how many are tried, and Gauss-Newton steps of each."""

FEWEST, BY_CHANCE = 6, 1e-2
"""Matches that must agree, and flights' pairs in which as many would agree by chance."""


class Pair(NamedTuple):
    """Priors and rays of matches of two frames, in world axes.

    Attributes:
        base: [3] from the first camera to the second, metres.
        rays: two of [m, 3], depth 1.
        rotations: world_from_camera [3, 3] of both.
        focals: of both, pixels.
        height: of the cameras over the ground, metres.
    """

    base: Array
    rays: tuple[Array, Array]
    rotations: tuple[Array, Array]
    focals: tuple[float, float]
    height: float


def agreeing(
    first: Prior, second: Prior, pixels: tuple[NDArray, NDArray], seed: int, reach: float = np.inf
) -> NDArray[np.bool_]:
    """Which matches [m] agree with one pose near the priors; none where as many would by chance.

    Args:
        first, second: of the frames.
        pixels: of the matches, [m, 2] in each image.
        seed: of the draws.
        reach: pixels off the epipolar lines of the priors within which matches were looked for.
    """
    pair = _pair(first, second, pixels)
    none = np.zeros(len(pixels[0]), bool)
    length = float(np.linalg.norm(pair.base))
    if length < 0.01 * pair.height:
        return none
    unit = max(1.0, max(max(p.camera.width, p.camera.height) for p in (first, second)) / UNIT_PX)
    sides = _across(pair.base)
    spread = _spread(pair.base, sides)
    zero = np.zeros((1, 5))
    away, slope = _residuals(pair, sides, zero)
    room = np.sqrt(unit**2 + (slope[0] ** 2 @ spread**2))  # one standard deviation, pixels
    may = np.flatnonzero((np.abs(away[0]) < SIGMAS * room) & _above_ground(pair, sides, zero)[0])
    if len(may) < FEWEST:
        return none
    chance = float(np.mean(np.minimum(1, WITHIN_PX * unit / np.minimum(SIGMAS * room[may], reach))))
    rng = np.random.default_rng(seed)
    drawn = rng.random((HYPOTHESES, len(may))).argpartition(DRAWN - 1, axis=1)[:, :DRAWN]
    few = Pair(pair.base, (pair.rays[0][may], pair.rays[1][may]), *pair[2:])
    moved = np.zeros((HYPOTHESES, 5))
    for _ in range(STEPS):
        moved = _solved(few, sides, spread, moved, drawn, unit)
    fits = _fits(few, sides, moved, unit)
    best = int(fits.sum(1).argmax())
    agree = fits[best]
    for _ in range(STEPS):
        if agree.sum() < DRAWN:
            return none
        refined = _solved(few, sides, spread, moved[best : best + 1], np.flatnonzero(agree)[None], unit)
        again = _fits(few, sides, refined, unit)[0]
        if again.sum() < agree.sum():
            break
        agree, moved[best] = again, refined[0]
    if agree.sum() < FEWEST or _log_false_alarms(len(may), int(agree.sum()), chance) > math.log(BY_CHANCE):
        return none
    none[may[agree]] = True
    return none


def _pair(first: Prior, second: Prior, pixels: tuple[NDArray, NDArray]) -> Pair:
    poses = first.world_from_camera, second.world_from_camera
    rays = []
    for prior, pose, at in zip((first, second), poses, pixels, strict=True):
        local = np.column_stack([at, np.ones(len(at))]) @ np.linalg.inv(prior.camera.matrix()).T
        rays.append(local @ pose[:3, :3].T)
    return Pair(
        poses[1][:3, 3] - poses[0][:3, 3],
        (rays[0], rays[1]),
        (poses[0][:3, :3], poses[1][:3, :3]),
        (first.camera.fx, second.camera.fx),
        float(np.mean([pose[2, 3] for pose in poses])),
    )


def _across(base: Array) -> Array:
    """Two unit vectors [2, 3] at right angles to the base, the first of them level."""
    level = np.cross(base, [0.0, 0.0, 1.0])
    if np.linalg.norm(level) < 1e-6 * np.linalg.norm(base):
        level = np.array([1.0, 0.0, 0.0])
    level = level / np.linalg.norm(level)
    up = np.cross(level, base)
    return np.stack([level, up / np.linalg.norm(up)])


def _spread(base: Array, sides: Array) -> Array:
    """Standard deviations [5] of a turn of the second camera about x, y, z, radians, and of the base across it, m."""
    length = np.linalg.norm(base)
    turns = np.radians([TILT_DEG, TILT_DEG, YAW_DEG])
    place = np.sqrt(2) * np.array([GPS_M[0], np.hypot(GPS_M[0] * sides[1, :2].max(), GPS_M[1] * sides[1, 2])])
    return np.concatenate([turns, np.hypot(place, length * turns[[2, 0]])])


def _turned(moved: Array, rays: Array) -> Array:
    """Rays [h, m, 3] of [m, 3] or [h, m, 3] turned by rotation vectors moved[:, :3]."""
    from scipy.spatial.transform import Rotation

    return np.einsum(
        "hij,...mj->hmi" if rays.ndim == 2 else "hij,hmj->hmi", Rotation.from_rotvec(moved[:, :3]).as_matrix(), rays
    )


def _residuals(pair: Pair, sides: Array, moved: Array, drawn: NDArray | None = None) -> tuple[Array, Array]:
    """Distances [h, m] from epipolar lines, pixels, and their derivatives [h, m, 5], for hypotheses moved [h, 5].

    Sampson's distance (Hartley & Zisserman 2004, eq. 11.9), of all matches or of those drawn [h, m].
    """
    a, b = (x if drawn is None else x[drawn] for x in pair.rays)
    a = np.broadcast_to(a, (len(moved), *a.shape[-2:]))
    b = _turned(moved, b)
    base = (pair.base + moved[:, 3:] @ sides)[:, None]
    plane = np.cross(base, a)
    other = np.cross(b, base)
    error = (b * plane).sum(-1)
    grow = np.stack([np.linalg.norm((plane @ pair.rotations[1])[..., :2], axis=-1) / pair.focals[1],
                     np.linalg.norm((other @ pair.rotations[0])[..., :2], axis=-1) / pair.focals[0]])  # fmt: skip
    scale = 1 / np.maximum(np.sqrt((grow**2).sum(0)), 1e-12)
    slope = np.concatenate([np.cross(b, plane), np.cross(a, b) @ sides.T], axis=-1)
    return error * scale, slope * scale[..., None]


def _above_ground(pair: Pair, sides: Array, moved: Array) -> NDArray[np.bool_]:
    """Whether matches [h, m] meet before both cameras, where ground can be."""
    a = np.broadcast_to(pair.rays[0], (len(moved), *pair.rays[0].shape))
    b = _turned(moved, pair.rays[1])
    base = (pair.base + moved[:, 3:] @ sides)[:, None]
    # The depths s, t at which s a and base + t b are nearest.
    aa, bb, ab = (a * a).sum(-1), (b * b).sum(-1), (a * b).sum(-1)
    da, db = (a * base).sum(-1), (b * base).sum(-1)
    det = np.maximum(aa * bb - ab**2, 1e-12)
    s, t = (bb * da - ab * db) / det, (ab * da - aa * db) / det
    height = 1 + s * a[..., 2] / pair.height
    return (s > 0) & (t > 0) & (height > HEIGHTS[0]) & (height < HEIGHTS[1])


def _solved(pair: Pair, sides: Array, spread: Array, moved: Array, drawn: NDArray, unit: float) -> Array:
    """Hypotheses [h, 5] after a Gauss-Newton step towards their matches [h, k], held by the priors."""
    away, slope = _residuals(pair, sides, moved, drawn)
    normal = np.einsum("hki,hkj->hij", slope, slope) / unit**2 + np.diag(spread**-2.0)
    right = np.einsum("hki,hk->hi", slope, away) / unit**2 + moved * spread**-2.0
    return moved - np.linalg.solve(normal, right[..., None])[..., 0]


def _fits(pair: Pair, sides: Array, moved: Array, unit: float) -> NDArray[np.bool_]:
    """Which matches [h, m] hypotheses explain."""
    away, _ = _residuals(pair, sides, moved)
    return (np.abs(away) < WITHIN_PX * unit) & _above_ground(pair, sides, moved)


def _log_false_alarms(n: int, k: int, chance: float) -> float:
    """Logarithm of how many pairs' hypotheses k of n matches would agree with by chance."""

    def choices(of: int, some: int) -> float:
        return math.lgamma(of + 1) - math.lgamma(some + 1) - math.lgamma(of - some + 1)

    tried = math.log(max(n - DRAWN, 1)) + choices(n, k) + choices(k, DRAWN)
    return tried + (k - DRAWN) * math.log(max(chance, 1e-6))
