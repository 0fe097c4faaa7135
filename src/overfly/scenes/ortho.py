# mypy: ignore-errors
# Kernels are written in the language of warp, which only looks like Python.
"""Parallel projections: the sun's view and the view from above."""

from __future__ import annotations

import warp as wp

from overfly.scenes.kernels import CHUNK

wp.set_module_options({"enable_backward": False})


@wp.struct
class Ortho:
    """A parallel projection: cell coordinates are (dot(p, right) - left) / cell, depth grows along ``away``."""

    right: wp.vec3d
    up: wp.vec3d
    away: wp.vec3d
    left: wp.float64
    bottom: wp.float64
    offset: wp.float64  # subtracted from the depth, so that the packed keys sort: all depths must be above 0
    cell: wp.vec2d
    width: wp.int32
    height: wp.int32


@wp.kernel
def rasterize_ortho(
    chunks: wp.array(dtype=wp.int32),
    count: int,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    view: Ortho,
    jitter: wp.array2d(dtype=wp.vec2d),
    keys: wp.array2d(dtype=wp.int64),
):
    """Nearest face of every cell at its centre, or at ``jitter`` (0..1 within the cell) if that is given."""
    i = wp.tid()
    f = chunks[i // CHUNK] * CHUNK + i % CHUNK
    if f >= count:
        return
    face = faces[f]
    p = wp.vec3d(vertices[face[0]])
    q = wp.vec3d(vertices[face[1]])
    r = wp.vec3d(vertices[face[2]])
    ax = (wp.dot(p, view.right) - view.left) / view.cell[0]
    ay = (wp.dot(p, view.up) - view.bottom) / view.cell[1]
    bx = (wp.dot(q, view.right) - view.left) / view.cell[0]
    by = (wp.dot(q, view.up) - view.bottom) / view.cell[1]
    cx = (wp.dot(r, view.right) - view.left) / view.cell[0]
    cy = (wp.dot(r, view.up) - view.bottom) / view.cell[1]
    zero = wp.float64(0.0)
    x0 = int(wp.max(wp.floor(wp.min(ax, wp.min(bx, cx))), zero))
    x1 = int(wp.min(wp.floor(wp.max(ax, wp.max(bx, cx))), wp.float64(view.width - 1)))
    y0 = int(wp.max(wp.floor(wp.min(ay, wp.min(by, cy))), zero))
    y1 = int(wp.min(wp.floor(wp.max(ay, wp.max(by, cy))), wp.float64(view.height - 1)))
    if x0 > x1 or y0 > y1:
        return
    area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    if area == zero:
        return
    za = wp.dot(p, view.away) - view.offset
    zb = wp.dot(q, view.away) - view.offset
    zc = wp.dot(r, view.away) - view.offset
    half = wp.float64(0.5)
    slack = -wp.float64(1.0e-9)
    for y in range(y0, y1 + 1):
        for x in range(x0, x1 + 1):
            px = wp.float64(x) + half
            py = wp.float64(y) + half
            if jitter.shape[0] > 0:
                px = wp.float64(x) + jitter[y, x][0]
                py = wp.float64(y) + jitter[y, x][1]
            w0 = ((bx - px) * (cy - py) - (cx - px) * (by - py)) / area
            w1 = ((cx - px) * (ay - py) - (ax - px) * (cy - py)) / area
            w2 = wp.float64(1.0) - w0 - w1
            if w0 >= slack and w1 >= slack and w2 >= slack:
                z = w0 * za + w1 * zb + w2 * zc
                bits = wp.int64(wp.cast(wp.float32(z), wp.int32))
                wp.atomic_min(keys, y, x, bits * wp.int64(4294967296) + wp.int64(f))
