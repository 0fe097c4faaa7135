# mypy: ignore-errors
# ruff: noqa: UP018 (Kernels are written in the language of warp, which only looks like Python.)
"""What a pixel sees, as warp kernels, one source for CPU and CUDA, with gradients worked out by hand.

Silhouettes are softened by :mod:`overfly.rendering.silhouette_kernels`.

Positions are float64, so that what is seen, where an edge lies and what is interpolated never contradict each other by
rounding; images are float32, four channels at a time. Every kernel handles all views (``b``) in one launch.
"""

from __future__ import annotations

import warp as wp

wp.config.log_level = wp.LOG_ERROR
wp.set_module_options({"enable_backward": False})


@wp.func
def line(p: wp.vec3d, q: wp.vec3d):
    """(a, b, c) with ``a x + b y + c`` positive to the right of p -> q where y points down."""
    return wp.vec3d(p[1] - q[1], q[0] - p[0], p[0] * q[1] - q[0] * p[1])


@wp.func
def side(p: wp.vec3d, q: wp.vec3d, i: int, j: int, sign: wp.float64):
    """The same for the vertices i and j, to the last bit the negative of ``side(q, p, j, i, sign)``."""
    if i < j:
        return sign * line(p, q)
    return -sign * line(q, p)


@wp.func
def inside(e: wp.float64, s: wp.vec3d):
    """Whether a value of ``side`` counts as inside; a pixel centre on a shared edge belongs to one of its faces."""
    zero = wp.float64(0.0)
    return e > zero or (e == zero and (s[0] > zero or (s[0] == zero and s[1] > zero)))


@wp.kernel
def cover(
    screen: wp.array2d(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.vec3i),
    width: int,
    height: int,
    nearest: wp.array2d(dtype=wp.int64),
):
    """The nearest face of every pixel: nearest [B, H W] = bits of the depth, then of the face; 2**63 - 1 before.

    screen [B, V] = x, y in pixels, 1 / depth (0: not seen). The bits of positive floats sort as the floats do.
    """
    b, f = wp.tid()
    v = faces[f]
    p0 = screen[b, v[0]]
    p1 = screen[b, v[1]]
    p2 = screen[b, v[2]]
    zero = wp.float64(0.0)
    half = wp.float64(0.5)
    if p0[2] <= zero or p1[2] <= zero or p2[2] <= zero:
        return
    left = wp.ceil(wp.min(p0[0], wp.min(p1[0], p2[0])) - half)
    right = wp.floor(wp.max(p0[0], wp.max(p1[0], p2[0])) - half)
    top = wp.ceil(wp.min(p0[1], wp.min(p1[1], p2[1])) - half)
    bottom = wp.floor(wp.max(p0[1], wp.max(p1[1], p2[1])) - half)
    if not (left <= right and top <= bottom):
        return
    x_first = int(wp.max(left, zero))
    x_last = int(wp.min(right, wp.float64(width - 1)))
    y_first = int(wp.max(top, zero))
    y_last = int(wp.min(bottom, wp.float64(height - 1)))
    area = (p1[0] - p0[0]) * (p2[1] - p0[1]) - (p1[1] - p0[1]) * (p2[0] - p0[0])
    if not wp.abs(area) > zero:
        return
    sign = wp.sign(area)
    s0 = side(p1, p2, v[1], v[2], sign)
    s1 = side(p2, p0, v[2], v[0], sign)
    s2 = side(p0, p1, v[0], v[1], sign)
    for y in range(y_first, y_last + 1):
        py = wp.float64(y) + half
        r0 = s0[1] * py + s0[2]
        r1 = s1[1] * py + s1[2]
        r2 = s2[1] * py + s2[2]
        for x in range(x_first, x_last + 1):
            px = wp.float64(x) + half
            e0 = s0[0] * px + r0
            e1 = s1[0] * px + r1
            e2 = s2[0] * px + r2
            if inside(e0, s0) and inside(e1, s1) and inside(e2, s2):
                z = wp.float32((e0 + e1 + e2) / (e0 * p0[2] + e1 * p1[2] + e2 * p2[2]))
                key = wp.int64(wp.cast(z, wp.int32)) * wp.int64(4294967296) + wp.int64(f)
                wp.atomic_min(nearest, b, y * width + x, key)


@wp.struct
class Hit:
    """Where a ray meets a face: barycentrics of corners 1 and 2, depth; and the rows of the inverse of (e1, e2, -ray).

    The ray's point ``depth ray = p0 + b1 e1 + b2 e2`` fixes all three, so that their change is the inverse times
    ``depth d(ray) - sum b_i d(p_i)``: all that the gradient needs.
    """

    b0: wp.float64
    b1: wp.float64
    b2: wp.float64
    depth: wp.float64
    row1: wp.vec3d
    row2: wp.vec3d
    row3: wp.vec3d


