# mypy: ignore-errors
# Kernels are written in the language of warp, which only looks like Python.
"""Colour: the kernel that turns visible faces into an image, and the one that colours loose surface points."""

from __future__ import annotations

import warp as wp

from overfly.scenes.ground import GroundData, ground
from overfly.scenes.kernels import View, key_face, pixel_ray
from overfly.scenes.ortho import Ortho
from overfly.scenes.textures import foliage, fractal, mix, noise, roof, wall

wp.set_module_options({"enable_backward": False, "fast_math": True, "optimization_level": 3})


@wp.struct
class Surface:
    """The mesh and its materials on one device."""

    vertices: wp.array(dtype=wp.vec3)
    faces: wp.array(dtype=wp.vec3i)
    normals: wp.array(dtype=wp.vec3)
    material: wp.array(dtype=wp.int32)
    paint: wp.array(dtype=wp.vec4)
    shape: wp.array(dtype=wp.vec4)
    colors: wp.array(dtype=wp.vec3)  # linear, of the vertices
    uv: wp.array(dtype=wp.vec2)
    texels: wp.array2d(dtype=wp.uint8)  # all levels of the image texture, [texels, 3]
    levels: wp.array(dtype=wp.vec3i)  # first texel, width, height of every level
    ground: GroundData
    seed: int


@wp.struct
class Light:
    sun: wp.vec3
    sun_strength: float
    sky_strength: float
    haze: float  # per metre
    exposure: float
    gain: wp.vec3
    vignetting: float
    shadows: int
    noise: float
    view: Ortho  # the sun's own view
    bias: float


@wp.func
def linear(value: float) -> float:
    """sRGB 0..1 to linear."""
    if value <= 0.04045:
        return value / 12.92
    return wp.pow((value + 0.055) / 1.055, 2.4)


@wp.func
def encoded(value: float) -> float:
    """Linear to sRGB 0..255, with a soft shoulder above 0.8 instead of hard clipping."""
    v = wp.max(value, 0.0)
    if v > 0.8:
        v = 1.0 - 0.2 * wp.exp(-(v - 0.8) / 0.2)
    if v <= 0.0031308:
        return 255.0 * 12.92 * v
    # Three square roots instead of a power: within 0.4 grey values of the standard's curve.
    a = wp.sqrt(v)
    b = wp.sqrt(a)
    c = wp.sqrt(b)
    return 255.0 * (0.585122381 * a + 0.783140355 * b - 0.368262736 * c)


@wp.func
def texel(s: Surface, level: wp.vec3i, x: int, y: int) -> wp.vec3:
    i = level[0] + wp.clamp(y, 0, level[2] - 1) * level[1] + wp.clamp(x, 0, level[1] - 1)
    return wp.vec3(float(s.texels[i, 0]), float(s.texels[i, 1]), float(s.texels[i, 2])) / 255.0


@wp.func
def image_texture(s: Surface, uv: wp.vec2, density: float, foot: float) -> wp.vec3:
    """Bilinear sample of the pyramid level whose texel is about a pixel; ``density`` in texels per metre."""
    count = s.levels.shape[0]
    which = wp.clamp(int(wp.log2(wp.max(density * foot, 1.0e-6)) + 0.5), 0, count - 1)
    level = s.levels[which]
    x = uv[0] * float(level[1]) - 0.5
    y = (1.0 - uv[1]) * float(level[2]) - 0.5
    i = int(wp.floor(x))
    j = int(wp.floor(y))
    top = mix(texel(s, level, i, j), texel(s, level, i + 1, j), x - float(i))
    low = mix(texel(s, level, i, j + 1), texel(s, level, i + 1, j + 1), x - float(i))
    color = mix(top, low, y - float(j))
    return wp.vec3(linear(color[0]), linear(color[1]), linear(color[2]))


