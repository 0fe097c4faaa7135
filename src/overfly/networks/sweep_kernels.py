# mypy: ignore-errors
# Kernels are written in the language of warp, which only looks like Python.
"""The sweep's inner loop as warp kernels, one source for CPU and CUDA: project, sample, compare, gather over frames.

In plain torch every hypothesis of every frame would be a copy of the feature map in memory, forth and back; here a
sample lives in registers. One thread per ray; channels come four at a time.
"""

from __future__ import annotations

import warp as wp

wp.config.log_level = wp.LOG_ERROR
wp.set_module_options({"enable_backward": False})


@wp.struct
class Sweep:
    """What the lines and maps of a batch look like: see ``overfly.networks.sweep``.

    q, r, own_q, own_r: [B V, N]; apart: [B V]; heights: [B, D, N]; reference: [B, N, C / 4]; maps: [B V, h w, C / 4].
    """

    q: wp.array2d(dtype=wp.vec3)
    r: wp.array2d(dtype=wp.vec3)
    own_q: wp.array2d(dtype=wp.vec3)
    own_r: wp.array2d(dtype=wp.vec3)
    apart: wp.array(dtype=wp.uint8)
    heights: wp.array3d(dtype=wp.float32)
    reference: wp.array3d(dtype=wp.vec4)
    maps: wp.array3d(dtype=wp.vec4)
    views: wp.int32
    groups: wp.int32
    width: wp.int32
    height: wp.int32
    stride: wp.float32
    own_width: wp.float32
    own_height: wp.float32


@wp.func
def place(s: Sweep, k: int, n: int, z: float):
    """Cell of frame k's map that ray n meets at height z (first cell's centre at 0); 1 in the third if it is seen."""
    nothing = wp.vec3(0.0, 0.0, 0.0)
    if s.apart[k] == wp.uint8(0):
        return nothing
    own = s.own_q[k, n] + z * s.own_r[k, n]
    at = s.q[k, n] + z * s.r[k, n]
    if own[2] <= 1.0e-4 or at[2] <= 1.0e-4:
        return nothing
    u = own[0] / own[2]
    v = own[1] / own[2]
    if u <= 0.0 or v <= 0.0 or u >= s.own_width or v >= s.own_height:
        return nothing
    x = at[0] / at[2] / s.stride
    y = at[1] / at[2] / s.stride
    if x <= 0.0 or y <= 0.0 or x >= float(s.width) or y >= float(s.height):
        return nothing
    return wp.vec3(x - 0.5, y - 0.5, 1.0)


@wp.func
def tap(s: Sweep, x: int, y: int):
    """Index of a cell in a map, -1 outside it."""
    if x < 0 or y < 0 or x >= s.width or y >= s.height:
        return int(-1)
    return y * s.width + x


@wp.kernel
def compare(
    s: Sweep,
    volume: wp.array4d(dtype=wp.float32),
    best: wp.array4d(dtype=wp.int8),
    visible: wp.array4d(dtype=wp.uint8),
):
    """volume [B, 2 G + 1, D, N]; best [B, G, D, N], the frame of the highest similarity; visible [B, V, D, N].

    All three are zero before.
    """
    b, n = wp.tid()
    per_group = s.reference.shape[2] / s.groups
    for d in range(s.heights.shape[1]):
        count = float(0.0)
        for v in range(s.views):
            k = b * s.views + v
            at = place(s, k, n, s.heights[b, d, n])
            if at[2] > 0.0:
                visible[b, v, d, n] = wp.uint8(1)
                left = int(wp.floor(at[0]))
                top = int(wp.floor(at[1]))
                fx = at[0] - float(left)
                fy = at[1] - float(top)
                t00 = tap(s, left, top)
                t10 = tap(s, left + 1, top)
                t01 = tap(s, left, top + 1)
                t11 = tap(s, left + 1, top + 1)
                for g in range(s.groups):
                    total = float(0.0)
                    for c in range(g * per_group, (g + 1) * per_group):
                        found = wp.vec4(0.0, 0.0, 0.0, 0.0)
                        if t00 >= 0:
                            found += (1.0 - fx) * (1.0 - fy) * s.maps[k, t00, c]
                        if t10 >= 0:
                            found += fx * (1.0 - fy) * s.maps[k, t10, c]
                        if t01 >= 0:
                            found += (1.0 - fx) * fy * s.maps[k, t01, c]
                        if t11 >= 0:
                            found += fx * fy * s.maps[k, t11, c]
                        total += wp.dot(found, s.reference[b, n, c])
                    likeness = total * float(s.groups)
                    volume[b, g, d, n] = volume[b, g, d, n] + likeness
                    if count == 0.0 or likeness > volume[b, s.groups + g, d, n]:
                        volume[b, s.groups + g, d, n] = likeness
                        best[b, g, d, n] = wp.int8(v)
                count += 1.0
        if count > 0.0:
            for g in range(s.groups):
                volume[b, g, d, n] = volume[b, g, d, n] / count
        volume[b, 2 * s.groups, d, n] = count / float(s.views)


@wp.kernel
def compare_backward(
    s: Sweep,
    best: wp.array4d(dtype=wp.int8),
    visible: wp.array4d(dtype=wp.uint8),
    gradient: wp.array4d(dtype=wp.float32),
    to_reference: wp.array3d(dtype=wp.vec4),
    to_maps: wp.array3d(dtype=wp.vec4),
):
    """The gradient of the volume's similarities with respect to both feature maps, added to what is there."""
    b, n = wp.tid()
    per_group = s.reference.shape[2] / s.groups
    for d in range(s.heights.shape[1]):
        count = float(0.0)
        for v in range(s.views):
            count += float(visible[b, v, d, n])
        for v in range(s.views):
            if visible[b, v, d, n] > wp.uint8(0):
                k = b * s.views + v
                at = place(s, k, n, s.heights[b, d, n])
                left = int(wp.floor(at[0]))
                top = int(wp.floor(at[1]))
                fx = at[0] - float(left)
                fy = at[1] - float(top)
                t00 = tap(s, left, top)
                t10 = tap(s, left + 1, top)
                t01 = tap(s, left, top + 1)
                t11 = tap(s, left + 1, top + 1)
                for g in range(s.groups):
                    share = gradient[b, g, d, n] / count
                    if int(best[b, g, d, n]) == v:
                        share += gradient[b, s.groups + g, d, n]
                    share = share * float(s.groups)
                    for c in range(g * per_group, (g + 1) * per_group):
                        found = wp.vec4(0.0, 0.0, 0.0, 0.0)
                        pull = share * s.reference[b, n, c]
                        if t00 >= 0:
                            found += (1.0 - fx) * (1.0 - fy) * s.maps[k, t00, c]
                            wp.atomic_add(to_maps, k, t00, c, (1.0 - fx) * (1.0 - fy) * pull)
                        if t10 >= 0:
                            found += fx * (1.0 - fy) * s.maps[k, t10, c]
                            wp.atomic_add(to_maps, k, t10, c, fx * (1.0 - fy) * pull)
                        if t01 >= 0:
                            found += (1.0 - fx) * fy * s.maps[k, t01, c]
                            wp.atomic_add(to_maps, k, t01, c, (1.0 - fx) * fy * pull)
                        if t11 >= 0:
                            found += fx * fy * s.maps[k, t11, c]
                            wp.atomic_add(to_maps, k, t11, c, fx * fy * pull)
                        to_reference[b, n, c] = to_reference[b, n, c] + share * found
