"""Trees as closed crown meshes on trunks: conifers, round crowns, irregular crowns, bushes and hedges."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from overfly.scenes import materials as m
from overfly.scenes.builder import Array, Builder, cylinders

CONE, DOME, IRREGULAR = 0, 1, 2


@lru_cache(maxsize=16)
def _sphere(level: int) -> tuple[Array, NDArray[np.int32]]:
    """A unit icosphere without its hidden underside."""
    golden = (1 + 5**0.5) / 2
    flat = [(a, b) for a in (-1.0, 1.0) for b in (-golden, golden)]
    vertices = [(a, b, 0.0) for a, b in flat] + [(0.0, a, b) for a, b in flat] + [(b, 0.0, a) for a, b in flat]
    points = np.array(vertices) / np.hypot(1, golden)
    edge = 2 / np.hypot(1, golden)
    near = np.abs(np.linalg.norm(points[:, None] - points[None], axis=-1) - edge) < 1e-6
    faces = [
        (i, j, k)
        for i in range(12)
        for j in range(i + 1, 12)
        for k in range(j + 1, 12)
        if near[i, j] and near[j, k] and near[i, k]
    ]
    triangles = np.array(faces)
    for _ in range(level):
        pairs = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
        unique, inverse = np.unique(pairs, axis=0, return_inverse=True)
        middle = points[unique].mean(1)
        a, b, c = inverse.reshape(3, -1) + len(points)
        points = np.concatenate([points, middle / np.linalg.norm(middle, axis=1, keepdims=True)])
        i, j, k = triangles.T
        triangles = np.concatenate([np.stack(t, -1) for t in ((i, a, c), (a, j, b), (c, b, k), (a, b, c))])
    corner = points[triangles]
    turn = np.einsum("fi,fi->f", np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), corner.mean(1)) < 0
    triangles[turn] = triangles[turn][:, ::-1]
    return points, triangles[corner[..., 2].mean(1) > -0.75].astype(np.int32)


def _cone(sides: int) -> tuple[Array, NDArray[np.int32]]:
    """Three stacked skirts in a unit cylinder, z from -1 to 1."""
    points: list[tuple[float, float, float]] = []
    faces: list[tuple[int, int, int]] = []
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    for tier, (low, high, radius) in enumerate(((-1.0, 0.1, 1.0), (-0.35, 0.6, 0.72), (0.25, 1.0, 0.42))):
        base = len(points)
        turn = angle + tier * 0.5
        ragged = radius * (1 + 0.14 * np.cos(3 * turn + tier))
        points += [*zip(ragged * np.cos(turn), ragged * np.sin(turn), np.full(sides, low)), (0.0, 0.0, high)]
        faces += [(base + i, base + (i + 1) % sides, base + sides) for i in range(sides)]
    return np.array(points), np.array(faces, np.int32)


@lru_cache(maxsize=64)
def _crown(kind: int, variant: int, detail: int) -> tuple[Array, Array, NDArray[np.int32]]:
    """Vertices in [-1, 1], shading normals and faces of one crown shape."""
    rng = np.random.default_rng([kind, variant, 17])
    if kind == CONE:
        points, faces = _cone(8 if detail else 6)
        normals = points * [1, 1, 0] + [0, 0, 0.45]
    else:
        points, faces = _sphere(2 if detail and kind == IRREGULAR else 1)
        bumps = rng.standard_normal((7, 3))
        bumps /= np.linalg.norm(bumps, axis=1, keepdims=True)
        strength = rng.uniform(-0.5, 0.7, 7) * (0.75 if kind == IRREGULAR else 0.34)
        grow = 1 + (strength * np.exp(4.5 * (points @ bumps.T - 1))).sum(1)
        grow *= 1 + rng.uniform(-1, 1, len(points)) * (0.16 if kind == IRREGULAR else 0.10)
        normals = points.copy()
        points = points * grow[:, None]
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return points, normals, faces


def trees(
    builder: Builder,
    xy: ArrayLike,
    ground: ArrayLike,
    height: ArrayLike,
    radius: ArrayLike,
    kind: ArrayLike,
    rng: np.random.Generator,
    *,
    detail: int = 1,
    trunks: bool = True,
    tint: tuple[float, float, float] = (0.055, 0.10, 0.028),
) -> None:
    """n trees: foot [n, 2], ground [n], height and crown radius [n] in metres, kind [n] (CONE, DOME, IRREGULAR)."""
    xy, ground, height, radius, kind = (np.asarray(v) for v in (xy, ground, height, radius, kind))
    variant = rng.integers(0, 6, len(xy))
    turn = rng.random(len(xy)) * 2 * np.pi
    hue = rng.normal(0, 1, (len(xy), 2))
    bare = np.where(kind == CONE, 0.10, 0.22) * height
    for k in (CONE, DOME, IRREGULAR):
        for v in range(6):
            chosen = np.flatnonzero((kind == k) & (variant == v))
            if not len(chosen):
                continue
            points, normals, faces = _crown(k, v, detail)
            c, s = np.cos(turn[chosen])[:, None], np.sin(turn[chosen])[:, None]
            r, h = radius[chosen, None], (height - bare)[chosen, None] / 2
            x, y, z = (points[None, :, i] for i in range(3))
            vertices = np.stack(
                [
                    xy[chosen, 0, None] + r * (x * c - y * s),
                    xy[chosen, 1, None] + r * (x * s + y * c),
                    (ground + bare)[chosen, None] + h * (1 + z),
                ],
                -1,
            )
            nx, ny, nz = (normals[None, :, i] for i in range(3))
            shading = np.stack(np.broadcast_arrays(nx * c - ny * s, nx * s + ny * c, nz), -1)
            offset = np.arange(len(chosen))[:, None, None] * len(points)
            base = np.array(tint) * (0.62 if k == CONE else 1.0)
            bright = 1 + 0.16 * hue[chosen, 0]
            color = np.clip(base * bright[:, None] * (1 + np.outer(hue[chosen, 1], [0.14, 0.0, 0.10])), 0.008, 1)
            paint = np.c_[color, rng.random(len(chosen))]
            size = np.clip(radius[chosen] * 0.45, 0.6, 1.9)
            shape = np.stack([size, 0 * size, 0 * size, 0 * size], -1)
            builder.add(
                vertices.reshape(-1, 3),
                (faces + offset).reshape(-1, 3),
                shading.reshape(-1, 3),
                m.FOLIAGE,
                np.repeat(paint, len(faces), axis=0),
                np.repeat(shape, len(faces), axis=0),
            )
    if trunks:
        brown = np.c_[np.tile([0.09, 0.065, 0.045], (len(xy), 1)), rng.random(len(xy))]
        thick = np.clip(radius * 0.09, 0.08, 0.5)
        cylinders(builder, xy, thick, ground - 0.5, ground + bare + 0.35 * height, brown, sides=5, material=m.BARK)


def scatter(rng: np.random.Generator, low: ArrayLike, high: ArrayLike, spacing: float) -> Array:
    """Random places [n, 2] in a box, about ``spacing`` metres apart: a jittered grid."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    cols, rows = (max(1, int(v)) for v in (high - low) / spacing)
    x, y = np.meshgrid(np.arange(cols), np.arange(rows))
    cell = (high - low) / [cols, rows]
    grid = np.stack([x, y], -1).reshape(-1, 2)
    return low + (grid + 0.5 + rng.uniform(-0.46, 0.46, grid.shape)) * cell
