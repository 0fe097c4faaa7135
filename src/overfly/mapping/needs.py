"""What a map costs: memory and time by the size of its images, at measured rates; nothing heavy is imported.

The memory of the dense step and the products does not grow with the number of images: a few of them are held, and one
tile of the cloud. How many and how large follows from what is allowed (:func:`budget`).
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

SIZE = 1600
"""Default of the longest side at which images are matched, pixels."""

CORE_SECONDS_PER_MEGAPIXEL = 100 / (18 * 1.6 * 0.9)
"""Of a map with estimated cameras: 100 core-seconds for 18 images of 1600 x 900, measured."""

FIXED_GB, NETWORK_GB = 0.3, 1.3
"""The program itself, and a network with its windows; measured."""

DECODED = 8
"""Bytes per pixel of the image that is being read."""

MATCHED, COMPARED, HELD = 270, 160, 24
"""Bytes per matched pixel: while pairs are matched, while depth maps are compared, and of each map held; measured."""

PER_POINT, PER_SAMPLE = 280, 400
"""Bytes per point of a tile while it is thinned, and of the sample by which figures and pictures are made; measured."""

MESH_GB, PER_FACE = 0.8, 2200
"""GB while a mesh is textured (program, sample, one photograph, one page), and bytes per face while its grid is made;
measured."""

PHOTOGRAPHS = 512e6
"""Bytes of decoded images that the orthophoto keeps at most (:class:`overfly.mapping.orthophoto.Orthophoto`)."""

SHARE = 0.2
"""Points per matched pixel that the frames give before thinning."""

TILE_POINTS = (250_000, 4_000_000)
"""Points of the smallest and the largest tile: smaller ones are mostly margin, larger ones gain nothing."""

SAMPLE = (500_000, 2_000_000)
"""Fewest and most points of the sample."""

HELD_MAPS = (3, 16)
"""Fewest and most depth maps in memory: a frame has up to a dozen partners, and what is not held is read again."""

MOST_GB = 6.0
"""What a map takes at most if nobody says how much it may."""


@dataclass(frozen=True)
class Budget:
    """How much is in memory at once.

    Attributes:
        tile_points: of a tile, before thinning.
        held_maps: depth maps.
        window: cells along a window of the rasters.
        sample: points by which figures and pictures are made.
        workers: frames that are matched side by side.
    """

    tile_points: int
    held_maps: int
    window: int
    sample: int
    workers: int


Sizes = Iterable[tuple[int, int]]
"""Widths and heights of images, pixels."""


def budget(sizes: Sizes, allowed_gb: float, matched_side: int = SIZE, *, network: bool = True) -> Budget:
    """What fits into ``allowed_gb``; the smallest possible if nothing does (:func:`least_gb`)."""
    sizes = list(sizes)
    fixed, largest, _ = _parts(sizes, matched_side, network)
    room = (allowed_gb - fixed) * 1e9
    photographs = min(PHOTOGRAPHS, 3.0 * sum(width * height for width, height in sizes))
    maps = int((room / max(largest, 1) - COMPARED) / HELD)
    return Budget(
        int(min(max(room / PER_POINT, TILE_POINTS[0]), TILE_POINTS[1])),
        min(max(maps, HELD_MAPS[0]), HELD_MAPS[1]),
        1024 if room > 1e9 else 512,
        int(min(max((room - photographs) / PER_SAMPLE, SAMPLE[0]), SAMPLE[1])),
        min(max(int(room / max(MATCHED * largest, 1)), 1), cores()),
    )


def memory_gb(sizes: Sizes, matched_side: int = SIZE, *, network: bool = True) -> float:
    """Memory that a map takes if enough is there, GB."""
    return _needed(sizes, matched_side, network, TILE_POINTS[1], HELD_MAPS[1], SAMPLE[1], cores())


def least_gb(sizes: Sizes, matched_side: int = SIZE, *, network: bool = True) -> float:
    """Memory that a map takes with the smallest tiles and the fewest images in memory, GB."""
    return _needed(sizes, matched_side, network, TILE_POINTS[0], HELD_MAPS[0], SAMPLE[0], 1)


def mesh_gb(faces: int) -> float:
    """Memory that a textured mesh of so many triangles takes, whatever the number of images, GB."""
    return MESH_GB + PER_FACE * faces / 1e9


def cores() -> int:
    """Cores that may be used: those of this process, or fewer where ``OMP_NUM_THREADS`` says so, as elsewhere."""
    own = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    said = os.environ.get("OMP_NUM_THREADS", "")
    return max(1, min(own, int(said))) if said.isdigit() and int(said) else own


def allowed_gb() -> float:
    """What a map may take if nobody says: half of what is free, at most :data:`MOST_GB`."""
    return min(MOST_GB, 0.5 * free_gb())


def free_gb() -> float:
    """Free memory of the machine, or of the container that limits it; all of it where the system does not say."""
    try:
        lines = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())
        free = int(lines["MemAvailable"].split()[0]) * 1024
    except (OSError, KeyError, ValueError):
        free = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:
        group = Path("/sys/fs/cgroup")
        limit = int((group / "memory.max").read_text())  # "max" where there is none
        free = min(free, limit - int((group / "memory.current").read_text()))
    except (OSError, ValueError):
        pass
    return max(free, 0) / 1e9


def core_seconds(sizes: Sizes, matched_side: int = SIZE) -> float:
    """Time that the map takes on one core, if images are matched at a longest side of ``matched_side`` pixels."""
    return CORE_SECONDS_PER_MEGAPIXEL * sum(_matched(size, matched_side) for size in sizes) / 1e6


def _needed(
    sizes: Sizes, matched_side: int, network: bool, tile_points: int, held: int, sample: int, workers: int
) -> float:
    sizes = list(sizes)
    fixed, largest, total = _parts(sizes, matched_side, network)
    points = SHARE * total
    photographs = min(PHOTOGRAPHS, 3.0 * sum(width * height for width, height in sizes))
    thinning, products = PER_POINT * min(tile_points, points), PER_SAMPLE * min(sample, points) + photographs
    return fixed + max(workers * MATCHED * largest, (COMPARED + HELD * held) * largest, thinning, products) / 1e9


def _parts(sizes: Sizes, matched_side: int, network: bool) -> tuple[float, float, float]:
    """GB that are always there, pixels of the largest matched image, and pixels of all."""
    sizes = list(sizes)
    matched = [_matched(size, matched_side) for size in sizes]
    decoded = max((width * height for width, height in sizes), default=0) * DECODED / 1e9
    return FIXED_GB + decoded + (NETWORK_GB if network else 0.0), max(matched, default=0.0), sum(matched)


def _matched(size: tuple[int, int], side: int) -> float:
    """Pixels of an image as it is matched."""
    return size[0] * size[1] * min(1.0, side / max(size)) ** 2
