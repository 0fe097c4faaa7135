"""A growing triangle mesh with materials, and the simplest solids: everything takes n instances at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from overfly.scenes import materials as m

Array = NDArray[np.float64]


class Builder:
    """Collects triangles; :meth:`arrays` joins them."""

    def __init__(self) -> None:
        self._vertices: list[Array] = []
        self._faces: list[NDArray[np.int32]] = []
        self._normals: list[Array] = []
        self._material: list[NDArray[np.int32]] = []
        self._paint: list[Array] = []
        self._shape: list[Array] = []
        self._count = 0

    def add(
        self,
        vertices: Array,
        faces: NDArray,
        normals: Array,
        material: ArrayLike,
        paint: ArrayLike,
        shape: ArrayLike = (0, 0, 0, 0),
    ) -> None:
        """Triangles: vertices, normals [V, 3], faces [F, 3]; material [F] or one; paint, shape [F, 4] or [4]."""
        if not len(faces):
            return
        self._vertices.append(vertices)
        self._faces.append(np.asarray(faces, np.int32) + self._count)
        self._normals.append(normals)
        self._material.append(np.broadcast_to(np.asarray(material, np.int32), len(faces)))
        self._paint.append(np.broadcast_to(np.asarray(paint, float), (len(faces), 4)))
        self._shape.append(np.broadcast_to(np.asarray(shape, float), (len(faces), 4)))
        self._count += len(vertices)

    def polygons(self, corners: Array, material: ArrayLike, paint: ArrayLike, shape: ArrayLike = (0, 0, 0, 0)) -> None:
        """Flat triangles [n, 3, 3] or quads [n, 4, 3]; material [n] or one, paint and shape [n, 4] or [4]."""
        n, k = corners.shape[:2]
        if not n:
            return
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        base = np.arange(n)[:, None] * k
        fan = np.array([[0, 1, 2], [0, 2, 3]][: k - 2])
        faces = (base[:, :, None] + fan).reshape(-1, 3)

        def each(values: ArrayLike, shape: tuple[int, ...]) -> NDArray:
            return np.repeat(np.broadcast_to(values, shape), k - 2, axis=0)

        self.add(
            corners.reshape(-1, 3),
            faces,
            np.repeat(normal, k, axis=0),
            each(material, (n,)),
            each(paint, (n, 4)),
            each(shape, (n, 4)),
        )

    def arrays(self) -> dict[str, NDArray]:
        """The scene's vertices, faces, normals, material, paint and shape."""
        return {
            "vertices": np.concatenate(self._vertices).astype(np.float32).astype(np.float64),
            "faces": np.concatenate(self._faces),
            "normals": np.concatenate(self._normals).astype(np.float32),
            "material": np.concatenate(self._material).astype(np.int32),
            "paint": np.concatenate(self._paint).astype(np.float32),
            "shape": np.concatenate(self._shape).astype(np.float32),
        }


def turned(local: ArrayLike, angle: ArrayLike, centre: ArrayLike) -> Array:
    """Points [n, k, 2] of n objects, turned by ``angle`` [n] (radians) and moved to ``centre`` [n, 2]."""
    local, angle, centre = np.asarray(local, float), np.asarray(angle, float), np.asarray(centre, float)
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    x, y = local[..., 0], local[..., 1]
    return np.stack([x * c - y * s, x * s + y * c], -1) + centre[:, None]


def lifted(xy: Array, z: ArrayLike) -> Array:
    """[..., 2] and heights that broadcast to [...] -> [..., 3]."""
    return np.concatenate([xy, np.broadcast_to(z, xy.shape[:-1])[..., None]], -1)


def rectangle(length: ArrayLike, width: ArrayLike) -> Array:
    """Corners [n, 4, 2], counter-clockwise, of rectangles centred on 0; length along x."""
    a, b = np.asarray(length, float) / 2, np.asarray(width, float) / 2
    return np.stack([np.stack([-a, -b], -1), np.stack([a, -b], -1), np.stack([a, b], -1), np.stack([-a, b], -1)], 1)


def ring_walls(ring: Array, low: ArrayLike, high: ArrayLike) -> Array:
    """Outward walls [n, k, 4, 3] of counter-clockwise rings [n, k, 2] between heights that broadcast to [n, k]."""
    following = np.roll(ring, -1, axis=1)
    return np.stack([lifted(ring, low), lifted(following, low), lifted(following, high), lifted(ring, high)], 2)


def boxes(
    builder: Builder,
    centre: ArrayLike,
    angle: ArrayLike,
    size: ArrayLike,
    low: ArrayLike,
    paint: ArrayLike,
    material: int = m.PAINT,
    taper: float = 1.0,
) -> None:
    """n upright boxes: centre [n, 2], size [n, 3], lowest z [n], paint [n, 4]; ``taper`` scales the top's rectangle."""
    size, low = np.asarray(size, float), np.asarray(low, float)
    if not len(size):
        return
    base = turned(rectangle(size[:, 0], size[:, 1]), angle, centre)
    top = turned(rectangle(size[:, 0] * taper, size[:, 1] * taper), angle, centre)
    z0, z1 = low[:, None], (low + size[:, 2])[:, None]
    b, t = lifted(base, z0), lifted(top, z1)
    sides = np.stack([b, np.roll(b, -1, 1), np.roll(t, -1, 1), t], 2)
    colors = np.broadcast_to(paint, (len(size), 4))
    builder.polygons(sides.reshape(-1, 4, 3), material, np.repeat(colors, 4, axis=0))
    builder.polygons(t, material, colors, np.stack([np.cos(angle), np.sin(angle), 0 * low, 0 * low], -1))


def cylinders(
    builder: Builder,
    centre: ArrayLike,
    radius: ArrayLike,
    low: ArrayLike,
    high: ArrayLike,
    paint: ArrayLike,
    *,
    sides: int = 20,
    cone: float = 0.0,
    top: float = 1.0,
    material: int = m.PAINT,
) -> None:
    """n upright cylinders with smooth sides; ``top`` scales the upper radius, a lid rises by ``cone`` radii."""
    centre, radius = np.asarray(centre, float), np.asarray(radius, float)
    n = len(radius)
    if not n:
        return
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    unit = np.stack([np.cos(angle), np.sin(angle)], -1)
    lower = lifted(centre[:, None] + unit * radius[:, None, None], np.asarray(low)[:, None])
    upper = lifted(centre[:, None] + unit * radius[:, None, None] * top, np.asarray(high)[:, None])
    normals = np.broadcast_to(lifted(unit, 0.0), (n, sides, 3))
    k = np.arange(sides)
    j = (k + 1) % sides
    side = np.concatenate([np.stack([k, j, j + sides], -1), np.stack([k, j + sides, k + sides], -1)])
    faces = (np.arange(n)[:, None, None] * 2 * sides + side).reshape(-1, 3)
    colors = np.broadcast_to(paint, (n, 4))
    vertices = np.concatenate([lower, upper], 1).reshape(-1, 3)
    shading = np.concatenate([normals, normals], 1).reshape(-1, 3)
    builder.add(vertices, faces, shading, material, np.repeat(colors, len(side), axis=0))
    tip = lifted(centre, np.asarray(high) + cone * radius)[:, None]
    lid = np.stack([upper, np.roll(upper, -1, 1), np.broadcast_to(tip, upper.shape)], 2)
    builder.polygons(lid.reshape(-1, 3, 3), material, np.repeat(colors, sides, axis=0))
