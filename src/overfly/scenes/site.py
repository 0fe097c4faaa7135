"""The building site of a procedural landscape: its randomness, ground, raster and mesh, and what all styles share."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from overfly.scenes import materials as m
from overfly.scenes.builder import Array, Builder, boxes
from overfly.scenes.buildings import Plots
from overfly.scenes.cover import Painter, along
from overfly.scenes.scene import Heightfield, Scene
from overfly.scenes.terrain import Relief, heightfield
from overfly.scenes.vegetation import CONE, DOME, IRREGULAR, scatter, trees
from overfly.scenes.vehicles import cars

PLASTER = np.array(
    [
        (0.62, 0.58, 0.50),
        (0.68, 0.66, 0.62),
        (0.55, 0.44, 0.30),
        (0.50, 0.36, 0.28),
        (0.58, 0.56, 0.44),
        (0.42, 0.42, 0.41),
    ]
)
BRICK = np.array([(0.30, 0.13, 0.09), (0.36, 0.20, 0.13), (0.24, 0.12, 0.10)])
TILE = np.array(
    [
        (0.31, 0.115, 0.065),
        (0.25, 0.10, 0.07),
        (0.36, 0.16, 0.09),
        (0.17, 0.09, 0.07),
        (0.10, 0.10, 0.105),
        (0.065, 0.065, 0.07),
    ]
)
FLAT_ROOF = np.array([(0.36, 0.35, 0.33), (0.22, 0.22, 0.22), (0.13, 0.13, 0.135), (0.55, 0.55, 0.54)])


class Site:
    """Everything that a style needs to build its landscape.

    Args:
        name, seed: of the scene.
        rng: the only source of randomness.
        size_m: width of the landscape.
        relief: the ground, ponds already levelled.
        painter: the raster.
    """

    def __init__(
        self, name: str, seed: int, rng: np.random.Generator, size_m: float, relief: Relief, painter: Painter
    ) -> None:
        self.name, self.seed, self.rng, self.size_m, self.painter = name, seed, rng, size_m, painter
        self.builder = Builder()
        self.field: Heightfield = heightfield(relief, size_m)
        self.detail = int(size_m <= 900)

    def scene(self) -> Scene:
        vertices, faces = self.field.mesh()
        self.builder.add(vertices, faces, self.field.normals(), m.GROUND, (0, 0, 0, 0))
        half = self.size_m / 2
        return Scene(
            name=self.name,
            terrain=self.field,
            extent=(-half, -half, half, half),
            cover=self.painter.cover(),
            seed=self.seed,
            **self.builder.arrays(),  # type: ignore[arg-type]
        )

    def world(self, local: ArrayLike) -> Array:
        return self.painter.world(local)

    @property
    def heading(self) -> float:
        return self.painter.heading

    def take(self, centre: ArrayLike, angle: float, length: float, width: float, margin: float = 0.0) -> None:
        """Mark a rectangle as taken by an object."""
        self.painter.area(centre, angle, (length + 2 * margin, width + 2 * margin), None, take=True)

    def plots(
        self,
        centre: ArrayLike,
        angle: ArrayLike,
        length: ArrayLike,
        width: ArrayLike,
        height: ArrayLike,
        wall: ArrayLike,
        wall_color: ArrayLike,
        roof: ArrayLike,
        roof_color: ArrayLike,
        *,
        take: bool = True,
    ) -> Plots:
        """Buildings of a height above their highest ground; walls reach below their lowest."""
        n = len(np.asarray(angle))
        rng = self.rng

        def each(values: ArrayLike, dtype: type = float) -> NDArray:
            return np.broadcast_to(np.asarray(values, dtype), n).copy()

        def paint(colors: ArrayLike) -> Array:
            tone = 1 + 0.10 * rng.standard_normal((n, 1))
            return np.c_[np.clip(np.broadcast_to(colors, (n, 3)) * tone, 0.015, 0.85), rng.random(n)]

        plots = Plots(
            np.asarray(centre, float).reshape(n, 2),
            each(angle),
            each(length),
            each(width),
            np.zeros(n),
            np.zeros(n),
            np.zeros(n),
            each(wall, np.int32),
            paint(wall_color),
            each(roof, np.int32),
            paint(roof_color),
        )
        ring = plots.ring()
        middles = (ring + np.roll(ring, -1, 1)) / 2
        ground = self.field(np.concatenate([ring, middles, plots.centre[:, None]], 1).reshape(-1, 2)).reshape(n, 9)
        plots.low = ground.min(1) - 1.0
        plots.floor = ground.max(1) + 0.15
        plots.top = plots.floor + each(height)
        if take:
            for i in range(n):
                self.take(plots.centre[i], plots.angle[i], plots.length[i], plots.width[i], 0.8)
        return plots

    def fits(self, centre: Array, angle: Array, length: Array, width: Array) -> NDArray[np.bool_]:
        """Which of n rectangles are free; see :meth:`Painter.fits`."""
        return np.array([self.painter.fits(*one) for one in zip(centre, angle, length, width)], bool)

    def choose(self, palette: NDArray, n: int) -> Array:
        return palette[self.rng.integers(0, len(palette), n)]

    def plant(
        self,
        xy: ArrayLike,
        height: tuple[float, float],
        *,
        conifers: float = 0.2,
        margin: float = 1.5,
        trunks: bool = True,
        slim: float = 0.30,
        tint: tuple[float, float, float] = (0.055, 0.10, 0.028),
    ) -> int:
        """Trees at the free ones of the places ``xy`` [n, 2]; returns how many."""
        xy = np.asarray(xy, float).reshape(-1, 2)
        xy = xy[self.painter.free(xy, margin)]
        n = len(xy)
        tall = self.rng.uniform(*height, n)
        odds = self.rng.random(n)
        kind = np.where(odds < conifers, CONE, np.where(odds < conifers + 0.4 * (1 - conifers), DOME, IRREGULAR))
        radius = tall * np.where(kind == CONE, 0.22, slim) * self.rng.uniform(0.85, 1.2, n)
        trees(
            self.builder, xy, self.field(xy), tall, radius, kind, self.rng, detail=self.detail, trunks=trunks, tint=tint
        )
        return n

    def bushes(self, xy: ArrayLike, height: tuple[float, float] = (0.8, 2.2)) -> None:
        """Round shrubs at the free ones of the places."""
        xy = np.asarray(xy, float).reshape(-1, 2)
        xy = xy[self.painter.free(xy, 0.5)]
        tall = self.rng.uniform(*height, len(xy))
        kind = np.full(len(xy), DOME)
        radius = tall * self.rng.uniform(0.5, 0.9, len(xy))
        trees(self.builder, xy, self.field(xy) - 0.2 * tall, tall, radius, kind, self.rng, detail=0, trunks=False)

    def inside(self, spacing: float) -> Array:
        """Places all over the landscape, about ``spacing`` metres apart."""
        half = self.size_m / 2
        return scatter(self.rng, (-half, -half), (half, half), spacing)

    def park(self, line: ArrayLike, offset: float, share: float, *, step: float = 6.2) -> None:
        """Cars on both sides of a street, ``offset`` metres from its axis; ``share`` of the places are used."""
        for side in (-1, 1):
            xy, angle = along(line, step, float(self.rng.uniform(0, step)))
            if not len(xy):
                continue
            normal = np.stack([-np.sin(angle), np.cos(angle)], -1)
            xy = xy + side * offset * normal
            used = (self.rng.random(len(xy)) < share) & self.inner(xy, 3)
            xy, angle = xy[used], angle[used]
            turn = np.where(self.rng.random(len(xy)) < 0.5, 0, np.pi)
            cars(self.builder, xy, angle + turn + self.rng.normal(0, 0.02, len(xy)), self.field(xy), self.rng)

    def inner(self, xy: Array, margin: float) -> NDArray[np.bool_]:
        return np.asarray((np.abs(xy) <= self.size_m / 2 - margin).all(-1))

    def parking(self, centre: ArrayLike, size: ArrayLike, share: float) -> None:
        """A car park along the layout's axes: stalls as the kernel draws them (2.5 m by 5 m in rows of 16 m)."""
        centre, size = np.asarray(centre, float), np.asarray(size, float)
        if not self.painter.fits(centre, self.heading, *size, inside=False):
            return
        self.painter.area(centre, self.heading, size, m.PARKING, take=True)
        c, s = np.cos(self.heading), np.sin(self.heading)
        local = np.array([centre[0] * c + centre[1] * s, centre[1] * c - centre[0] * s])
        first = np.floor((local - size / 2) / [2.5, 16.0]).astype(int)
        last = np.ceil((local + size / 2) / [2.5, 16.0]).astype(int)
        i, j = np.meshgrid(np.arange(first[0], last[0]), np.arange(first[1], last[1]))
        x = (i.ravel() + 0.52) * 2.5
        places = np.concatenate([np.stack([x, j.ravel() * 16.0 + 2.5], -1), np.stack([x, j.ravel() * 16.0 + 7.5], -1)])
        room = (np.abs(places - local) <= size / 2 - [1.5, 2.6]).all(1)
        places = places[room & (self.rng.random(len(places)) < share)]
        xy = self.world(places)
        xy = xy[self.inner(xy, 2)]
        turn = self.heading + np.where(self.rng.random(len(xy)) < 0.5, 0.5, 1.5) * np.pi
        cars(self.builder, xy, turn + self.rng.normal(0, 0.02, len(xy)), self.field(xy), self.rng)

    def walkway(self, start: ArrayLike, end: ArrayLike, width: float = 3.0, height: float = 3.2) -> None:
        """A covered walkway: a roof on posts that follows the ground, open at the sides."""
        line = np.array([start, end], float)
        xy, angle = along(line, 5.0)
        if len(xy) < 2:
            return
        middle = xy + np.stack([np.cos(angle), np.sin(angle)], -1) * 2.5
        ground = self.field(xy)
        roof = np.maximum(ground, self.field(middle)) + height
        n = len(xy)
        grey = np.c_[np.tile([0.52, 0.52, 0.50], (n, 1)), self.rng.random(n)]
        boxes(self.builder, middle, angle, np.tile([5.02, width, 0.25], (n, 1)), roof, grey)
        for side in (-1, 1):
            posts = xy + side * (width / 2 - 0.25) * np.stack([-np.sin(angle), np.cos(angle)], -1)
            size = np.stack([np.full(n, 0.22), np.full(n, 0.22), roof - ground + 0.3], -1)
            boxes(self.builder, posts, angle, size, ground - 0.3, grey * [0.6, 0.6, 0.6, 1])
        self.painter.path(line, width, m.PAVING)
