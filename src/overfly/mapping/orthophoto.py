"""The orthophoto: every cell of the surface model in the colour of the photograph that sees it best.

Which frames see a cell is told by a depth test (:mod:`overfly.mapping.sight`); among them, a frame is worth the more,
the steeper it looks down, the farther the cell is from the image's border, and the sharper the image is. Exposures are
evened out first (:mod:`overfly.mapping.gains`), seams then (:mod:`overfly.mapping.blend`).

Windows agree to the last bit, if each is given the surface as far as :meth:`Orthophoto.halo` around it.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import NDArray

from overfly.errors import InputError
from overfly.geodesy import Origin
from overfly.geometry import Camera
from overfly.mapping.blend import BLOCK, Canvas
from overfly.mapping.fill import FILLED, fill
from overfly.mapping.gains import balance
from overfly.mapping.lattice import STEP, Chunk, Map, anchor, chunks, on_finer, placing
from overfly.mapping.raster import Grid
from overfly.mapping.sight import DepthBuffer, Sight, walls
from overfly.mapping.visibility import Image, View
from overfly.mapping.worth import EDGE, feathered, value_of

MARGIN = 8
"""Blocks computed around a window: three for filling, two each for tone and votes, one for masks' filters."""

AMID = 3
"""Cells around doubtful ones that are as doubtful: single ones that were measured in a wood, deep between crowns."""

WIDE = 3
"""Cells that a doubtful place must measure each way: pinholes of measured ground are no wood."""


