"""Normal equations of a bundle with the points eliminated, in memory that does not grow with the flight's area."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from overfly.geometry import Array

Index = NDArray[np.intp]

LENS = 3
"""Unknowns of a lens: focal length, k1, k2."""

POINTS_AT_ONCE = 3000
MOST_DENSE = 4200
"""Camera unknowns up to which the reduced equations are a full matrix."""

RIGHT_HAND_SIDES = 256


class Rows:
    """Rows of a sparse system: whitened residuals and derivatives by the camera unknowns, with robust weights."""

    def __init__(self, columns: int) -> None:
        self.columns = columns
        self._residuals: list[float] = []
        self._weights: list[float] = []
        self._costs: list[float] = []
        self._entries: tuple[list[int], list[int], list[float]] = ([], [], [])

    def add(
        self,
        residual: float,
        columns: Sequence[int],
        values: Sequence[float] | Array,
        *,
        huber: float = np.inf,
    ) -> None:
        """One residual; above ``huber`` (in standard deviations) it loses weight."""
        size, number = abs(float(residual)), len(self._residuals)
        weight, cost = 1.0, 0.5 * size**2
        if size > huber:
            weight, cost = huber / size, huber * (size - 0.5 * huber)
        root = float(np.sqrt(weight))
        self._residuals.append(float(residual) * root)
        self._costs.append(cost)
        rows, places, entries = self._entries
        rows.extend([number] * len(columns))
        places.extend(int(c) for c in columns)
        entries.extend(float(v) * root for v in values)

    def cost(self) -> float:
        """Half the robust sum of squares."""
        return float(np.sum(self._costs))

    def system(self) -> tuple[Any, Array]:
        """Derivatives (sparse [r, columns]) and residuals [r], weighted."""
        from scipy.sparse import csr_array

        rows, places, entries = self._entries
        shape = (len(self._residuals), self.columns)
        return csr_array((entries, (rows, places)), shape=shape), np.array(self._residuals)


@dataclass(frozen=True, eq=False)
class Images:
    """Rays in the order of their points: which image, lens and point [k], residuals [k, 2] (whitened), weights [k],
    derivatives by pose [k, 2, 6], lens [k, 2, 3] and point [k, 2, 3] (whitened, weighted); and what is known of points:
    offsets [m, 3] (NaN: nothing) with standard deviations [m, 3]."""

    image: Index
    lens: Index
    point: Index
    n: int
    c: int
    m: int
    residuals: Array
    weights: Array
    by_pose: Array
    by_lens: Array
    by_point: Array
    offsets: Array
    offset_sigmas: Array

    @property
    def errors(self) -> Array:
        """Weighted residuals [k, 2]."""
        return self.residuals * np.sqrt(self.weights)[:, None]


class Reduced:
    """(U - W V^-1 W') dx = -(g - W V^-1 h), where V holds the points' 3 x 3 blocks; diagonals grow by ``damping``."""

    def __init__(self, images: Images, rows: Rows, *, damping: float) -> None:
        self.images, self.size = images, rows.columns
        self.dense = self.size <= MOST_DENSE
        errors = images.errors
        blocks, h = _point_blocks(images, damping)
        self.inverse = np.linalg.inv(np.linalg.cholesky(blocks))  # L^-1 of V = L L'
        self.whitened = np.einsum("mij,mj->mi", self.inverse, h)
        self.by_point = images.by_point @ self.inverse[images.point].transpose(0, 2, 1)  # W' L^-T by rays
        derivatives, residuals = rows.system()
        self.gradient = np.asarray(derivatives.T @ residuals)
        square = derivatives.T @ derivatives
        self.matrix: Any = square.toarray() if self.dense else square.tocsc()
        added: Array = np.asarray(square.diagonal())
        starts = np.searchsorted(images.point, np.arange(0, images.m + POINTS_AT_ONCE, POINTS_AT_ONCE))
        for a, b in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
            if b > a:
                added = added + self._eliminate(slice(a, b), errors)
        self._damp(added, damping)

    def _eliminate(self, part: slice, errors: Array) -> Array:
        """Add some points' share of matrix and gradient; returns their share of U's diagonal [size]."""
        from scipy.sparse import csr_array

        im = self.images
        seen, image = np.unique(im.image[part], return_inverse=True)
        point, lens = im.point[part], im.lens[part]
        first = int(point[0])
        point, count, t = point - first, int(point[-1]) - first + 1, len(seen)
        columns = np.concatenate([(6 * seen[:, None] + np.arange(6)).ravel(), 6 * im.n + np.arange(LENS * im.c)])
        where = np.concatenate(
            [6 * image[:, None] + np.arange(6), 6 * t + LENS * lens[:, None] + np.arange(LENS)], axis=1
        )  # [k, 9]
        both = np.concatenate([im.by_pose[part], im.by_lens[part]], axis=2)  # [k, 2, 9]
        by_image = np.argsort(image, kind="stable")
        starts = np.flatnonzero(np.diff(image[by_image], prepend=-1))
        squares = np.add.reduceat((both.transpose(0, 2, 1) @ both)[by_image], starts, axis=0)  # [t, 9, 9]
        u = np.zeros((len(columns), len(columns)))
        first_of = by_image[starts]
        for i, own in enumerate(where[first_of]):
            u[np.ix_(own, own)] += squares[i]
        cross = both.transpose(0, 2, 1) @ self.by_point[part]  # [k, 9, 3]
        w = np.zeros((len(columns), count, 3))
        for i in range(6):
            w[where[:, i], point] = cross[:, i]  # a point has one ray of an image
        for j in range(im.c):
            own = lens == j
            for i in range(LENS):
                for axis in range(3):
                    w[6 * t + LENS * j + i, :, axis] = np.bincount(point[own], cross[own, 6 + i, axis], minlength=count)
        flat = w.reshape(len(columns), 3 * count)
        slope = np.bincount(where.ravel(), np.einsum("kij,ki->kj", both, errors[part]).ravel(), minlength=len(columns))
        share = slope - flat @ self.whitened[first : first + count].ravel()
        self.gradient[columns] += share
        s = u - flat @ flat.T
        if self.dense:
            self.matrix[np.ix_(columns, columns)] += s
        else:
            rows, places = np.nonzero(s)
            self.matrix = (
                self.matrix
                + csr_array((s[rows, places], (columns[rows], columns[places])), shape=(self.size, self.size)).tocsc()
            )
        diagonal = np.zeros(self.size)
        diagonal[columns] = np.diag(u)
        return diagonal

    def _damp(self, added: Array, damping: float) -> None:
        growth = damping * added + 1e-12 * np.median(added) * (added == 0)
        if self.dense:
            self.matrix[np.diag_indices(self.size)] += growth
        else:
            from scipy.sparse import diags_array

            self.matrix = (self.matrix + diags_array(growth)).tocsc()

    @cached_property
    def _factor(self) -> Any:
        """Solver of the equations, scaled to a unit diagonal: unknowns are radians, metres and shares."""
        from scipy.linalg import LinAlgError, cho_factor, cho_solve
        from scipy.sparse import diags_array
        from scipy.sparse.linalg import splu

        scale = 1 / np.sqrt(np.maximum(self.matrix.diagonal(), 1e-300))
        if self.dense:
            square = self.matrix * scale[:, None] * scale
            try:
                factor = cho_factor(square, lower=True, check_finite=False)
            except LinAlgError:  # singular within rounding
                factor = cho_factor(square + 1e-9 * np.eye(self.size), lower=True, check_finite=False)
            return lambda b: scale[:, None] * cho_solve(factor, scale[:, None] * b, check_finite=False)
        lu = splu((diags_array(scale) @ self.matrix @ diags_array(scale)).tocsc(), options={"SymmetricMode": True})
        return lambda b: scale[:, None] * lu.solve(scale[:, None] * b)

    def solve(self) -> tuple[Array, Array]:
        """Steps of the camera unknowns [size] and the points [m, 3]."""
        cameras = self._factor(-self.gradient[:, None])[:, 0]
        return cameras, self._points(cameras)

    def _points(self, cameras: Array) -> Array:
        im = self.images
        poses = cameras[: 6 * im.n].reshape(im.n, 6)[im.image]
        lenses = cameras[6 * im.n : 6 * im.n + LENS * im.c].reshape(im.c, LENS)[im.lens]
        moved = np.einsum("kij,kj->ki", im.by_pose, poses) + np.einsum("kij,kj->ki", im.by_lens, lenses)
        total = self.whitened + _by_point(np.einsum("kij,ki->kj", self.by_point, moved), im)
        return np.asarray(-np.einsum("mji,mj->mi", self.inverse, total))

    def variances(self) -> Array:
        """Diagonal [size] of the inverse."""
        found = np.empty(self.size)
        for start in range(0, self.size, RIGHT_HAND_SIDES):
            some = np.arange(start, min(start + RIGHT_HAND_SIDES, self.size))
            unit = np.zeros((self.size, len(some)))
            unit[some, np.arange(len(some))] = 1
            found[some] = self._factor(unit)[some, np.arange(len(some))]
        return found

    def point_covariances(self, points: Index) -> Array:
        """Covariances [j, 3, 3] of some points: V^-1 + V^-1 W' S^-1 W V^-1."""
        im = self.images
        found = np.empty((len(points), 3, 3))
        for row, p in enumerate(points):
            rays = np.flatnonzero(im.point == p)
            w = np.zeros((self.size, 3))  # W L^-T
            for k in rays:
                w[6 * im.image[k] : 6 * im.image[k] + 6] += im.by_pose[k].T @ self.by_point[k]
                start = 6 * im.n + LENS * im.lens[k]
                w[start : start + LENS] += im.by_lens[k].T @ self.by_point[k]
            middle = np.eye(3) + w.T @ self._factor(w)
            found[row] = self.inverse[p].T @ middle @ self.inverse[p]
        return found


def _point_blocks(images: Images, damping: float) -> tuple[Array, Array]:
    """Normal equations of the points alone: [m, 3, 3] and [m, 3]."""
    known = np.isfinite(images.offsets)
    weight = np.where(known, 1 / images.offset_sigmas**2, 0.0)
    h = _by_point(np.einsum("kij,ki->kj", images.by_point, images.errors), images)
    h += np.where(known, images.offsets, 0.0) * weight
    blocks = _by_point(images.by_point.transpose(0, 2, 1) @ images.by_point, images)
    diagonal = np.einsum("mii->mi", blocks)
    diagonal += weight
    diagonal *= 1 + damping
    diagonal += 1e-12 * diagonal.max(1, keepdims=True) + 1e-300
    return blocks, h


def point_steps(images: Images) -> Array:
    """Gauss-Newton steps [m, 3] of the points while the cameras stay."""
    blocks, h = _point_blocks(images, 1e-9)
    return np.asarray(-np.linalg.solve(blocks, h[..., None])[..., 0])


def _by_point(values: Array, images: Images) -> Array:
    """Sums [m, ...] over the rays [k, ...] of each point."""
    total = np.zeros((images.m, *values.shape[1:]))
    if len(values):
        seen, first = np.unique(images.point, return_index=True)
        total[seen] = np.add.reduceat(values, first, axis=0)
    return total


def skew(vectors: Array) -> Array:
    """Matrices [k, 3, 3] of the cross product with vectors [k, 3]."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def rotated(turns: Array) -> Array:
    """Rotations [n, 3, 3] by rotation vectors [n, 3]."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(turns).as_matrix()
