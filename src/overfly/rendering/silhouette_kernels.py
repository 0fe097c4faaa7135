# mypy: ignore-errors
# ruff: noqa: SIM109, UP018, RUF046 (Kernels are written in the language of warp, which only looks like Python.)
"""Silhouettes between neighbouring pixels, found and softened: warp kernels, one source for CPU and CUDA.

Positions are float64 and images float32, as in :mod:`overfly.rendering.kernels`.
"""

from __future__ import annotations

import warp as wp

wp.config.log_level = wp.LOG_ERROR
wp.set_module_options({"enable_backward": False})

STEPS = wp.constant(64)
"""Faces that a walk from one pixel to the next may cross."""

SLACK = wp.constant(wp.float64(1e-9))
"""Pixels by which rounding may misplace the crossing of an edge and a row."""


@wp.func
def turned(p: wp.vec3d, axis: int):
    """Screen position as (along, across) a row (axis 0) or a column (axis 1); the depth stays third."""
    if axis == 0:
        return p
    return wp.vec3d(p[1], p[0], p[2])


@wp.func
def straddles(p: wp.vec3d, q: wp.vec3d, across: wp.float64):
    """Half open, so that a chain of edges crosses a row once."""
    return (p[1] <= across) != (q[1] <= across)


@wp.func
def crossing(p: wp.vec3d, q: wp.vec3d, along: wp.float64, across: wp.float64, way: wp.float64):
    """How far in the way (+1 or -1) from the pixel centre (along, across) its row meets the line p, q."""
    return (p[0] + (across - p[1]) / (q[1] - p[1]) * (q[0] - p[0]) - along) * way


@wp.func
def walk(
    screen: wp.array2d(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.vec3i),
    neighbours: wp.array(dtype=wp.vec3i),
    b: int,
    axis: int,
    along: wp.float64,
    across: wp.float64,
    way: wp.float64,
    start: int,
    end: int,
):
    """Walks from the pixel centre (along, across) in face ``start`` over the surface to the next pixel's centre.

    Returns the side (3 face + k) over which the surface ends or folds back before; -1 if it does not, or if the side
    lies rather along the walk than across, and is left to the walks across.
    """
    v = faces[start]
    f = int(start)
    k = int(-1)
    d = wp.float64(-1.0e30)
    for i in range(3):
        p = turned(screen[b, v[(i + 1) % 3]], axis)
        q = turned(screen[b, v[(i + 2) % 3]], axis)
        if straddles(p, q, across):
            here = crossing(p, q, along, across, way)
            if here > d:
                d = here
                k = i
    if k < 0 or d < -SLACK:
        return int(-1)
    i_p = int(v[(k + 1) % 3])
    i_q = int(v[(k + 2) % 3])
    for _ in range(STEPS):
        if d > wp.float64(1.0):
            return int(-1)
        p = turned(screen[b, i_p], axis)
        q = turned(screen[b, i_q], axis)
        g = neighbours[f][k]
        ends = bool(g < 0)
        if not ends:
            if g == end:
                return int(-1)
            w = faces[g]
            i_o = int(w[0])
            if i_o == i_p or i_o == i_q:
                i_o = w[1]
            if i_o == i_p or i_o == i_q:
                i_o = w[2]
            o = turned(screen[b, i_o], axis)
            i_left = int(i_p)  # the vertex that the walk leaves behind: not on the side by which it leaves g
            if (o[1] <= across) == (p[1] <= across):
                p = o
                i_p = i_o
            else:
                q = o
                i_left = i_q
                i_q = i_o
            there = crossing(p, q, along, across, way)
            ends = o[2] <= wp.float64(0.0) or there < d - SLACK
            if not ends:
                d = there
                f = g
                k = 0
                if w[1] == i_left:
                    k = 1
                if w[2] == i_left:
                    k = 2
        if ends:
            v = faces[f]
            p = turned(screen[b, v[(k + 1) % 3]], axis)
            q = turned(screen[b, v[(k + 2) % 3]], axis)
            if wp.abs(q[0] - p[0]) <= wp.abs(q[1] - p[1]):
                return 3 * f + k
            return int(-1)
    return int(-1)


@wp.kernel
def find_steps(
    screen: wp.array2d(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.vec3i),
    neighbours: wp.array(dtype=wp.vec3i),
    face: wp.array3d(dtype=wp.int32),
    depth: wp.array3d(dtype=wp.float32),
    steps: wp.array3d(dtype=wp.vec2i),
):
    """Between which pixels the surface ends: steps [B, H, W] for the pair of a pixel and its right / lower neighbour.

    A step is 2 (3 face + k) of the side in between, plus 1 if the neighbour is the nearer one; -1 without.
    """
    b, y, x = wp.tid()
    found = wp.vec2i(-1, -1)
    here = face[b, y, x]
    beside = wp.vec3i(-1, -1, -1)  # faces that the surface reaches without an end, if they are seen there
    if here >= 0:
        beside = neighbours[here]
    for axis in range(2):
        x_next = x + 1 - axis
        y_next = y + axis
        if x_next < face.shape[2] and y_next < face.shape[1]:
            there = face[b, y_next, x_next]
            if here != there and (there < 0 or (there != beside[0] and there != beside[1] and there != beside[2])):
                swap = int(0)
                if here < 0 or (there >= 0 and depth[b, y_next, x_next] < depth[b, y, x]):
                    swap = 1
                along = wp.float64(x) + wp.float64(0.5)
                across = wp.float64(y) + wp.float64(0.5)
                if axis == 1:
                    along = wp.float64(y) + wp.float64(0.5)
                    across = wp.float64(x) + wp.float64(0.5)
                s = int(-1)
                if swap == 0:
                    s = walk(screen, faces, neighbours, b, axis, along, across, wp.float64(1.0), here, there)
                else:
                    along += wp.float64(1.0)
                    s = walk(screen, faces, neighbours, b, axis, along, across, wp.float64(-1.0), there, here)
                if s >= 0:
                    found[axis] = 2 * s + swap
    steps[b, y, x] = found


