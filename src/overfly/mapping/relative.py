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

DEPTHS = (0.4, 2.0)
"""Depths below the first camera, in its height over the take-off, at which ground and what stands on it may lie: drones
take off from hills and in valleys."""

SHORTEST = 2.0
"""Standard deviations of the two positions' distance: of shorter bases not even the direction is told."""

WITHIN_PX, UNIT_PX = 2.0, 800
"""Off the epipolar line of an agreeing match, pixels of an image with that longest side; larger ones in proportion."""

DRAWN, HYPOTHESES, STEPS, SCORED = 3, 400, 3, 300
"""Matches of a hypothesis, how many are tried, Gauss-Newton steps of each, and most matches that choose the best."""

CLEAR, NARROWED_PX = 0.8, (np.inf, 30.0, 10.0, 4.0)
"""Share of the matches near the priors with which nothing needs to be drawn, and from which distances on matches are
left out on the way to the pose that most agree with."""

FEWEST, BY_CHANCE = 6, 1e-2
"""Matches that must agree, and in what share of the pairs with wrong matches alone as many may."""


def unit_px(width: float, height: float) -> float:
    """Pixels of an image in one of the lengths that are given for images of :data:`UNIT_PX`."""
    return max(1.0, max(width, height) / UNIT_PX)


class Pair(NamedTuple):
    """Priors and rays of matches of two frames, in world axes.

    Attributes:
        base: [3] from the first camera to the second, metres.
        sides: [2, 3] unit vectors across it, the first level.
        spread: [5] standard deviations of the second camera's turn about x, y, z, radians, and of the base along the
            sides, metres.
        rays: two of [m, 3], depth 1.
        rotations: world_from_camera [3, 3] of both.
        focals: of both, in pixels of images of :data:`UNIT_PX`.
        height: of the first camera over the take-off, metres.
    """

    base: Array
    sides: Array
    spread: Array
    rays: tuple[Array, Array]
    rotations: tuple[Array, Array]
    focals: tuple[float, float]
    height: float

    def of(self, chosen: NDArray) -> Pair:
        """The pair with some of its matches."""
        return self._replace(rays=(self.rays[0][chosen], self.rays[1][chosen]))


def comparable(first: Prior, second: Prior) -> bool:
    """Whether the priors tell the direction of the base: those of copies and of a drone that hovers do not."""
    base = second.world_from_camera[:3, 3] - first.world_from_camera[:3, 3]
    return float(np.linalg.norm(base)) >= SHORTEST * np.sqrt(2) * GPS_M[0]


def agreeing(
    first: Prior, second: Prior, pixels: tuple[NDArray, NDArray], seed: int, reach: float = np.inf
) -> NDArray[np.bool_]:
    """Which matches [m] agree with one pose near the priors; none where as many would by chance.

    Args:
        first, second: of the frames; pairs that are not :func:`comparable` agree on nothing.
        pixels: of the matches, [m, 2] in each image.
        seed: of the draws.
        reach: pixels of images of :data:`UNIT_PX` off the epipolar lines of the priors within which matches were
            looked for.
    """
    agree = np.zeros(len(pixels[0]), bool)
    if not comparable(first, second):
        return agree
    pair = _pair(first, second, pixels)
    prior = np.zeros((1, 5))
    away, slope = _residuals(pair, prior)
    sigma = np.sqrt(1 + slope[0] ** 2 @ pair.spread**2)  # of each match, pixels
    near = np.flatnonzero((np.abs(away[0]) < SIGMAS * sigma) & _on_ground(pair, prior)[0])
    if len(near) < FEWEST:
        return agree
    chance = float(np.mean(np.minimum(1, WITHIN_PX / np.minimum(SIGMAS * sigma[near], reach))))
    pair = pair.of(near)
    moved = _narrowed(pair)
    if _fits(pair, moved).mean() < CLEAR:
        moved = _drawn(pair, np.random.default_rng(seed))
    fits = _fits(pair, moved)[0]
    for _ in range(STEPS):
        if fits.sum() < DRAWN:
            return agree
        refined = _solved(pair, moved, np.flatnonzero(fits)[None])
        again = _fits(pair, refined)[0]
        if again.sum() < fits.sum():
            break
        fits, moved = again, refined
    if fits.sum() >= FEWEST and _log_false_alarms(len(near), int(fits.sum()), chance) <= math.log(BY_CHANCE):
        agree[near[fits]] = True
    return agree


def _narrowed(pair: Pair) -> Array:
    """The hypothesis [1, 5] that all matches lead to, step by step without those that lie far off."""
    moved = np.zeros((1, 5))
    for limit in NARROWED_PX:
        close = (np.abs(_residuals(pair, moved)[0][0]) < limit) & _on_ground(pair, moved)[0]
        moved = _solved(pair, moved, np.flatnonzero(close)[None])
    return moved


def _drawn(pair: Pair, rng: np.random.Generator) -> Array:
    """The hypothesis [1, 5], of those to which a few matches lead, that most matches agree with."""
    count = len(pair.rays[0])
    some = pair if count <= SCORED else pair.of(np.sort(rng.permutation(count)[:SCORED]))
    count = min(count, SCORED)
    drawn = rng.random((HYPOTHESES, count)).argpartition(DRAWN - 1, axis=1)[:, :DRAWN]
    moved = np.zeros((HYPOTHESES, 5))
    for _ in range(STEPS):
        moved = _solved(some, moved, drawn)
    best = int(_fits(some, moved).sum(1).argmax())
    return moved[best : best + 1]


