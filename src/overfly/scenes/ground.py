# mypy: ignore-errors
# Kernels are written in the language of warp, which only looks like Python.
"""Procedural ground: meadow to asphalt, streets with lane marks, pavements and crossings."""

from __future__ import annotations

import warp as wp

from overfly.scenes.textures import band, fractal, hash01, line, mix

wp.set_module_options({"enable_backward": False})


@wp.struct
class GroundData:
    kind: wp.array2d(dtype=wp.uint8)
    road: wp.array2d(dtype=wp.vec4)
    x_min: float
    y_min: float
    size: float
    turn: wp.vec2  # cos, sin of the layout's heading
    pavement: float  # width of the pavement beside a street, 0 = none
    marked: int  # whether streets carry lane marks
    wild: int  # what lies beyond the raster


@wp.func
def pick(kind: int, at: int, weight: float) -> float:
    if kind == at:
        return weight
    return 0.0


@wp.func
def cover_at(x: float, y: float, data: GroundData) -> int:
    """The cover with the largest bilinear weight: cell borders become straight, not stairs."""
    rows = data.kind.shape[0]
    cols = data.kind.shape[1]
    gx = (x - data.x_min) / data.size * float(cols) - 0.5
    gy = (y - data.y_min) / data.size * float(rows) - 0.5
    if gx < -0.5 or gy < -0.5 or gx > float(cols) - 0.5 or gy > float(rows) - 0.5:
        # Beyond the landscape: a patchwork, mostly of what the style is surrounded by.
        odds = hash01(int(wp.floor((x + 0.4 * y) / 90.0)), int(wp.floor((y - 0.4 * x) / 70.0)), 5)
        if odds < 0.5:
            return data.wild
        if odds < 0.62:
            return 5
        if odds < 0.72:
            return 6
        if odds < 0.86:
            return 11
        return 1
    i = wp.clamp(int(wp.floor(gx)), 0, cols - 2)
    j = wp.clamp(int(wp.floor(gy)), 0, rows - 2)
    a = int(data.kind[j, i])
    b = int(data.kind[j, i + 1])
    c = int(data.kind[j + 1, i])
    d = int(data.kind[j + 1, i + 1])
    if a == b and a == c and a == d:
        return a
    u = wp.clamp(gx - float(i), 0.0, 1.0)
    v = wp.clamp(gy - float(j), 0.0, 1.0)
    wa = (1.0 - u) * (1.0 - v)
    wb = u * (1.0 - v)
    wc = (1.0 - u) * v
    wd = u * v
    best = a
    most = wa + pick(a, b, wb) + pick(a, c, wc) + pick(a, d, wd)
    weight = wb + pick(b, a, wa) + pick(b, c, wc) + pick(b, d, wd)
    if weight > most:
        best = b
        most = weight
    weight = wc + pick(c, a, wa) + pick(c, b, wb) + pick(c, d, wd)
    if weight > most:
        best = c
        most = weight
    weight = wd + pick(d, a, wa) + pick(d, b, wb) + pick(d, c, wc)
    if weight > most:
        best = d
    return best


@wp.func
def road_at(x: float, y: float, data: GroundData) -> wp.vec4:
    """Signed distance to the road's axis, half width, way along, distance to the next crossing."""
    rows = data.road.shape[0]
    cols = data.road.shape[1]
    cell = data.size / float(cols)
    gx = (x - data.x_min) / cell - 0.5
    gy = (y - data.y_min) / cell - 0.5
    if rows < 2 or gx < -0.5 or gy < -0.5 or gx > float(cols) - 0.5 or gy > float(rows) - 0.5:
        return wp.vec4(1.0e4, 1.0, 0.0, 1.0e4)
    i = wp.clamp(int(wp.floor(gx)), 0, cols - 2)
    j = wp.clamp(int(wp.floor(gy)), 0, rows - 2)
    u = wp.clamp(gx - float(i), 0.0, 1.0)
    v = wp.clamp(gy - float(j), 0.0, 1.0)
    a = data.road[j, i]
    b = data.road[j, i + 1]
    c = data.road[j + 1, i]
    d = data.road[j + 1, i + 1]
    r = (a * (1.0 - u) + b * u) * (1.0 - v) + (c * (1.0 - u) + d * u) * v
    # Between two roads the way along, the sign and the width jump: take the nearest cell's.
    near = a
    if u > 0.5 and v <= 0.5:
        near = b
    if u <= 0.5 and v > 0.5:
        near = c
    if u > 0.5 and v > 0.5:
        near = d
    if wp.abs(a[2] - d[2]) > 4.0 * cell or wp.abs(b[2] - c[2]) > 4.0 * cell:
        side = near[0]
        r = (wp.vec4(wp.abs(a[0]), 0.0, 0.0, a[3]) * (1.0 - u) + wp.vec4(wp.abs(b[0]), 0.0, 0.0, b[3]) * u) * (
            1.0 - v
        ) + (wp.vec4(wp.abs(c[0]), 0.0, 0.0, c[3]) * (1.0 - u) + wp.vec4(wp.abs(d[0]), 0.0, 0.0, d[3]) * u) * v
        return wp.vec4(wp.sign(side) * r[0], near[1], near[2], 0.0)
    return wp.vec4(r[0], near[1], r[2], r[3])


