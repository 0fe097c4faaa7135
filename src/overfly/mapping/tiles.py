"""A cloud of any size as a folder of tiles, squares of the plan: one at a time is in memory.

Each tile is an .npz file of the attributes of :class:`overfly.cloud.Cloud`; ``index.json`` tells of each its points,
their bounds and the CRC-32 of the file.
"""

from __future__ import annotations

import json
import os
import shutil
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from overfly.cloud import ARRAYS, Cloud, concatenate
from overfly.errors import Damaged
from overfly.files import load_arrays, replacing, save_arrays

INDEX = "index.json"
HELD = 3
"""Tiles in memory at once: what reads a map row by row comes back to the ones below."""


@dataclass(frozen=True)
class Tile:
    """What is known of a tile without reading it.

    Attributes:
        file: its name; empty where the tile has no point.
        points, predicted: how many it has, and how many of them are predicted.
        low, high: its bounds [3].
        crc32: of the file.
        epsg, vertical_epsg: CRS of the points, see :class:`overfly.cloud.Cloud`.
    """

    file: str
    points: int = 0
    predicted: int = 0
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    crc32: int = 0
    epsg: int | None = None
    vertical_epsg: int | None = None


class Tiles:
    """The cloud in a folder.

    Args:
        folder: of the tiles.
        tiles: those with points.
        change: what is done to each tile when it is read; see :meth:`moved`.
    """

    def __init__(self, folder: Path, tiles: Sequence[Tile], change: Callable[[Cloud], Cloud] | None = None) -> None:
        self.folder, self.tiles, self.change = folder, list(tiles), change
        self.tile = lru_cache(maxsize=HELD)(self._read)
        """Tile number i as a cloud."""

    def __len__(self) -> int:
        return sum(tile.points for tile in self.tiles)

    def __iter__(self) -> Iterator[Cloud]:
        # What is read once from end to end need not stay.
        read = self.tile if len(self.tiles) <= HELD else self._read
        return (read(i) for i in range(len(self.tiles)))

    def _read(self, i: int) -> Cloud:
        tile = self.tiles[i]
        cloud = Cloud(**load_arrays(self.folder / tile.file), epsg=tile.epsg, vertical_epsg=tile.vertical_epsg)
        return cloud if self.change is None else self.change(cloud)

    @property
    def predicted(self) -> int:
        """Points that are only predicted."""
        return sum(tile.predicted for tile in self.tiles)

    @cached_property
    def bounds(self) -> NDArray[np.float64]:
        """Smallest and largest coordinates of each tile [T, 2, 3]."""
        if self.change is None:
            return np.array([(tile.low, tile.high) for tile in self.tiles]).reshape(-1, 2, 3)
        return np.array([(cloud.points.min(0), cloud.points.max(0)) for cloud in self]).reshape(-1, 2, 3)

    def moved(self, change: Callable[[Cloud], Cloud]) -> Tiles:
        """The same tiles, each changed when it is read; ``change`` keeps the number and the order of points."""
        return Tiles(self.folder, self.tiles, change)

    def sample(self, most: int, seed: int = 0) -> Cloud:
        """At most so many of the points, drawn without replacement; all of them, in order, if there are no more."""
        if len(self) <= most:
            return self.whole()
        rng = np.random.default_rng(seed)
        shares = rng.multivariate_hypergeometric([tile.points for tile in self.tiles], most)
        drawn = []
        for cloud, share in zip(self, shares, strict=True):
            drawn.append(cloud[np.sort(rng.choice(len(cloud), int(share), replace=False))])
        return concatenate(drawn)

    def some(self, most: int) -> list[Cloud]:
        """Whole tiles, spread over the map, of together about so many points; at least one, if there is any."""
        each = len(self) / max(len(self.tiles), 1)
        step = max(1, int(np.ceil(len(self.tiles) * each / most))) if each else 1
        return [self._read(i) for i in range(step // 2, len(self.tiles), step)]

    def whole(self) -> Cloud:
        """The cloud in memory: for small flights."""
        return concatenate(list(self)) if self.tiles else Cloud(np.zeros((0, 3)))


def write_tile(folder: Path, name: str, cloud: Cloud) -> Tile:
    """Write a tile, atomically, and beside it what :func:`written_tile` reads back after a kill."""
    tile = Tile("")
    if len(cloud):
        path = folder / f"{name}.npz"
        save_arrays(path, {n: getattr(cloud, n) for n in ARRAYS if getattr(cloud, n) is not None})
        predicted = 0 if cloud.predicted is None else int(cloud.predicted.sum())
        low, high = (tuple(float(v) for v in end) for end in (cloud.points.min(0), cloud.points.max(0)))
        tile = Tile(path.name, len(cloud), predicted, low, high, _crc32(path), cloud.epsg, cloud.vertical_epsg)
    _write_json(folder / f"{name}.json", asdict(tile))
    return tile


def written_tile(folder: Path, name: str) -> Tile | None:
    """The tile that was written before, None if it is not there or damaged."""
    try:
        tile = _tile(json.loads((folder / f"{name}.json").read_text()))
        return tile if not tile.file or _crc32(folder / tile.file) == tile.crc32 else None
    except (OSError, ValueError, TypeError):
        return None


def write_tiles(folder: Path, clouds: Iterable[Cloud]) -> Tiles:
    """Clouds in one frame as the tiles of a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    return finished(folder, [write_tile(folder, f"tile-{i:04d}", cloud) for i, cloud in enumerate(clouds)])


def finished(folder: Path, tiles: Iterable[Tile]) -> Tiles:
    """The tiles of a folder that holds all of them, from now on told by its index."""
    kept = [tile for tile in tiles if tile.file]
    _write_json(folder / INDEX, {"tiles": [asdict(tile) for tile in kept]})
    return Tiles(folder, kept)


def keep_tiles(tiles: Tiles, folder: Path) -> None:
    """Put the tiles into another folder; no byte is copied where the file system can avoid it."""
    for name in [*(tile.file for tile in tiles.tiles), INDEX]:
        try:
            os.link(tiles.folder / name, folder / name)
        except OSError:
            shutil.copy2(tiles.folder / name, folder / name)


def kept_tiles(folder: Path) -> Tiles:
    """The tiles that :func:`keep_tiles` kept.

    Raises:
        Damaged: one of the files is missing, cut off or changed.
    """
    try:
        tiles = [_tile(entry) for entry in json.loads((folder / INDEX).read_text())["tiles"]]
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise Damaged(folder / INDEX) from error
    for tile in tiles:
        path = folder / tile.file
        if not path.is_file() or _crc32(path) != tile.crc32:
            raise Damaged(path)
    return Tiles(folder, tiles)


def _tile(entry: dict[str, Any]) -> Tile:
    return Tile(**entry | {k: tuple(v) for k, v in entry.items() if isinstance(v, list)})


def _write_json(path: Path, content: object) -> None:
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(content))


def _crc32(path: Path) -> int:
    value = 0
    with path.open("rb") as file:
        while block := file.read(2**22):
            value = zlib.crc32(block, value)
    return value