@wp.func
def albedo(s: Surface, f: int, w1: float, w2: float, p: wp.vec3, n: wp.vec3, foot: float) -> wp.vec3:
    """Reflectance of face ``f`` at point ``p`` with barycentrics ``w1``, ``w2`` and geometric normal ``n``."""
    material = s.material[f]
    if material == 0:
        return ground(p[0], p[1], s.seed, foot, s.ground)
    paint = s.paint[f]
    shape = s.shape[f]
    base = wp.vec3(paint[0], paint[1], paint[2])
    if material <= 6:
        return wall(p, n, material, paint, shape, s.seed, foot)
    if material <= 11:
        return roof(p, material, paint, shape, s.seed, foot)
    if material == 12:
        return foliage(p, paint, shape[0], s.seed, foot)
    if material == 16:
        face = s.faces[f]
        return s.colors[face[0]] * (1.0 - w1 - w2) + s.colors[face[1]] * w1 + s.colors[face[2]] * w2
    if material == 17:
        face = s.faces[f]
        uv = s.uv[face[0]] * (1.0 - w1 - w2) + s.uv[face[1]] * w1 + s.uv[face[2]] * w2
        return image_texture(s, uv, shape[0], foot)
    if material == 13:
        return base * (1.0 + 0.3 * fractal(p[0] + p[1], p[2], s.seed, 0.4, 2, 0.6, foot))
    if material == 15:
        u = p[0] * shape[0] + p[1] * shape[1]
        v = p[1] * shape[0] - p[0] * shape[1]
        edge = 0.0
        if u - wp.floor(u) < 0.06 or v / 1.6 - wp.floor(v / 1.6) < 0.05:
            edge = wp.clamp(1.4 - 2.0 * foot, 0.0, 1.0)
        return mix(base, wp.vec3(0.35, 0.35, 0.36), edge * 0.7)
    return base


@wp.func
def lit(p: wp.vec3, n: wp.vec3, light: Light, shadow: wp.array2d(dtype=wp.float32)) -> float:
    """Share of the sun's disc that a point sees, from four neighbouring cells of the sun's depth map."""
    q = wp.vec3d(p + n * light.bias)
    x = float((wp.dot(q, light.view.right) - light.view.left) / light.view.cell[0]) - 0.5
    y = float((wp.dot(q, light.view.up) - light.view.bottom) / light.view.cell[1]) - 0.5
    z = float(wp.dot(q, light.view.away) - light.view.offset) - 0.6 * light.bias
    i = int(wp.floor(x))
    j = int(wp.floor(y))
    if i < 0 or j < 0 or i >= shadow.shape[1] - 1 or j >= shadow.shape[0] - 1:
        return 1.0
    u = x - float(i)
    v = y - float(j)
    seen = wp.float32(0.0)
    if z <= shadow[j, i] or shadow[j, i] == 0.0:
        seen += (1.0 - u) * (1.0 - v)
    if z <= shadow[j, i + 1] or shadow[j, i + 1] == 0.0:
        seen += u * (1.0 - v)
    if z <= shadow[j + 1, i] or shadow[j + 1, i] == 0.0:
        seen += (1.0 - u) * v
    if z <= shadow[j + 1, i + 1] or shadow[j + 1, i + 1] == 0.0:
        seen += u * v
    return seen


@wp.func
def sky_color(direction: wp.vec3) -> wp.vec3:
    up = wp.clamp(direction[2], 0.0, 1.0)
    return mix(wp.vec3(0.62, 0.68, 0.74), wp.vec3(0.20, 0.34, 0.62), wp.sqrt(up))