class Orthophoto:
    """Photographs laid on a surface.

    Args:
        frames: with cameras and poses in the block's frame, z up. All images are read once here, for the gains.
        overview: grid of the whole surface, coarse: an eighth of the surface model's resolution is plenty.
        heights: [rows, columns] of the overview, NaN where empty.
        origin: given, grids are in its projected CRS (``origin.crs_epsg``) and heights in its vertical one, if it has
            one; None, in the block's frame.
        image_mb: megabytes of decoded images that are kept from window to window.

    Attributes:
        gains: of the frames, see :class:`overfly.mapping.gains.Gains`.

    Raises:
        InputError: the overview is empty, no frame stands above it, or an image cannot be decoded.
    """

    def __init__(
        self,
        frames: Sequence[View],
        overview: Grid,
        heights: NDArray,
        *,
        origin: Origin | None = None,
        image_mb: float = 512,
    ) -> None:
        known = np.isfinite(heights)
        if not known.any():
            raise InputError("The surface model is empty, so there is no orthophoto: check the overlap of the images.")
        self._place, self._level = placing(origin), float(np.median(heights[known]))
        xyz = np.concatenate([overview.centres()[known], heights[known][:, None]], axis=1)
        points = self._place(xyz)
        # Single strays would tell of towers that are not there.
        low, high = np.quantile(points[:, 2], [0.001, 0.999])
        margin = 0.02 * (high - low) + 2 * overview.cell
        self._low, self._high = float(low - margin), float(high + margin)
        self.frames, self._sights = [], []
        for frame in frames:
            if frame.camera is not None and frame.world_from_camera is not None:
                pose = np.asarray(frame.world_from_camera, float)
                if pose[2, 3] > self._low:
                    self.frames.append(frame)
                    self._sights.append(Sight(frame.camera, pose, self._low, self._high))
        if not self.frames:
            raise InputError("No frame stands above the surface: check that cameras and surface model belong together.")
        self.gains = balance(self.frames, [s.outline for s in self._sights], points)
        self._tree = shapely.STRtree([s.outline for s in self._sights])
        self._reach = (self._high - self._low) * max(s.steepest for s in self._sights) + 2 * overview.cell
        self._images: OrderedDict[tuple[int, float], Image] = OrderedDict()
        self._image_bytes = image_mb * 1e6

    def halo(self, cell: float) -> float:
        """How far around a window of cells of that size the surface is needed, in the grids' unit.

        As far as the highest surface can hide the lowest one, and the cells that tones and masks are averaged over.
        """
        return self._reach + (MARGIN + 1) * BLOCK * cell

    def window(
        self, grid: Grid, surface: Grid, heights: NDArray, doubtful: NDArray[np.bool_] | None = None
    ) -> tuple[Image, NDArray[np.uint8]]:
        """The orthophoto of one window.

        Args:
            grid: the cells wanted, of any size; usually one GSD.
            surface: the surface model's grid over the window and its :meth:`halo`, as far as the surface goes.
                The cells of both should stand on multiples of their size, or windows agree but for rounding.
            heights: [rows, columns] of ``surface``, NaN where empty.
            doubtful: [rows, columns], cells of ``surface`` whose height, like that of :data:`AMID` cells around, is no
                reason to leave them blank.

        Returns:
            RGB [rows, columns, 3] and alpha [rows, columns], both uint8. Alpha is 255 where a photograph sees the cell;
            :data:`overfly.mapping.fill.FILLED` where none does: the colour is then that of seen cells of the same
            surface, at most twice :data:`overfly.mapping.fill.FILL` cells away; of pits and spikes no larger than that,
            the colour of any surface around; of a doubtful cell, that of whatever hides it. Alpha is 0, and the colour
            black, elsewhere: there no photograph tells the colour.
        """
        wide, inner = _widened(grid)
        fine = on_finer(heights, surface, wide)
        parts = list(chunks(wide, self._place, self._level))
        ground = list(chunks(surface, self._place, self._level))
        steps = walls(heights, surface.cell, ground)
        canvas = Canvas(wide.rows, wide.columns)
        window, near = shapely.union_all([p.outline for p in parts]), EDGE * grid.cell
        lifts = [p.base[2] - p.level for p in ground]  # from the grid's heights to the block's frame
        known = heights[np.isfinite(heights)]
        low, high = (known.min() + min(lifts), known.max() + max(lifts)) if known.size else (0.0, 0.0)
        here: dict[int, list[Chunk]] = {}
        for i in sorted(self._tree.query(window, predicate="dwithin", distance=near).tolist()):
            sight = self._sights[i]
            mine = [p for p in parts if sight.touches(p, near) and np.isfinite(fine[p.rows, p.columns]).any()]
            if mine:
                here[i] = mine
                between = sight.between(shapely.union_all([p.outline for p in mine]), low, high)
                aside = near + sight.coarseness(surface.cell)
                around = [p for p in ground if shapely.dwithin(between, p.outline, aside)]
                stood = [w for w in steps if shapely.dwithin(between, w.chunk.outline, aside)]
                self._draw(i, wide.cell, fine, mine, sight.buffer(heights, surface.cell, around, stood), canvas)
        rgb, worth = canvas.blended()
        filled = fill(rgb, worth, fine, np.float32(STEP * surface.cell))
        if doubtful is not None and doubtful.any():
            unsure = on_finer(_grown(doubtful), surface, wide) >= 0.5
            left = np.zeros_like(filled)
            left[inner] = (unsure & (worth == 0) & ~filled & np.isfinite(fine))[inner]
            filled |= self._through(wide.cell, fine, here, rgb, left)
        alpha = np.where(worth > 0, 255, np.where(filled, FILLED, 0)).astype(np.uint8)
        return np.ascontiguousarray(np.moveaxis(rgb, 0, -1)[inner]), alpha[inner].copy()

    def _draw(self, i: int, cell: float, fine: Map, parts: list[Chunk], depths: DepthBuffer, canvas: Canvas) -> None:
        """Draw frame ``i`` on the canvas where it sees the surface [rows, columns] of heights ``fine``."""
        import cv2

        sight = self._sights[i]
        image, camera = self._image(i, cell)
        top, left = min(p.rows.start for p in parts), min(p.columns.start for p in parts)
        free = np.full(
            (max(p.rows.stop for p in parts) - top, max(p.columns.stop for p in parts) - left), 255, np.uint8
        )
        looks = []
        for part in parts:
            u, v, depth, slope = sight.ideal(part, part.x[None, :], part.y[:, None], fine[part.rows, part.columns])
            x, y = sight.pixels(u, v, camera)
            value = value_of(x, y, depth, slope, camera, cell)
            if not value.any():
                continue
            here = (
                slice(part.rows.start - top, part.rows.stop - top),
                slice(part.columns.start - left, part.columns.stop - left),
            )
            free[here][depths.hides(u, v, depth)] = 0
            looks.append((part, here, x - np.float32(0.5), y - np.float32(0.5), value))
        soft = feathered(free) * np.float32(np.clip(self.gains.sharpness[i], 0.1, 1))
        canvas.begin()
        for part, here, x, y, value in looks:
            worth = value * soft[here]
            if (worth > 0).any():
                colors = cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
                canvas.draw((part.rows, part.columns), np.stack(cv2.split(colors)), worth)

    def _through(
        self, cell: float, fine: Map, here: dict[int, list[Chunk]], rgb: NDArray[np.uint8], left: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Colour cells that something hides in every frame from the frame that is worth most there, as if nothing did.

        Between crowns of which few were measured that is the wood itself, which hides what was interpolated in it.

        Args:
            cell: side of the cells.
            fine: heights [rows, columns].
            here: the frames that touch the window, each with the parts that it touches.
            rgb: [3, rows, columns], altered in place.
            left: the cells asked for [rows, columns].

        Returns:
            The cells that were given a colour [rows, columns].
        """
        import cv2

        best = np.zeros(left.shape, np.float32)
        for i in sorted(here, reverse=True):  # the last images drawn are still at hand
            sight, parts = self._sights[i], here[i]
            for part in parts:
                at = part.rows, part.columns
                if not left[at].any():
                    continue
                image, camera = self._image(i, cell)
                u, v, depth, slope = sight.ideal(part, part.x[None, :], part.y[:, None], fine[at])
                x, y = sight.pixels(u, v, camera)
                value = value_of(x, y, depth, slope, camera, cell)
                better = left[at] & (value > best[at])
                if better.any():
                    half = np.float32(0.5)
                    colors = cv2.remap(image, x - half, y - half, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
                    rgb[(slice(None), *at)][:, better] = colors[better].T
                    best[at][better] = value[better]
        return best > 0

    def _image(self, i: int, cell: float) -> tuple[Image, Camera]:
        """A frame in its gains, and its camera; made smaller where its pixels are finer than cells."""
        import cv2

        frame, sight = self.frames[i], self._sights[i]
        lens = frame.camera
        assert lens is not None
        key = i, cell
        if key not in self._images:
            image = frame.image()
            factor = sight.gsd / cell * lens.width / image.shape[1]
            if factor < 0.67:
                size = max(2, round(image.shape[1] * factor)), max(2, round(image.shape[0] * factor))
                image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
            table = np.clip(np.rint(np.arange(256)[:, None] * self.gains.colors[i]), 0, 255).astype(np.uint8)
            self._images[key] = np.asarray(cv2.LUT(image, table[None]))
            while len(self._images) > 1 and sum(m.nbytes for m in self._images.values()) > self._image_bytes:
                self._images.popitem(last=False)
        self._images.move_to_end(key)
        image = self._images[key]
        return image, lens.resized(image.shape[1], image.shape[0])


def _grown(cells: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Doubtful cells without pinholes and lines, and what lies amid or beside them."""
    import cv2

    wide = cv2.morphologyEx(cells.astype(np.uint8), cv2.MORPH_OPEN, np.ones((WIDE, WIDE), np.uint8))
    return np.asarray(cv2.dilate(wide, np.ones((2 * AMID + 1, 2 * AMID + 1), np.uint8)))


def _widened(grid: Grid) -> tuple[Grid, tuple[slice, slice]]:
    """The grid grown to whole blocks, counted from zero, and :data:`MARGIN` more each way; and where the grid lies."""
    left, rest_x = anchor(grid.x_min, grid.cell)
    top, rest_y = anchor(-grid.y_max, grid.cell)
    begin, first = (left // BLOCK - MARGIN) * BLOCK, (top // BLOCK - MARGIN) * BLOCK
    columns = (-(-(left + grid.columns) // BLOCK) + MARGIN) * BLOCK - begin
    rows = (-(-(top + grid.rows) // BLOCK) + MARGIN) * BLOCK - first
    wide = Grid(begin * grid.cell + rest_x, -(first * grid.cell) - rest_y, grid.cell, rows, columns)
    return wide, (slice(top - first, top - first + grid.rows), slice(left - begin, left - begin + grid.columns))