def _pair(first: Prior, second: Prior, pixels: tuple[NDArray, NDArray]) -> Pair:
    """The pair of two priors and of the pixels [m, 2] of their matches."""
    priors = first, second
    rays = []
    for prior, at in zip(priors, pixels, strict=True):
        local = np.column_stack([at, np.ones(len(at))]) @ np.linalg.inv(prior.camera.matrix()).T
        rays.append(local @ prior.world_from_camera[:3, :3].T)
    units = [unit_px(prior.camera.width, prior.camera.height) for prior in priors]
    base = second.world_from_camera[:3, 3] - first.world_from_camera[:3, 3]
    sides = _across(base)
    return Pair(
        base,
        sides,
        _spread(base, sides),
        (rays[0], rays[1]),
        (first.world_from_camera[:3, :3], second.world_from_camera[:3, :3]),
        (first.camera.fx / units[0], second.camera.fx / units[1]),
        float(first.world_from_camera[2, 3]),
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
    """Standard deviations [5] as in :class:`Pair`: of the gimbals, and of the base by GPS and the first gimbal."""
    turns = np.radians([TILT_DEG, TILT_DEG, YAW_DEG])
    flat = np.linalg.norm(sides[:, :2], axis=1)
    place = np.sqrt(2) * np.hypot(GPS_M[0] * flat, GPS_M[1] * sides[:, 2])
    turned = np.array([turns[2] * np.linalg.norm(base[:2]), turns[0] * np.linalg.norm(base)])
    return np.concatenate([turns, np.hypot(place, turned)])


def _moved(pair: Pair, moved: Array, drawn: NDArray | None = None) -> tuple[Array, Array, Array]:
    """Both rays [h, m, 3] of all matches or of those drawn [h, m], and bases [h, 1, 3], for hypotheses moved [h, 5]."""
    from scipy.spatial.transform import Rotation

    a, b = (rays if drawn is None else rays[drawn] for rays in pair.rays)
    turns = Rotation.from_rotvec(moved[:, :3]).as_matrix()
    turned = np.asarray(np.einsum("hij,mj->hmi" if b.ndim == 2 else "hij,hmj->hmi", turns, b))
    return np.broadcast_to(a, turned.shape), turned, (pair.base + moved[:, 3:] @ pair.sides)[:, None]


def _residuals(pair: Pair, moved: Array, drawn: NDArray | None = None) -> tuple[Array, Array]:
    """Distances [h, m] from epipolar lines, pixels, and their derivatives [h, m, 5], for hypotheses moved [h, 5].

    Sampson's distance (Hartley & Zisserman 2004, eq. 11.9), of all matches or of those drawn [h, m].
    """
    a, b, base = _moved(pair, moved, drawn)
    plane, other = np.cross(base, a), np.cross(b, base)
    error = (b * plane).sum(-1)
    grow = np.stack([np.linalg.norm((plane @ pair.rotations[1])[..., :2], axis=-1) / pair.focals[1],
                     np.linalg.norm((other @ pair.rotations[0])[..., :2], axis=-1) / pair.focals[0]])  # fmt: skip
    scale = 1 / np.maximum(np.sqrt((grow**2).sum(0)), 1e-12)
    slope = np.concatenate([np.cross(b, plane), np.cross(a, b) @ pair.sides.T], axis=-1)
    return error * scale, slope * scale[..., None]


def _on_ground(pair: Pair, moved: Array) -> NDArray[np.bool_]:
    """Whether matches [h, m] meet before both cameras, at depths where ground can be, unsure as the base is long."""
    a, b, base = _moved(pair, moved)
    # The depths s, t at which s a and base + t b are nearest.
    aa, bb, ab = (a * a).sum(-1), (b * b).sum(-1), (a * b).sum(-1)
    da, db = (a * base).sum(-1), (b * base).sum(-1)
    det = np.maximum(aa * bb - ab**2, 1e-12)
    s, t = (bb * da - ab * db) / det, (ab * da - aa * db) / det
    depth = -s * a[..., 2] / pair.height
    unsure = SIGMAS * np.sqrt(2) * GPS_M[0] / np.linalg.norm(pair.base)
    low, high = DEPTHS[0] * max(0.0, 1 - unsure), DEPTHS[1] * (1 + unsure)
    return np.asarray((s > 0) & (t > 0) & (depth > low) & (depth < high))


def _solved(pair: Pair, moved: Array, drawn: NDArray) -> Array:
    """Hypotheses [h, 5] after a Gauss-Newton step towards their matches [h, k], held by the priors."""
    away, slope = _residuals(pair, moved, drawn)
    weight = pair.spread**-2.0
    normal = np.einsum("hki,hkj->hij", slope, slope) + np.diag(weight)
    right = np.einsum("hki,hk->hi", slope, away) + moved * weight
    return np.asarray(moved - np.linalg.solve(normal, right[..., None])[..., 0])


def _fits(pair: Pair, moved: Array) -> NDArray[np.bool_]:
    """Which matches [h, m] hypotheses explain; those that many matches have drawn away from the priors explain none."""
    near = np.asarray((np.abs(moved) < SIGMAS * pair.spread).all(1))[:, None]
    return near & (np.abs(_residuals(pair, moved)[0]) < WITHIN_PX) & _on_ground(pair, moved)


def _log_false_alarms(n: int, k: int, chance: float) -> float:
    """Logarithm of how many pairs' hypotheses k of n matches would agree with by chance."""

    def choices(of: int, some: int) -> float:
        return math.lgamma(of + 1) - math.lgamma(some + 1) - math.lgamma(of - some + 1)

    tried = math.log(max(n - DRAWN, 1)) + choices(n, k) + choices(k, DRAWN)
    return tried + (k - DRAWN) * math.log(max(chance, 1e-6))