@wp.func
def shade_ray(
    s: Surface, f: int, eye: wp.vec3, d: wp.vec3, pixel: float, light: Light, shadow: wp.array2d(dtype=wp.float32)
) -> wp.vec3:
    """Radiance along the ray from ``eye`` with direction ``d`` (depth 1) that meets face ``f``."""
    face = s.faces[f]
    a = s.vertices[face[0]] - eye
    e1 = s.vertices[face[1]] - eye - a
    e2 = s.vertices[face[2]] - eye - a
    # Moeller-Trumbore's edge form: triple products lose centimetres in float32 at flight altitude.
    h = wp.cross(d, e2)
    det = wp.dot(e1, h)
    q = wp.cross(-a, e1)
    w1 = wp.clamp(-wp.dot(a, h) / det, 0.0, 1.0)
    w2 = wp.clamp(wp.dot(d, q) / det, 0.0, 1.0)
    local = a + e1 * w1 + e2 * w2
    p = eye + local
    far = wp.length(local)
    flat = wp.normalize(wp.cross(e1, e2))
    n = s.normals[face[0]] * (1.0 - w1 - w2) + s.normals[face[1]] * w1 + s.normals[face[2]] * w2
    smooth = wp.length(n)
    n = wp.where(smooth > 0.5, n / wp.max(smooth, 0.1), flat)
    facing = wp.dot(flat, local)
    if facing > 0.0:
        flat = -flat
    if wp.dot(n, flat) < 0.0:
        n = -n
    slant = wp.max(wp.abs(facing) / wp.max(far, 1.0e-6), 0.09)
    foot = wp.max(pixel * far / wp.sqrt(slant), 1.0e-3)
    color = albedo(s, f, w1, w2, p, flat, foot)
    cosine = wp.dot(n, light.sun)
    if s.material[f] == 12:
        rough = 0.55 * wp.clamp(1.0 - foot, 0.2, 1.0)
        cosine = (cosine + 0.3 + rough * noise(1.9 * p[0] + 1.1 * p[2], 1.9 * p[1] - 0.7 * p[2], s.seed + 77)) / 1.3
    direct = wp.float32(0.0)
    if cosine > 0.0 and wp.dot(flat, light.sun) > -0.2:
        direct = cosine * light.sun_strength
        if light.shadows != 0:
            direct *= lit(p, flat, light, shadow)
    ambient = light.sky_strength * (0.62 + 0.38 * n[2])
    warm = wp.vec3(1.03, 1.0, 0.94) * direct + wp.vec3(0.90, 0.98, 1.12) * ambient
    color = wp.cw_mul(color, warm)
    air = 1.0 - wp.exp(-light.haze * far)
    return mix(color, wp.vec3(0.55, 0.62, 0.70), air)


@wp.kernel
def shade(
    keys: wp.array2d(dtype=wp.int64),
    view: View,
    table: wp.array2d(dtype=wp.vec2d),
    s: Surface,
    light: Light,
    shadow: wp.array2d(dtype=wp.float32),
    samples: int,
    grain: wp.array3d(dtype=wp.float32),
    image: wp.array3d(dtype=wp.uint8),
):
    """One thread per pixel: the mean of its ``samples`` x ``samples`` rays, then the camera's electronics."""
    row, col = wp.tid()
    eye = wp.vec3(view.eye)
    world = wp.transpose(view.camera_from_world)
    pixel = 1.0 / float(view.focal[0])
    total = wp.vec3(0.0, 0.0, 0.0)
    for sy in range(samples):
        for sx in range(samples):
            y = row * samples + sy
            x = col * samples + sx
            d = wp.vec3(world * pixel_ray(x, y, view, table))
            f = key_face(keys[y, x])
            if f >= 0:
                total += shade_ray(s, f, eye, d, pixel, light, shadow)
            else:
                total += sky_color(wp.normalize(d))
    color = total / float(samples * samples) * light.exposure
    half_w = 0.5 * float(image.shape[1])
    half_h = 0.5 * float(image.shape[0])
    rx = (float(col) + 0.5 - half_w) / half_w
    ry = (float(row) + 0.5 - half_h) / half_h
    color = wp.cw_mul(color, light.gain) * (1.0 - light.vignetting * 0.5 * (rx * rx + ry * ry))
    for k in range(3):
        v = encoded(color[k])
        if light.noise > 0.0:  # shot noise grows with the root of the signal, on a floor of read-out noise
            v += grain[row, col, k] * light.noise * wp.sqrt(0.15 + 0.85 * v / 255.0)
        image[row, col, k] = wp.uint8(wp.clamp(v + 0.5, 0.0, 255.0))


@wp.kernel
def point_colors(
    which: wp.array(dtype=wp.int32), weights: wp.array(dtype=wp.vec2), s: Surface, out: wp.array2d(dtype=wp.uint8)
):
    """Unlit colour of points given by face and barycentrics."""
    i = wp.tid()
    f = which[i]
    face = s.faces[f]
    a = s.vertices[face[0]]
    e1 = s.vertices[face[1]] - a
    e2 = s.vertices[face[2]] - a
    w = weights[i]
    color = albedo(s, f, w[0], w[1], a + e1 * w[0] + e2 * w[1], wp.normalize(wp.cross(e1, e2)), 0.15)
    for k in range(3):
        out[i, k] = wp.uint8(wp.clamp(encoded(color[k]) + 0.5, 0.0, 255.0))
