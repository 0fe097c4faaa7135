"""Bundle adjustment with everything that may hold a block: GPS, controls, calibration, the vertical; and its precision.

COLMAP's adjusters know neither weighted controls nor a prior of the calibration, and no common error of the GPS, so
the normal equations are built here: Levenberg-Marquardt with the points eliminated (Triggs, McLauchlan, Hartley &
Fitzgibbon, "Bundle adjustment: a modern synthesis", 2000, sections 4, 6 and 9), robust by reweighting (their 3.3).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from overfly.geometry import Array
from overfly.mapping.bundle import Bundle, Index
from overfly.mapping.normal_equations import LENS, Images, Reduced, Rows, point_steps, rotated, skew

CAUCHY = 2.0
"""Residuals above this many standard deviations lose their weight: images and controls' pixels."""

HUBER = 2.8
"""The same of GPS, verticals and headings, whose weight falls more gently (the 95 % bound of three normal values)."""

FIXED = 1e-7
"""Standard deviation of what is not estimated."""

LENS_SIGMA = 0.1
"""Standard deviation of k1, k2 about zero: more is no lens that a drone carries, but a bent block."""

LEVER_SIGMA_M = 0.3
"""Of the antenna's place in the camera's axes: lever arm, and delay times speed."""

UP_SIGMA = np.deg2rad(1.3)
"""Of a vertical by the gimbal: what its readings scatter by against the images on a real flight."""

HEADING_SIGMA = np.deg2rad(3.0)
"""Of a heading by the gimbal, which a compass tells it."""

MOST_STEPS = 60
FREE_STEP = 1e-9
"""Damping below which the block as a whole moves freely: GPS is weak against the sum of all rays."""

TOLERANCE = 0.02
"""What a step must still gain of half the sum of squares: 0.02 moves the unknowns by a fifth of their precision."""


@dataclass(frozen=True, eq=False)
class Held:
    """What holds a bundle besides its images; arrays are NaN where nothing is known.

    Attributes:
        pixel_sigma: standard deviation of a ray [k], pixels.
        places, place_sigmas: GPS positions of the images [n, 3] and their standard deviations, metres.
        ups: the vertical in camera axes [n, 3], unit length, with ``up_sigma`` in radians, of each [n] or of all.
        easts: the same of east; only headings are held by it, with ``heading_sigma``. One that is told the
            other way round costs nothing.
        focals: focal lengths by the photos' data [c], pixels, with ``focal_sigma`` as a share [c], or of all.
        lens_sigma: standard deviation of k1 and k2 about zero.
        lens_fixed: cameras that keep their calibration [c].
        knows: coordinates of points [m, 3], such as controls, and ``know_sigmas``, metres.
        lever: whether the antenna's place in the camera's axes is estimated.
        datum: whether GPS as a whole may be shifted against the frame.
    """

    pixel_sigma: Array
    places: Array
    place_sigmas: Array
    ups: Array
    easts: Array
    focals: Array
    lens_fixed: NDArray[np.bool_]
    knows: Array
    know_sigmas: Array
    up_sigma: Array | float = UP_SIGMA
    heading_sigma: Array | float = HEADING_SIGMA
    focal_sigma: Array | float = 0.02
    lens_sigma: float = LENS_SIGMA
    lever: bool = False
    datum: bool = False


def free(bundle: Bundle, pixel_sigma: Array | float) -> Held:
    """Nothing but the images."""
    n, m, c = len(bundle), len(bundle.points), len(bundle.lenses)
    return Held(
        pixel_sigma=np.broadcast_to(pixel_sigma, len(bundle.image)).astype(float),
        places=np.full((n, 3), np.nan),
        place_sigmas=np.ones((n, 3)),
        ups=np.full((n, 3), np.nan),
        easts=np.full((n, 3), np.nan),
        focals=np.full(c, np.nan),
        lens_fixed=np.zeros(c, bool),
        knows=np.full((m, 3), np.nan),
        know_sigmas=np.ones((m, 3)),
    )


@dataclass(frozen=True, eq=False)
class Adjusted:
    """The result.

    Attributes:
        bundle: the adjusted cameras and points.
        lever: place of the antenna in the camera's axes [3], metres.
        datum: GPS minus frame [3], metres.
        variance: of unit weight, of the images alone: 1 where ``pixel_sigma`` was right.
        reduced: the normal equations at the end.
    """

    bundle: Bundle
    held: Held
    lever: Array = field(default_factory=lambda: np.zeros(3))
    datum: Array = field(default_factory=lambda: np.zeros(3))
    variance: float = 1.0
    reduced: Reduced | None = None

    @property
    def cost(self) -> float:
        """Half the robust sum of squares."""
        return _cost(self)

    def away(self) -> Array:
        """Residuals of GPS [n, 3], metres: cameras with antenna and common shift, minus what GPS tells."""
        b = self.bundle
        return np.asarray(b.centres + b.world_from_camera @ self.lever + self.datum - self.held.places)

    def deviations(self) -> tuple[Array, Array, Array] | None:
        """Standard deviations of positions [n, 3] (metres), rotations [n, 3] (radians, camera axes) and focal lengths
        [c] (a share), scaled by the variance of unit weight; None where nothing holds the frame of reference."""
        known = np.isfinite(self.held.places).all(1).sum() + np.isfinite(self.held.knows).all(1).sum()
        if self.reduced is None or known < 3:
            return None
        variances = self.reduced.variances() * self.variance
        if not np.isfinite(variances).all() or (variances < 0).any():
            return None
        n, c = len(self.bundle), len(self.bundle.lenses)
        poses, lenses = np.sqrt(variances[: 6 * n]).reshape(n, 6), np.sqrt(variances[6 * n : 6 * n + LENS * c])
        return poses[:, 3:], poses[:, :3], lenses.reshape(c, LENS)[:, 0]

    def point_covariances(self, points: Index) -> Array:
        """Covariances [j, 3, 3] of some points, square metres, not scaled by the variance of unit weight."""
        assert self.reduced is not None
        return self.reduced.point_covariances(points)