@wp.func
def meet(p0: wp.vec3d, p1: wp.vec3d, p2: wp.vec3d, ray: wp.vec3d):
    hit = Hit()
    e1 = p1 - p0
    e2 = p2 - p0
    h = wp.cross(ray, e2)
    det = wp.dot(e1, h)
    if det == wp.float64(0.0):  # seen exactly edge-on: a constant
        hit.b0 = wp.float64(1.0)
        hit.depth = p0[2]
        return hit
    hit.row1 = h / det
    hit.row2 = wp.cross(e1, ray) / det
    hit.row3 = wp.cross(e1, e2) / det
    hit.b1 = -wp.dot(p0, hit.row1)
    hit.b2 = -wp.dot(p0, hit.row2)
    hit.b0 = wp.float64(1.0) - hit.b1 - hit.b2
    hit.depth = -wp.dot(p0, hit.row3)
    return hit


@wp.kernel
def blend_corners(
    points: wp.array2d(dtype=wp.vec3d),
    attributes: wp.array2d(dtype=wp.vec4),
    faces: wp.array(dtype=wp.vec3i),
    face: wp.array3d(dtype=wp.int32),
    ray_x: wp.array2d(dtype=wp.float64),
    ray_y: wp.array2d(dtype=wp.float64),
    values: wp.array4d(dtype=wp.vec4),
    depth: wp.array3d(dtype=wp.float32),
):
    """values [B, H, W, C / 4] and depth [B, H, W], zero before, where ray (ray_x [B, W], ray_y [B, H], 1) meets face.

    points [B, V] in camera axes; attributes [V, C / 4].
    """
    b, y, x = wp.tid()
    f = face[b, y, x]
    if f >= 0:
        v = faces[f]
        ray = wp.vec3d(ray_x[b, x], ray_y[b, y], wp.float64(1.0))
        hit = meet(points[b, v[0]], points[b, v[1]], points[b, v[2]], ray)
        b1 = wp.float32(hit.b1)
        b2 = wp.float32(hit.b2)
        for c in range(attributes.shape[1]):
            first = attributes[v[0], c]  # in this form a constant stays exactly what it is
            values[b, y, x, c] = first + b1 * (attributes[v[1], c] - first) + b2 * (attributes[v[2], c] - first)
        depth[b, y, x] = wp.float32(hit.depth)


@wp.kernel
def blend_corners_backward(
    points: wp.array2d(dtype=wp.vec3d),
    attributes: wp.array2d(dtype=wp.vec4),
    faces: wp.array(dtype=wp.vec3i),
    face: wp.array3d(dtype=wp.int32),
    ray_x: wp.array2d(dtype=wp.float64),
    ray_y: wp.array2d(dtype=wp.float64),
    of_values: wp.array4d(dtype=wp.vec4),
    of_depth: wp.array3d(dtype=wp.float32),
    to_points: wp.array2d(dtype=wp.vec3d),
    to_attributes: wp.array2d(dtype=wp.vec4),
    to_ray_x: wp.array2d(dtype=wp.float64),
    to_ray_y: wp.array2d(dtype=wp.float64),
):
    """Adds the gradients of all that ``blend_corners`` reads to ``to_...``."""
    b, y, x = wp.tid()
    f = face[b, y, x]
    if f >= 0:
        v = faces[f]
        ray = wp.vec3d(ray_x[b, x], ray_y[b, y], wp.float64(1.0))
        hit = meet(points[b, v[0]], points[b, v[1]], points[b, v[2]], ray)
        of_b1 = float(0.0)
        of_b2 = float(0.0)
        for c in range(attributes.shape[1]):
            g = of_values[b, y, x, c]
            of_b1 += wp.dot(g, attributes[v[1], c] - attributes[v[0], c])
            of_b2 += wp.dot(g, attributes[v[2], c] - attributes[v[0], c])
            wp.atomic_add(to_attributes, v[0], c, wp.float32(hit.b0) * g)
            wp.atomic_add(to_attributes, v[1], c, wp.float32(hit.b1) * g)
            wp.atomic_add(to_attributes, v[2], c, wp.float32(hit.b2) * g)
        pull = wp.float64(of_b1) * hit.row1 + wp.float64(of_b2) * hit.row2 + wp.float64(of_depth[b, y, x]) * hit.row3
        wp.atomic_sub(to_points, b, v[0], hit.b0 * pull)
        wp.atomic_sub(to_points, b, v[1], hit.b1 * pull)
        wp.atomic_sub(to_points, b, v[2], hit.b2 * pull)
        wp.atomic_add(to_ray_x, b, x, hit.depth * pull[0])
        wp.atomic_add(to_ray_y, b, y, hit.depth * pull[1])
