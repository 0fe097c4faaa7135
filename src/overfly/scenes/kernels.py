# mypy: ignore-errors
# Kernels are written in the language of warp, which only looks like Python.
"""Visibility: z-buffer rasterisers as warp kernels, one source for CPU and CUDA.

One thread per triangle writes packed keys (float bits of the depth in the upper, the face in the lower 32 bits) with
an atomic minimum; the nearest face of a pixel wins. Coverage and depth are those of the pixel's own ray against the
triangle in float64, relative to the camera: nothing is interpolated from projected vertices, triangles that cross the
near plane need no clipping, and a distorted lens is as exact as a pinhole.
"""

from __future__ import annotations

import warp as wp

wp.config.log_level = wp.LOG_ERROR
wp.set_module_options({"enable_backward": False})

CHUNK = 128
"""Triangles of one culling unit."""

EMPTY = 2**63 - 1
"""A key that nothing has been written to; a smaller start would hide everything."""


@wp.struct
class View:
    """A camera: rotation and position, pinhole, and what is needed to find a triangle in a distorted image."""

    camera_from_world: wp.mat33d
    eye: wp.vec3d
    focal: wp.vec2d
    centre: wp.vec2d
    width: wp.int32
    height: wp.int32
    near: wp.float64
    distorted: wp.int32
    radial: wp.vec3d  # k1, k2, k3
    tangential: wp.vec2d  # p1, p2
    low: wp.vec2d  # box of ideal image coordinates in which bend and shift hold
    high: wp.vec2d
    bend: wp.float64  # bound of the lens's second derivatives
    shift: wp.float64  # largest displacement by the lens


@wp.func
def lens(p: wp.vec2d, view: View) -> wp.vec2d:
    one = wp.float64(1.0)
    two = wp.float64(2.0)
    x = p[0]
    y = p[1]
    r2 = x * x + y * y
    k = view.radial
    t = view.tangential
    radial = one + r2 * (k[0] + r2 * (k[1] + r2 * k[2]))
    return wp.vec2d(
        x * radial + two * t[0] * x * y + t[1] * (r2 + two * x * x),
        y * radial + t[0] * (r2 + two * y * y) + two * t[1] * x * y,
    )


@wp.func
def pixel_ray(x: int, y: int, view: View, table: wp.array2d(dtype=wp.vec2d)) -> wp.vec3d:
    """The ray with z = 1 of a pixel's centre."""
    if view.distorted != 0:
        d = table[y, x]
        return wp.vec3d(d[0], d[1], wp.float64(1.0))
    half = wp.float64(0.5)
    return wp.vec3d(
        (wp.float64(x) + half - view.centre[0]) / view.focal[0],
        (wp.float64(y) + half - view.centre[1]) / view.focal[1],
        wp.float64(1.0),
    )


@wp.func
def near_edge(p: wp.vec3d, q: wp.vec3d, near: wp.float64) -> wp.vec2d:
    """Ideal image coordinates of the point where an edge p (in front) to q (behind) meets the near plane."""
    s = (p[2] - near) / (p[2] - q[2])
    return wp.vec2d((p[0] + s * (q[0] - p[0])) / near, (p[1] + s * (q[1] - p[1])) / near)