def adjusted(
    bundle: Bundle,
    held: Held,
    *,
    lever: Array | None = None,
    datum: Array | None = None,
    tolerance: float = TOLERANCE,
    patience: int = MOST_STEPS,
) -> Adjusted:
    """The bundle that fits its images and what is known best, from a start near it; deterministic.

    Args:
        bundle: the start.
        held: what is known.
        lever, datum: of the antenna and of GPS as a whole, to start with.
        tolerance: gain of half the sum of squares below which a free step is the last one.
        patience: steps of less gain, damped or not, one after another, that are the last ones.
    """
    state = Adjusted(bundle, held, np.zeros(3) if lever is None else lever, np.zeros(3) if datum is None else datum)
    cost, damping = _cost(state), 1e-7
    images = _images(state)
    slow = 0
    for _ in range(MOST_STEPS):
        while True:
            step = Reduced(images, _rows(state), damping=damping).solve()
            trial = _settled(_moved(state, *step))
            found = _cost(trial)
            if found < cost or damping > 1e8:
                break
            damping *= 10
        if not found < cost:
            break
        gain, state, cost = cost - found, trial, found
        images = _images(state)
        slow = slow + 1 if gain < tolerance else 0
        if slow and (damping <= FREE_STEP or slow >= patience):  # damped steps are short, whatever is still to gain
            break
        damping = max(damping / 10, 1e-10)
    freedom = 2 * len(bundle.image) - 6 * len(bundle) - 3 * len(bundle.points)
    spent = float((images.weights * (images.residuals**2).sum(1)).sum())
    reduced = Reduced(images, _rows(state), damping=1e-12)
    return replace(state, variance=spent / max(freedom, 1), reduced=reduced)


def _images(state: Adjusted) -> Images:
    """Whitened, weighted residuals of the rays and their derivatives."""
    b, sigma = state.bundle, state.held.pixel_sigma
    turn = b.rotations[b.image]
    local = np.einsum("kij,kj->ki", turn, b.points[b.point] - b.centres[b.image])
    z = np.where(np.abs(local[:, 2]) > 1e-12, local[:, 2], 1e-12)
    x, y = local[:, 0] / z, local[:, 1] / z
    f, cx, cy, k1, k2 = b.lenses[b.lens_of[b.image]].T
    r2 = x * x + y * y
    radial, slope = 1 + r2 * (k1 + r2 * k2), 2 * (k1 + 2 * k2 * r2)
    residuals = np.stack([f * radial * x + cx, f * radial * y + cy], axis=1) - b.pixels
    inner = np.empty((len(x), 2, 2))  # pixels by x, y
    inner[:, 0, 0], inner[:, 0, 1] = f * (radial + slope * x * x), f * slope * x * y
    inner[:, 1, 0], inner[:, 1, 1] = inner[:, 0, 1], f * (radial + slope * y * y)
    flat = np.zeros((len(x), 2, 3))  # x, y by local coordinates
    flat[:, 0, 0] = flat[:, 1, 1] = 1 / z
    flat[:, 0, 2], flat[:, 1, 2] = -x / z, -y / z
    by_local = inner @ flat
    by_point = by_local @ turn
    by_pose = np.concatenate([-by_local @ skew(local), -by_point], axis=2)
    xy = np.stack([x, y], axis=1)
    by_lens = np.zeros((len(x), 2, LENS))  # focal length (its logarithm), k1, k2
    for i, factor in enumerate((radial, r2, r2 * r2)):
        by_lens[:, :, i] = xy * (f * factor)[:, None]
    residuals /= sigma[:, None]
    weights = 1 / (1 + (residuals**2).sum(1) / CAUCHY**2)
    scale = (np.sqrt(weights) / sigma)[:, None, None]
    return Images(
        b.image, b.lens_of[b.image], b.point, len(b), len(b.lenses), len(b.points),
        residuals, weights, by_pose * scale, by_lens * scale, by_point * scale,
        (b.points - state.held.knows), state.held.know_sigmas,
    )  # fmt: skip