@wp.func
def asphalt(x: float, y: float, seed: int, foot: float) -> wp.vec3:
    broad = fractal(x, y, seed + 40, 23.0, 3, 0.5, foot)
    grain = fractal(x, y, seed + 50, 2.1, 4, 0.75, foot)
    shade = 0.125 * (1.0 + 0.10 * broad + 0.07 * grain)
    # Patches where the surface was opened and closed again.
    cx = wp.floor(x / 7.0)
    cy = wp.floor(y / 7.0)
    odds = hash01(int(cx), int(cy), seed + 60)
    if odds > 0.86:
        mx = (cx + 0.5) * 7.0
        my = (cy + 0.5) * 7.0
        inside = line(x - mx, 0.6 + 2.2 * hash01(int(cx), int(cy), seed + 61), foot) * line(
            y - my, 0.6 + 2.2 * hash01(int(cx), int(cy), seed + 62), foot
        )
        shade = shade * (1.0 + inside * (odds - 0.93) * 5.0)
    return wp.vec3(shade, shade, shade * 1.03)


@wp.func
def paving(x: float, y: float, seed: int, foot: float) -> wp.vec3:
    weather = fractal(x, y, seed + 70, 8.0, 5, 0.75, foot)
    slab = hash01(int(wp.floor(x / 0.6)), int(wp.floor(y / 0.6)), seed + 71) - 0.5
    fine = wp.clamp(1.6 - 2.0 * foot / 0.6, 0.0, 1.0)
    joint = wp.max(band(x / 0.6, 0.0, 0.07, foot / 0.6), band(y / 0.6, 0.0, 0.07, foot / 0.6))
    shade = (0.33 + 0.055 * weather + 0.13 * slab * fine) * (1.0 - 0.3 * joint)
    return wp.vec3(shade * 1.03, shade, shade * 0.94)


