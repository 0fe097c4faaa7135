"""Buildings: facades, flat roofs with parapets, gabled and hipped roofs; n at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from overfly.scenes import materials as m
from overfly.scenes.builder import Array, Builder, boxes, lifted, rectangle, ring_walls, turned


@dataclass
class Plots:
    """Where n rectangular buildings stand.

    Attributes:
        centre: [n, 2]; angle: [n] radians; length, width: [n] metres.
        low: [n] lowest z of the walls (below ground).
        floor: [n] z of the ground floor.
        top: [n] z of the eaves or the flat roof.
        wall: [n] wall material; wall_paint: [n, 4].
        roof: [n] roof material; roof_paint: [n, 4].
    """

    centre: Array
    angle: Array
    length: Array
    width: Array
    low: Array
    floor: Array
    top: Array
    wall: NDArray[np.int32]
    wall_paint: Array
    roof: NDArray[np.int32]
    roof_paint: Array

    def __len__(self) -> int:
        return len(self.angle)

    def __getitem__(self, index: NDArray) -> Plots:
        return Plots(**{name: value[index] for name, value in vars(self).items()})

    def ring(self, grow: ArrayLike = 0.0) -> Array:
        """Corners [n, 4, 2], counter-clockwise, moved outward by ``grow`` metres."""
        return turned(
            rectangle(self.length + 2 * np.asarray(grow), self.width + 2 * np.asarray(grow)), self.angle, self.centre
        )


def facades(builder: Builder, plots: Plots, top: Array, *, storey: float = 3.0, bay: float = 3.2) -> None:
    """The four walls of each building up to ``top`` [n], windows fitted to storeys and bays."""
    ring = plots.ring()
    walls = ring_walls(ring, plots.low[:, None], top[:, None])  # [n, 4, 4, 3]
    side = np.roll(ring, -1, 1) - ring
    length = np.linalg.norm(side, axis=-1)
    start = (ring * side).sum(-1) / np.maximum(length, 1e-9)
    height = np.maximum(plots.top - plots.floor, 1.0)
    storeys = height / np.maximum(1, np.round(height / storey))
    bays = length / np.maximum(1, np.round(length / bay))
    shape = np.stack(np.broadcast_arrays(start, plots.floor[:, None], storeys[:, None], bays), -1)
    builder.polygons(
        walls.reshape(-1, 4, 3),
        np.repeat(plots.wall, 4),
        np.repeat(plots.wall_paint, 4, axis=0),
        shape.reshape(-1, 4),
    )


def flat(builder: Builder, plots: Plots, *, parapet: ArrayLike = 0.6, storey: float = 3.2, bay: float = 3.2) -> None:
    """Buildings with a flat roof behind a parapet."""
    if not len(plots):
        return
    edge = plots.top + np.broadcast_to(parapet, len(plots))
    facades(builder, plots, edge, storey=storey, bay=bay)
    outer, inner = plots.ring(), plots.ring(-0.35)
    z = edge[:, None]
    ledge = np.stack(
        [lifted(outer, z), lifted(np.roll(outer, -1, 1), z), lifted(np.roll(inner, -1, 1), z), lifted(inner, z)], 2
    )
    trim = np.repeat(np.concatenate([plots.wall_paint[:, :3] * 0.9, plots.wall_paint[:, 3:]], 1), 4, axis=0)
    builder.polygons(ledge.reshape(-1, 4, 3), m.PAINT, trim)
    inside = ring_walls(inner, plots.top[:, None], z)[:, :, ::-1]
    builder.polygons(inside.reshape(-1, 4, 3), m.WALL_PLAIN, trim)
    builder.polygons(lifted(inner, plots.top[:, None]), plots.roof, plots.roof_paint, _ridge(plots.angle, 1.0))


def _ridge(angle: Array, pitch: ArrayLike) -> Array:
    return np.stack([np.cos(angle), np.sin(angle), np.broadcast_to(pitch, angle.shape), 0 * angle], -1)


def pitched(
    builder: Builder,
    plots: Plots,
    rise: Array,
    hip: Array,
    *,
    overhang: float = 0.45,
    storey: float = 2.8,
    bay: float = 3.0,
    pitch_m: float = 0.33,
) -> None:
    """Buildings under a ridge along their length.

    Args:
        builder: takes the triangles.
        plots: the buildings; ``top`` is the height of the eaves.
        rise: [n] ridge above the eaves, metres.
        hip: [n] how far the ridge's ends stand back from the gables, metres; 0 is a gable, half the width a hip.
        overhang: of the roof beyond the walls.
        storey, bay: sizes of the facade's grid.
        pitch_m: rows of tiles or seams.
    """
    if not len(plots):
        return
    facades(builder, plots, plots.top, storey=storey, bay=bay)
    n = len(plots)
    half_l, half_w = plots.length / 2, plots.width / 2
    hip = np.minimum(hip, half_l - 0.05)
    is_hip = hip > 0.05
    slope = rise / half_w
    drop = overhang * slope
    zero = np.zeros(n)
    over = overhang + zero
    end = half_l - hip + np.where(is_hip, 0, over)  # gables' roofs reach out over the end walls
    ridge = turned(np.stack([np.stack([-end, zero], -1), np.stack([end, zero], -1)], 1), plots.angle, plots.centre)
    ridge = lifted(ridge, (plots.top + rise)[:, None])
    eaves = lifted(plots.ring(over), (plots.top - drop)[:, None])
    sides = np.stack([eaves[:, 0], eaves[:, 1], ridge[:, 1], ridge[:, 0]], 1)
    back = np.stack([eaves[:, 2], eaves[:, 3], ridge[:, 0], ridge[:, 1]], 1)
    rows = _ridge(plots.angle, pitch_m)
    builder.polygons(
        np.concatenate([sides, back]), np.tile(plots.roof, 2), np.tile(plots.roof_paint, (2, 1)), np.tile(rows, (2, 1))
    )
    across = _ridge(plots.angle + np.pi / 2, pitch_m)
    ends = np.concatenate(
        [
            np.stack([eaves[:, 1], eaves[:, 2], ridge[:, 1]], 1)[is_hip],
            np.stack([eaves[:, 3], eaves[:, 0], ridge[:, 0]], 1)[is_hip],
        ]
    )
    builder.polygons(
        ends, np.tile(plots.roof[is_hip], 2), np.tile(plots.roof_paint[is_hip], (2, 1)), np.tile(across[is_hip], (2, 1))
    )
    gable = ~is_hip
    ring = lifted(plots.ring(), plots.top[:, None])
    tip = turned(np.stack([np.stack([half_l, zero], -1), np.stack([-half_l, zero], -1)], 1), plots.angle, plots.centre)
    tip = lifted(tip, (plots.top + rise)[:, None])
    triangles = np.concatenate(
        [
            np.stack([ring[:, 1], ring[:, 2], tip[:, 0]], 1)[gable],
            np.stack([ring[:, 3], ring[:, 0], tip[:, 1]], 1)[gable],
        ]
    )
    builder.polygons(triangles, m.WALL_PLAIN, np.tile(plots.wall_paint[gable], (2, 1)), (0, -1e4, 3, 3))


def chimneys(builder: Builder, plots: Plots, rise: Array, rng: np.random.Generator) -> None:
    """One chimney through each roof."""
    n = len(plots)
    if not n:
        return
    local = np.stack([rng.uniform(-0.25, 0.25, n) * plots.length, rng.choice([-0.18, 0.18], n) * plots.width], -1)
    centre = turned(local[:, None], plots.angle, plots.centre)[:, 0]
    size = np.stack([np.full(n, 0.7), np.full(n, 0.6), rise * 0.7 + 1.1], -1)
    boxes(
        builder, centre, plots.angle, size, plots.top + 0.3, np.c_[np.tile([0.30, 0.13, 0.09], (n, 1)), rng.random(n)]
    )


def roof_boxes(builder: Builder, plots: Plots, rng: np.random.Generator, per_area: float = 1 / 140) -> None:
    """Air conditioning, stair heads and skylights on flat roofs, ``per_area`` pieces to a square metre."""
    count = rng.poisson(np.clip(plots.length * plots.width * per_area, 0, 40))
    which = np.repeat(np.arange(len(plots)), count)
    n = len(which)
    if not n:
        return
    spread = np.stack([plots.length, plots.width], -1)[which] / 2 - 2.0
    local = rng.uniform(-1, 1, (n, 2)) * np.maximum(spread, 0.2)
    kind = rng.random(n)
    size = np.stack([rng.uniform(0.9, 3.2, n), rng.uniform(0.9, 2.4, n), rng.uniform(0.5, 1.6, n)], -1)
    size[kind > 0.9] = [4.2, 3.0, 2.6]
    limit = np.minimum(plots.length, plots.width)[which, None] * 0.4
    size[:, :2] = np.minimum(size[:, :2], limit)
    grey = rng.uniform(0.22, 0.6, n)
    centre = turned(local[:, None], plots.angle[which], plots.centre[which])[:, 0]
    boxes(builder, centre, plots.angle[which], size, plots.top[which], np.c_[grey, grey, grey * 1.02, rng.random(n)])


def solar(builder: Builder, plots: Plots, rng: np.random.Generator) -> None:
    """Rows of tilted solar panels on flat roofs."""
    for i in range(len(plots)):
        half_l, half_w = plots.length[i] / 2 - 2.5, plots.width[i] / 2 - 2.0
        if min(half_l, half_w) < 2:
            continue
        rows = np.arange(-half_w, half_w - 1.2, 2.4)
        k = len(rows)
        a = np.array([[-half_l, 0], [half_l, 0], [half_l, 1.5], [-half_l, 1.5]])
        local = a[None] + np.stack([np.zeros(k), rows], -1)[:, None]
        xy = turned(local, np.full(k, plots.angle[i]), np.tile(plots.centre[i], (k, 1)))
        z = plots.top[i] + np.array([0.25, 0.25, 0.75, 0.75])
        paint = np.c_[np.tile([0.03, 0.035, 0.06], (k, 1)), rng.random(k)]
        builder.polygons(lifted(xy, z), m.SOLAR, paint, _ridge(np.full(k, plots.angle[i]), 1.0))
