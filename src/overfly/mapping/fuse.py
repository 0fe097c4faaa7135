"""Depth maps of many frames become one cloud: checked against each other, averaged where they agree, no place twice.

First every frame writes down the points that the frames before it have not given (:mod:`overfly.mapping.parts`); then
the map is cut into tiles, and each is thinned and filtered with what it needs to know of its neighbours
(:mod:`overfly.mapping.thinning`). Both are kept as they are finished: a kill loses one frame's points or one tile, and
memory holds a few frames or one tile whatever the size of the flight.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from overfly.errors import Damaged, InputError
from overfly.files import load_arrays, save_arrays
from overfly.flights import Frame
from overfly.mapping.compared import Partner
from overfly.mapping.depth_map import DepthMap
from overfly.mapping.frame_points import cleaned, frame_points
from overfly.mapping.layout import Layout, laid_out, reach
from overfly.mapping.needs import HELD_MAPS
from overfly.mapping.parts import RECORD, Part, cloud_of, read_part, read_squares, write_part
from overfly.mapping.thinning import MARGIN, thinned_tile, voxels, within
from overfly.mapping.tiles import Tiles, finished, write_tile, written_tile

Progress = Callable[[int, int], None]

TILE_POINTS = 4_000_000
"""Points of all frames, before thinning, in a tile."""


def fuse(
    depth_maps: Sequence[DepthMap],
    frames: Sequence[Frame],
    *,
    workdir: Path,
    voxel_m: float | None = None,
    single: bool = True,
    walls: bool = False,
    tile_points: int = TILE_POINTS,
    held: int = HELD_MAPS[1],
    progress: Progress | None = None,
    progress_of_tiles: Progress | None = None,
) -> Tiles:
    """Merge depth maps into a cloud in the cameras' frame.

    Args:
        depth_maps: from :func:`overfly.mapping.stereo.stereo`.
        frames: they were made from; they give the colours.
        workdir: parts and tiles are kept here; give one folder per set of depth maps and settings.
        voxel_m: at most one point per cube of this side; None takes the median ground sampling distance of the maps.
        single: keep points that only one pair has seen, with a low confidence. At 30 % overlap they are half the map.
        walls: add what frames show of walls that nobody has matched (:mod:`overfly.mapping.walls`); the frame of
            reference is in metres.
        tile_points: about as many points, before thinning, are in memory at once; the set of points that comes out
            does not depend on it.
        held: depth maps in memory at once.
        progress: called with (maps done, maps in all).
        progress_of_tiles: called with (tiles done, tiles in all).

    Returns:
        Tiles in ``workdir/tiles``: points with colour; ``views``, the frames that measured them (2 or more; 1 if
        predicted); ``sigma_m``, the standard deviation of their height, of walls that across them; ``confidence``, the
        share of such points that was found right; ``predicted``, the word of a network alone, kept where nothing was
        matched near, or a wall.

    Raises:
        InputError: the maps hold no depth at all.
    """
    fusion = _Fusion(depth_maps, frames, workdir, single=single, walls=walls, held=held)
    layout = Layout.read(workdir / "layout.json")
    if layout is None:
        parts = []
        for k in range(len(depth_maps)):
            parts.append(fusion.part(k))
            if progress:
                progress(k + 1, len(depth_maps))
        if not any(part.counts.sum() for part in parts):
            raise InputError(
                "Stereo found no depth in any pair: the images show no texture that matches (water, snow, blur), or "
                "the cameras do not belong to them."
            )
        layout = laid_out(parts, voxel_m, tile_points)
        layout.write(workdir / "layout.json")
    folder = workdir / "tiles"
    folder.mkdir(exist_ok=True)
    tiles = []
    for t, (low, high) in enumerate(layout.tiles):
        name = f"tile-{t:05d}"
        tile = written_tile(folder, name)
        if tile is None:
            matched, guesses = fusion.points(layout, low, high)
            made = thinned_tile(cloud_of(matched), cloud_of(guesses), guesses["apart"], layout.voxel, low, high)
            tile = write_tile(folder, name, made)
        tiles.append(tile)
        for k in layout.last_needed(t):
            fusion.path(k).unlink(missing_ok=True)
        if progress_of_tiles:
            progress_of_tiles(t + 1, len(layout.tiles))
    return finished(folder, tiles)


class _Fusion:
    """The points of frames, kept in a folder and made where they are not there."""

    def __init__(
        self,
        depth_maps: Sequence[DepthMap],
        frames: Sequence[Frame],
        workdir: Path,
        *,
        single: bool,
        walls: bool,
        held: int,
    ) -> None:
        workdir.mkdir(parents=True, exist_ok=True)
        self.maps, self.workdir = depth_maps, workdir
        self.single, self.walls = single, walls
        self.frames = {frame.name: frame for frame in frames}
        self.index = {m.name: k for k, m in enumerate(depth_maps)}
        self.load = lru_cache(maxsize=held)(lambda k: cleaned(depth_maps[k]))
        self.given = lru_cache(maxsize=2 * held)(self._given)

    def path(self, k: int) -> Path:
        """Of the points of a frame."""
        return self.workdir / f"points-{k:05d}.npz"

    def part(self, k: int) -> Part:
        """What is known of the points of a frame, which are there afterwards."""
        try:
            return read_part(self.path(k))
        except Damaged:
            return self.make(k)

    def make(self, k: int) -> Part:
        """Work out the points of a frame and keep them, and which pixels it gives, for the frames after it."""
        own = self.maps[k]
        cloud, apart, given, gsd = frame_points(
            own, self.load(k), self._partners(k), self.frames[own.name], self.single, self.walls
        )
        save_arrays(self._mask(k), {"bits": np.packbits(given), "shape": np.array(given.shape)})
        return write_part(self.path(k), cloud, apart, gsd)

    def points(self, layout: Layout, low: NDArray, high: NDArray) -> tuple[NDArray, NDArray]:
        """What all frames give of a tile (:data:`overfly.mapping.parts.RECORD`): matched points, also in the margin
        around it, and guesses."""
        near, far = reach(low, high, layout.voxel)
        matched, guesses = [np.empty(0, RECORD)], [np.empty(0, RECORD)]
        for k, part in enumerate(layout.parts):
            if not len(numbers := part.touched(near, far)):
                continue
            try:
                records = read_squares(self.path(k), numbers)
            except Damaged:
                self.make(k)
                records = read_squares(self.path(k), numbers)
            at = voxels(records["points"][:, :2], layout.voxel)
            guessed = records["apart"] > 0
            matched.append(records[~guessed & within(at, low - MARGIN, high + MARGIN)])
            guesses.append(records[guessed & within(at, low, high)])
        return np.concatenate(matched), np.concatenate(guesses)

    def _partners(self, k: int) -> Iterator[Partner]:
        for name in self.maps[k].partners:
            if (j := self.index.get(name)) is not None:
                yield self.maps[j], self.load(j), self.given(j) if j < k else None

    def _mask(self, k: int) -> Path:
        return self.workdir / f"given-{k:05d}.npz"

    def _given(self, k: int) -> NDArray[np.bool_]:
        """The pixels [H, W] of a frame that later ones need not give (:func:`frame_points`)."""
        try:
            kept = load_arrays(self._mask(k))
        except Damaged:
            self.make(k)
            kept = load_arrays(self._mask(k))
        height, width = (int(n) for n in kept["shape"])
        return np.unpackbits(kept["bits"], count=height * width).reshape(height, width).astype(bool)