@wp.kernel
def rasterize(
    chunks: wp.array(dtype=wp.int32),
    count: int,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    view: View,
    table: wp.array2d(dtype=wp.vec2d),
    keys: wp.array2d(dtype=wp.int64),
):
    i = wp.tid()
    f = chunks[i // CHUNK] * CHUNK + i % CHUNK
    if f >= count:
        return
    face = faces[f]
    a = view.camera_from_world * (wp.vec3d(vertices[face[0]]) - view.eye)
    b = view.camera_from_world * (wp.vec3d(vertices[face[1]]) - view.eye)
    c = view.camera_from_world * (wp.vec3d(vertices[face[2]]) - view.eye)
    near = view.near
    low = wp.vec2d(wp.float64(1.0e30), wp.float64(1.0e30))
    high = -low
    cut = wp.int32(0)
    if a[2] > near:
        p = wp.vec2d(a[0] / a[2], a[1] / a[2])
        low = wp.min(low, p)
        high = wp.max(high, p)
    else:
        cut += 1
    if b[2] > near:
        p = wp.vec2d(b[0] / b[2], b[1] / b[2])
        low = wp.min(low, p)
        high = wp.max(high, p)
    else:
        cut += 1
    if c[2] > near:
        p = wp.vec2d(c[0] / c[2], c[1] / c[2])
        low = wp.min(low, p)
        high = wp.max(high, p)
    else:
        cut += 1
    if cut == 3:
        return
    if cut > 0:  # the triangle's visible part also ends where its edges meet the near plane
        if (a[2] > near) != (b[2] > near):
            p = near_edge(a, b, near)
            low = wp.min(low, p)
            high = wp.max(high, p)
        if (b[2] > near) != (c[2] > near):
            p = near_edge(b, c, near)
            low = wp.min(low, p)
            high = wp.max(high, p)
        if (c[2] > near) != (a[2] > near):
            p = near_edge(c, a, near)
            low = wp.min(low, p)
            high = wp.max(high, p)
    if low[0] > view.high[0] or low[1] > view.high[1] or high[0] < view.low[0] or high[1] < view.low[1]:
        return
    if view.distorted != 0:
        margin = view.shift
        inside = low[0] > view.low[0] and low[1] > view.low[1] and high[0] < view.high[0] and high[1] < view.high[1]
        if cut == 0 and inside:
            # Bent edges stay within bend * L^2 / 2 of the triangle of the distorted corners.
            span = high - low
            margin = view.bend * (span[0] * span[0] + span[1] * span[1]) * wp.float64(0.5)
            p = lens(wp.vec2d(a[0] / a[2], a[1] / a[2]), view)
            q = lens(wp.vec2d(b[0] / b[2], b[1] / b[2]), view)
            r = lens(wp.vec2d(c[0] / c[2], c[1] / c[2]), view)
            low = wp.min(p, wp.min(q, r))
            high = wp.max(p, wp.max(q, r))
        else:
            low = wp.max(low, view.low)
            high = wp.min(high, view.high)
        low = low - wp.vec2d(margin, margin)
        high = high + wp.vec2d(margin, margin)
    half = wp.float64(0.5)
    fx0 = wp.ceil(low[0] * view.focal[0] + view.centre[0] - half - wp.float64(1.0e-6))
    fx1 = wp.floor(high[0] * view.focal[0] + view.centre[0] - half + wp.float64(1.0e-6))
    fy0 = wp.ceil(low[1] * view.focal[1] + view.centre[1] - half - wp.float64(1.0e-6))
    fy1 = wp.floor(high[1] * view.focal[1] + view.centre[1] - half + wp.float64(1.0e-6))
    zero = wp.float64(0.0)
    x0 = int(wp.max(fx0, zero))
    x1 = int(wp.min(fx1, wp.float64(view.width - 1)))
    y0 = int(wp.max(fy0, zero))
    y1 = int(wp.min(fy1, wp.float64(view.height - 1)))
    if x0 > x1 or y0 > y1:
        return
    n = wp.cross(b - a, c - a)
    volume = wp.dot(a, n)
    if volume == zero:
        return
    na = wp.cross(b, c)
    nb = wp.cross(c, a)
    nc = wp.cross(a, b)
    if volume < zero:
        volume = -volume
        n = -n
        na = -na
        nb = -nb
        nc = -nc
    # Rounding must not open cracks between neighbours: about 1e-12 of the triangle's scale counts as inside.
    slack = -wp.float64(1.0e-12) * (wp.length(na) + wp.length(nb) + wp.length(nc))
    for y in range(y0, y1 + 1):
        for x in range(x0, x1 + 1):
            d = pixel_ray(x, y, view, table)
            if wp.dot(na, d) >= slack and wp.dot(nb, d) >= slack and wp.dot(nc, d) >= slack:
                rate = wp.dot(n, d)
                if rate > zero:
                    z = volume / rate
                    if z > near:
                        bits = wp.int64(wp.cast(wp.float32(z), wp.int32))
                        wp.atomic_min(keys, y, x, bits * wp.int64(4294967296) + wp.int64(f))


@wp.kernel
def unpack(keys: wp.array2d(dtype=wp.int64), step: int, first: int, depth: wp.array2d(dtype=wp.float32)):
    """Depth of every ``step``-th key from ``first``; 0 where nothing was hit."""
    y, x = wp.tid()
    key = keys[y * step + first, x * step + first]
    z = wp.float32(0.0)
    if key != wp.int64(EMPTY):
        z = wp.cast(wp.int32(key >> wp.int64(32)), wp.float32)
    depth[y, x] = z


@wp.func
def key_face(key: wp.int64) -> int:
    """The face of a key, -1 where nothing was hit."""
    if key == wp.int64(EMPTY):
        return -1
    return wp.int32(key & wp.int64(4294967295))