@wp.func
def ground(x: float, y: float, seed: int, foot: float, data: GroundData) -> wp.vec3:
    """Reflectance of the bare ground at a place."""
    lx = x * data.turn[0] + y * data.turn[1]  # along the layout's axes
    ly = y * data.turn[0] - x * data.turn[1]
    road = road_at(x, y, data)
    away = wp.abs(road[0]) - road[1]
    if away < 0.0:
        color = asphalt(lx, ly, seed, foot)
        if data.marked != 0:
            wear = wp.clamp(0.85 + 0.5 * fractal(x, y, seed + 80, 1.2, 2, 0.7, foot), 0.0, 1.0)
            white = wp.vec3(0.62, 0.62, 0.60)
            mark = line(away + 0.35, 0.07, foot)
            if road[3] > 5.0:
                mark = wp.max(mark, line(road[0], 0.08, foot) * band(road[2] / 9.0, 0.0, 0.45, foot / 9.0))
            else:
                if road[3] > 1.2 and road[3] < 4.2 and away < -0.6:
                    mark = band(road[0] / 1.0, 0.0, 0.5, foot)
                if road[3] <= 0.8:
                    mark = 0.0
            color = mix(color, white, mark * wear)
        else:
            track = line(wp.abs(road[0]) - 0.45 * road[1], 0.35, foot)
            color = mix(color * 1.15, color * 0.85, track)
        lid = wp.floor(road[2] / 17.0)
        at = road[2] - (lid + 0.5) * 17.0
        across = road[0] - 0.5 * road[1]
        if hash01(int(lid), int(road[1] * 10.0), seed + 81) > 0.4 and at * at + across * across < 0.12:
            color = wp.vec3(0.06, 0.06, 0.06)
        return color
    if away < data.pavement:
        kerb = line(away - 0.08, 0.09, foot)
        return mix(paving(lx, ly, seed, foot), wp.vec3(0.5, 0.49, 0.47), kerb * 0.8)

    kind = cover_at(x, y, data)
    if kind == 2:
        return asphalt(lx, ly, seed + 5, foot)
    if kind == 3:
        return paving(lx, ly, seed + 6, foot)
    if kind == 9:
        color = asphalt(lx, ly, seed + 7, foot)
        stall = band(lx / 2.5, 0.0, 0.05, foot / 2.5) * band(ly / 16.0, 0.0, 0.625, foot / 16.0)
        row = line(ly - 16.0 * (wp.floor(ly / 16.0) + 0.3125), 0.06, foot)
        return mix(color, wp.vec3(0.6, 0.6, 0.58), 0.85 * wp.max(stall, row))
    if kind == 8:
        swell = fractal(x, y, seed + 90, 30.0, 2, 0.5, foot)
        return wp.vec3(0.022, 0.04, 0.042) * (1.0 + 0.12 * swell)

    broad = fractal(x, y, seed, 60.0, 3, 0.6, foot)
    grain = fractal(x, y, seed + 20, 3.1, 5, 0.75, foot)
    if kind == 4:
        return wp.vec3(0.30, 0.28, 0.25) * (1.0 + 0.06 * broad + 0.16 * grain)
    if kind == 12:
        return wp.vec3(0.20, 0.18, 0.16) * (1.0 + 0.06 * broad + 0.22 * grain)
    if kind == 10:
        return wp.vec3(0.25, 0.19, 0.12) * (1.0 + 0.15 * broad + 0.14 * grain)
    if kind == 7:
        color = wp.vec3(0.075, 0.075, 0.035) * (1.0 + 0.2 * broad)
        return mix(color * (1.0 + 0.35 * grain), wp.vec3(0.10, 0.07, 0.04), wp.clamp(0.35 + 0.4 * grain, 0.0, 1.0))
    if kind == 5 or kind == 6 or kind == 13:
        green = wp.vec3(0.085, 0.135, 0.035)
        pitch = 1.5
        if kind == 13:
            green = wp.vec3(0.30, 0.24, 0.10)
            pitch = 3.1
        if kind == 6:
            green = wp.vec3(0.20, 0.145, 0.095)
            pitch = 2.8
        rows = band((lx + 0.25 * ly + 0.3 * broad) / pitch, 0.0, 0.5, foot / pitch)
        tram = band((lx + 0.25 * ly) / 18.0, 0.0, 0.03, foot / 18.0)
        return green * (1.0 + 0.10 * broad + 0.07 * grain) * (0.90 + 0.2 * rows) * (1.0 - 0.25 * tram)
    if kind == 1:
        stripe = band(lx / 3.6, 0.0, 0.5, foot / 3.6)
        return wp.vec3(0.085, 0.145, 0.04) * (1.0 + 0.10 * broad + 0.05 * grain) * (0.96 + 0.08 * stripe)
    if kind == 11:  # beds, shrubs and bare spots at the scale of a garden
        spots = fractal(x, y, seed + 30, 5.0, 5, 0.75, foot)
        color = mix(wp.vec3(0.09, 0.14, 0.045), wp.vec3(0.17, 0.14, 0.08), wp.clamp(spots * 0.9 - 0.1, 0.0, 1.0))
        return mix(color, wp.vec3(0.04, 0.07, 0.025), wp.clamp(-spots * 1.2 - 0.2, 0.0, 1.0)) * (1.0 + 0.10 * grain)
    dry = wp.clamp(0.5 + 0.45 * broad, 0.0, 1.0)  # meadow: broad and faint, honestly hard to match
    return mix(wp.vec3(0.085, 0.135, 0.04), wp.vec3(0.14, 0.15, 0.06), dry) * (1.0 + 0.085 * grain)