@wp.struct
class Step:
    """A step read back: the two pixels, the side's vertices, and where between the pixels it lies.

    The surface ends ``0.5 + weight`` pixels after the nearer pixel's centre, at the share t from vertex i to j.
    """

    near_x: int
    near_y: int
    far_x: int
    far_y: int
    i: int
    j: int
    t: wp.float64
    slope: wp.float64
    way: wp.float64
    weight: wp.float64


@wp.func
def read_step(screen: wp.array2d(dtype=wp.vec3d), faces: wp.array(dtype=wp.vec3i), code: int, b: int, y: int, x: int,
              axis: int):  # fmt: skip
    s = Step()
    swap = code % 2
    k = (code / 2) % 3
    v = faces[code / 6]
    s.i = v[(k + 1) % 3]
    s.j = v[(k + 2) % 3]
    right = 1 - axis
    s.near_x = x + swap * right
    s.near_y = y + swap * axis
    s.far_x = x + (1 - swap) * right
    s.far_y = y + (1 - swap) * axis
    s.way = wp.float64(1 - 2 * swap)
    p = turned(screen[b, s.i], axis)
    q = turned(screen[b, s.j], axis)
    centre = turned(wp.vec3d(wp.float64(s.near_x) + wp.float64(0.5), wp.float64(s.near_y) + wp.float64(0.5),
                             wp.float64(0.0)), axis)  # fmt: skip
    s.t = (centre[1] - p[1]) / (q[1] - p[1])
    s.slope = (q[0] - p[0]) / (q[1] - p[1])
    s.weight = (p[0] + s.t * (q[0] - p[0]) - centre[0]) * s.way - wp.float64(0.5)
    return s


@wp.kernel
def soften(
    screen: wp.array2d(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.vec3i),
    steps: wp.array3d(dtype=wp.vec2i),
    values: wp.array4d(dtype=wp.vec4),
    softened: wp.array4d(dtype=wp.vec4),
):
    """Gives the pixel in which the side lies its share of the other one's values; ``softened`` equals values before."""
    b, y, x = wp.tid()
    for axis in range(2):
        code = steps[b, y, x][axis]
        if code >= 0:
            s = read_step(screen, faces, code, b, y, x, axis)
            weight = wp.float32(s.weight)
            for c in range(values.shape[3]):
                change = weight * (values[b, s.near_y, s.near_x, c] - values[b, s.far_y, s.far_x, c])
                if weight > 0.0:
                    wp.atomic_add(softened, b, s.far_y, s.far_x, c, change)
                else:
                    wp.atomic_add(softened, b, s.near_y, s.near_x, c, change)


@wp.kernel
def soften_backward(
    screen: wp.array2d(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.vec3i),
    steps: wp.array3d(dtype=wp.vec2i),
    values: wp.array4d(dtype=wp.vec4),
    of_softened: wp.array4d(dtype=wp.vec4),
    to_values: wp.array4d(dtype=wp.vec4),
    to_screen: wp.array2d(dtype=wp.vec3d),
):
    """Adds the gradients to ``to_...``; ``to_values`` equals of_softened before."""
    b, y, x = wp.tid()
    for axis in range(2):
        code = steps[b, y, x][axis]
        if code >= 0:
            s = read_step(screen, faces, code, b, y, x, axis)
            weight = wp.float32(s.weight)
            of_weight = float(0.0)
            for c in range(values.shape[3]):
                g = of_softened[b, s.near_y, s.near_x, c]
                if weight > 0.0:
                    g = of_softened[b, s.far_y, s.far_x, c]
                of_weight += wp.dot(g, values[b, s.near_y, s.near_x, c] - values[b, s.far_y, s.far_x, c])
                wp.atomic_add(to_values, b, s.near_y, s.near_x, c, weight * g)
                wp.atomic_sub(to_values, b, s.far_y, s.far_x, c, weight * g)
            pull = wp.float64(of_weight) * s.way * turned(wp.vec3d(wp.float64(1.0), -s.slope, wp.float64(0.0)), axis)
            wp.atomic_add(to_screen, b, s.i, (wp.float64(1.0) - s.t) * pull)
            wp.atomic_add(to_screen, b, s.j, s.t * pull)
