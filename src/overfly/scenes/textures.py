# mypy: ignore-errors
# Kernels are written in the language of warp, which only looks like Python.
"""Procedural textures in world space, evaluated per sample inside the shading kernel.

All take ``foot``, the size in metres of the pixel on the surface, and fade whatever is finer, so that nothing aliases.
Colours are linear reflectances. Patterns are hashes of integer cells: the same place always looks the same.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def hash01(ix: int, iy: int, seed: int) -> float:
    """A number in [0, 1) of an integer cell."""
    h = (
        wp.uint32(ix) * wp.uint32(1597334677)
        + wp.uint32(iy) * wp.uint32(1812433253)
        + wp.uint32(seed) * wp.uint32(374761393)
    )
    h = (h ^ (h >> wp.uint32(15))) * wp.uint32(739982445)
    h = (h ^ (h >> wp.uint32(12))) * wp.uint32(695872825)
    h = h ^ (h >> wp.uint32(15))
    return float(h >> wp.uint32(8)) * 5.9604645e-8


@wp.func
def corner(h: wp.uint32) -> float:
    h = (h ^ (h >> wp.uint32(15))) * wp.uint32(739982445)
    return float((h ^ (h >> wp.uint32(14))) >> wp.uint32(9))


@wp.func
def noise(x: float, y: float, seed: int) -> float:
    """Smooth value noise in [-1, 1] with cells of 1; a lighter hash than :func:`hash01`, for it is called most."""
    fx = wp.floor(x)
    fy = wp.floor(y)
    u = x - fx
    v = y - fy
    u = u * u * (3.0 - 2.0 * u)
    v = v * v * (3.0 - 2.0 * v)
    x0 = wp.uint32(int(fx) + 19 * seed) * wp.uint32(1597334677)
    y0 = wp.uint32(int(fy) + seed) * wp.uint32(1812433253)
    x1 = x0 + wp.uint32(1597334677)
    y1 = y0 + wp.uint32(1812433253)
    a = corner(x0 ^ y0)
    b = corner(x1 ^ y0)
    c = corner(x0 ^ y1)
    d = corner(x1 ^ y1)
    low = a + u * (b - a)
    return (low + v * (c + u * (d - c) - low)) * 2.3841858e-7 - 1.0


@wp.func
def fractal(x: float, y: float, seed: int, wave: float, octaves: int, gain: float, foot: float) -> float:
    """Octaves of noise from wavelength ``wave`` (metres) down, each turned and weaker by ``gain``."""
    total = wp.float32(0.0)
    strength = wp.float32(1.0)
    resolved = 0.7 * wave / foot
    px = x / wave
    py = y / wave
    for i in range(octaves):
        if resolved > 1.0:
            total += strength * wp.min(resolved - 1.0, 1.0) * noise(px, py, seed + i)
        strength *= gain
        resolved *= 0.47
        turned = 1.7021277 * px - 1.2765957 * py  # a turn by 37 degrees, and 1 / 0.47
        py = 1.2765957 * px + 1.7021277 * py + 17.3
        px = turned
    return total


@wp.func
def band(x: float, low: float, high: float, width: float) -> float:
    """Box-filtered share of [low, high] (within the unit cell) at cell coordinate ``x`` for a filter of ``width``."""
    f = x - wp.floor(x)
    w = wp.max(width, 0.001)
    sharp = wp.clamp((f - low) / w + 0.5, 0.0, 1.0) - wp.clamp((f - high) / w + 0.5, 0.0, 1.0)
    far = wp.clamp(w * 1.6 - 0.6, 0.0, 1.0)
    return sharp + far * (high - low - sharp)


@wp.func
def line(distance: float, half: float, foot: float) -> float:
    """Filtered share of a single line of half width ``half`` at ``distance`` from its axis."""
    w = wp.max(foot, 0.001)
    d = wp.abs(distance)
    return wp.clamp((half - d) / w + 0.5, 0.0, 1.0) * wp.min(1.0, 2.0 * half / w + 0.0)


@wp.func
def mix(a: wp.vec3, b: wp.vec3, s: float) -> wp.vec3:
    return a + (b - a) * s


@wp.func
def wall(p: wp.vec3, normal: wp.vec3, material: int, paint: wp.vec4, shape: wp.vec4, seed: int, foot: float) -> wp.vec3:
    """A facade: rows of windows by height, columns along the wall; glass differs from window to window."""
    flat = wp.max(wp.sqrt(normal[0] * normal[0] + normal[1] * normal[1]), 1.0e-6)
    u = (p[1] * normal[0] - p[0] * normal[1]) / flat - shape[0]
    h = p[2] - shape[1]
    base = wp.vec3(paint[0], paint[1], paint[2])
    own = seed + int(paint[3] * 60000.0)
    stain = 1.0 + 0.12 * fractal(u, h * 0.35, own, 3.5, 4, 0.65, foot)
    color = base * stain
    if material == 5:  # corrugated sheets, with panel joints
        color = (
            color
            * (1.0 - 0.22 * band(u / 0.33, 0.55, 0.95, foot / 0.33))
            * (1.0 - 0.3 * band(u / 6.0, 0.0, 0.012, foot / 6.0))
        )
        if h > 0.6 and h < 3.6:  # doors
            cell = int(wp.floor(u / 6.0))
            if hash01(cell, 3, own) > 0.72:
                color = mix(
                    color,
                    wp.vec3(0.25, 0.26, 0.28) * (0.7 + hash01(cell, 5, own)),
                    band(u / 6.0, 0.25, 0.75, foot / 6.0),
                )
        return color
    if material == 6:
        course = wp.floor(h / 0.25)
        shift = 0.5 * (course - 2.0 * wp.floor(course * 0.5))
        joints = wp.max(band(h / 0.25, 0.0, 0.12, foot / 0.25), band(u / 0.5 + shift, 0.0, 0.06, foot / 0.5))
        color = mix(
            color * (0.85 + 0.3 * hash01(int(wp.floor(u / 0.5 + shift)), int(course), own)),
            wp.vec3(0.35, 0.33, 0.30),
            0.6 * joints,
        )
    if h < 0.0:
        color = color * 0.6
    storey = wp.max(shape[2], 1.0)
    bay = wp.max(shape[3], 0.5)
    if material == 4 or h < 0.0:
        return color
    row = wp.floor(h / storey)
    column = wp.floor(u / bay)
    style = hash01(11, 7, own)
    lift = hash01(int(column), int(row), own)
    left = 0.5 - (0.17 + 0.11 * style)
    bottom = 0.30
    top = 0.80
    if material == 2:
        left = 0.015
        bottom = 0.38
    if material == 3:
        left = 0.03
        bottom = 0.05
        top = 0.95
    if row < 0.5 and material == 1 and lift > 0.75:  # doors and shop windows
        bottom = 0.03
        left = 0.12
    if row < 0.5 and material == 1 and lift < 0.10:
        return color
    wu = foot / bay
    wh = foot / storey
    opening = band(u / bay, left, 1.0 - left, wu) * band(h / storey, bottom, top, wh)
    frame = band(u / bay, left - 0.03, 1.03 - left, wu) * band(h / storey, bottom - 0.03, top + 0.03, wh)
    trim = wp.vec3(0.62, 0.60, 0.56)
    if style > 0.6:
        trim = base * 0.55
    glass = wp.vec3(0.035, 0.045, 0.055) + wp.vec3(0.10, 0.13, 0.16) * lift * lift
    if lift > 0.82 and material != 3:
        glass = wp.vec3(0.42, 0.40, 0.35)  # curtains and blinds
    if material == 3:
        glass = wp.vec3(0.05, 0.09, 0.11) * (0.6 + 0.9 * lift)
    far = wp.clamp(wp.max(wu, wh) * 2.0 - 0.8, 0.0, 1.0)
    glass = mix(glass, wp.vec3(0.11, 0.12, 0.13), far)
    color = mix(color, trim, frame)
    color = mix(color, glass, opening)
    ledge = band(h / storey, 0.0, 0.05, wh)
    return color * (1.0 - 0.18 * ledge)


@wp.func
def roof(p: wp.vec3, material: int, paint: wp.vec4, shape: wp.vec4, seed: int, foot: float) -> wp.vec3:
    """Tiles, gravel, bitumen, standing seams or sedum."""
    base = wp.vec3(paint[0], paint[1], paint[2])
    own = seed + int(paint[3] * 60000.0)
    along = p[0] * shape[0] + p[1] * shape[1]
    down = p[1] * shape[0] - p[0] * shape[1]
    weather = fractal(p[0], p[1], own, 5.0, 4, 0.6, foot)
    if material == 7:
        pitch = shape[2]
        row = wp.floor(down / pitch)
        tile = hash01(int(wp.floor(along / pitch + 0.5 * row)), int(row), own) - 0.5
        fine = wp.clamp(1.6 - 2.0 * foot / pitch, 0.0, 1.0)
        color = base * (1.0 + 0.13 * weather + 0.45 * tile * fine)
        return color * (1.0 - 0.35 * band(down / pitch, 0.0, 0.22, foot / pitch))
    if material == 10:
        color = base * (1.0 + 0.05 * weather)
        return color * (1.0 - 0.30 * band(along / shape[2], 0.0, 0.10, foot / shape[2]))
    if material == 8:
        grain = fractal(p[0], p[1], own + 3, 0.8, 4, 0.8, foot)
        return base * (1.0 + 0.12 * weather + 0.15 * grain)
    if material == 11:
        patch = fractal(p[0], p[1], own + 3, 2.5, 5, 0.75, foot)
        return mix(base, wp.vec3(0.16, 0.13, 0.07), wp.clamp(0.4 + 0.5 * patch, 0.0, 1.0))
    seams = band(along / 1.0, 0.0, 0.03, foot)  # bitumen: nearly plain, sheets of 1 m
    return base * (1.0 + 0.035 * weather) * (1.0 - 0.10 * seams)


@wp.func
def foliage(p: wp.vec3, paint: wp.vec4, size: float, seed: int, foot: float) -> wp.vec3:
    """Leaf clumps with dark gaps between them."""
    x = p[0] + 0.37 * p[2]
    y = p[1] + 0.61 * p[2]
    own = seed + int(paint[3] * 60000.0)
    clumps = fractal(x, y, own, size, 4, 0.8, foot)
    color = wp.vec3(paint[0], paint[1], paint[2]) * wp.clamp(1.0 + 0.55 * clumps, 0.22, 2.2)
    return color + wp.vec3(0.02, 0.015, 0.0) * wp.max(clumps, 0.0)