def _rows(state: Adjusted) -> Rows:
    """Residuals of everything that is known of cameras, whitened; columns: poses, lenses, lever, datum."""
    b, held = state.bundle, state.held
    n, c = len(b), len(b.lenses)
    first_lens, lever, datum = 6 * n, 6 * n + LENS * c, 6 * n + LENS * c + 3
    rows = Rows(datum + 3)
    world = b.world_from_camera
    away = state.away()
    for k, axis in np.argwhere(np.isfinite(away)).tolist():
        s = held.place_sigmas[k, axis]
        by_turn = world[k] @ skew(state.lever[None])[0]
        columns = [6 * k + 3 + axis, *(6 * k + i for i in range(3)), *(lever + i for i in range(3)), datum + axis]
        values = [1.0, *by_turn[axis], *world[k][axis], 1.0]
        rows.add(away[k, axis] / s, columns, np.array(values) / s, huber=HUBER)
    sigmas = np.broadcast_to(held.up_sigma, n)
    for k in np.flatnonzero(np.isfinite(held.ups).all(1)).tolist():
        off = (b.rotations[k][:, 2] - held.ups[k]) / sigmas[k]
        by_turn = -skew(b.rotations[k][:, 2][None])[0] / sigmas[k]
        for axis in range(3):
            rows.add(off[axis], [6 * k + i for i in range(3)], by_turn[axis], huber=HUBER)
    sigmas = np.broadcast_to(held.heading_sigma, n)
    for k in np.flatnonzero(np.isfinite(held.easts).all(1) & np.isfinite(sigmas)).tolist():
        east, north = held.easts[k] / sigmas[k], b.rotations[k][:, 1]  # at right angles, were there no error
        rows.add(east @ north, [6 * k + i for i in range(3)], -east @ skew(north[None])[0], huber=HUBER)
    for j in range(c):
        column = first_lens + LENS * j
        if held.lens_fixed[j]:
            for i in range(LENS):
                rows.add(0.0, [column + i], [1 / FIXED])
            continue
        if np.isfinite(held.focals[j]):
            sigma = float(np.broadcast_to(held.focal_sigma, c)[j])
            rows.add(np.log(b.lenses[j, 0] / held.focals[j]) / sigma, [column], [1 / sigma])
        for i in range(2):
            rows.add(b.lenses[j, 3 + i] / held.lens_sigma, [column + 1 + i], [1 / held.lens_sigma])
    for i in range(3):
        rows.add(state.lever[i] / LEVER_SIGMA_M if held.lever else 0.0, [lever + i],
                 [1 / (LEVER_SIGMA_M if held.lever else FIXED)])  # fmt: skip
        if not held.datum:
            rows.add(0.0, [datum + i], [1 / FIXED])
        else:
            rows.add(0.0, [datum + i], [1e-6])  # keeps the equations regular where no GPS is left
    return rows


def _moved(state: Adjusted, cameras: Array, points: Array) -> Adjusted:
    """The state after a step of the camera unknowns [6n + 3c + 6] and the points [m, 3]."""
    b = state.bundle
    n, c = len(b), len(b.lenses)
    poses, lens = cameras[: 6 * n].reshape(n, 6), cameras[6 * n : 6 * n + LENS * c].reshape(c, LENS)
    lenses = b.lenses.copy()
    lenses[:, 0] *= np.exp(np.clip(lens[:, 0], -0.5, 0.5))
    lenses[:, 3:] += lens[:, 1:]
    moved = replace(
        b,
        rotations=rotated(poses[:, :3]) @ b.rotations,
        centres=b.centres + poses[:, 3:],
        lenses=lenses,
        points=b.points + points,
    )
    rest = cameras[6 * n + LENS * c :]
    return replace(state, bundle=moved, lever=state.lever + rest[:3], datum=state.datum + rest[3:])


def _settled(state: Adjusted) -> Adjusted:
    """Points moved to where the moved cameras see them: then long steps along weakly determined directions succeed."""
    images = _images(state)
    step = point_steps(images)
    moved = replace(state, bundle=replace(state.bundle, points=state.bundle.points + step))
    before, after = _squares(state), _squares(moved)
    better = np.bincount(images.point, after - before, minlength=images.m) < 0
    points = np.where(better[:, None], moved.bundle.points, state.bundle.points)
    return replace(state, bundle=replace(state.bundle, points=points))


def _squares(state: Adjusted) -> Array:
    """Robust squares [k] of the rays, a large number behind the camera."""
    b = state.bundle
    away = b.project(b.points[b.point], b.image) - b.pixels
    squares = (away**2).sum(1) / state.held.pixel_sigma**2
    return np.nan_to_num(CAUCHY**2 * np.log1p(squares / CAUCHY**2), nan=1e9)


def _cost(state: Adjusted) -> float:
    """Half the robust sum of squares; infinite where a point fell behind a camera."""
    b, held = state.bundle, state.held
    squares = _squares(state)
    if (squares >= 1e9).any():
        return float("inf")
    known = np.isfinite(held.knows)
    controls = np.where(known, (b.points - held.knows) / held.know_sigmas, 0.0)
    return float(0.5 * squares.sum() + 0.5 * (controls**2).sum() + _rows(state).cost())
