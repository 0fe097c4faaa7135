"""What a map costs: memory and time by the size of its images, at measured rates; nothing heavy is imported."""

from __future__ import annotations

from collections.abc import Iterable

MEMORY_GB, MEMORY_GB_PER_MEGAPIXEL = 1.0, 0.04
"""Measured on real flights: a fixed part, and one for each megapixel of all images."""

CORE_SECONDS_PER_MEGAPIXEL = 100 / (18 * 1.6 * 0.9)
"""Of a map with estimated cameras: 100 core-seconds for 18 images of 1600 x 900, measured."""


def memory_gb(sizes: Iterable[tuple[int, int]]) -> float:
    """Memory that the map of images of these widths and heights (pixels) takes, GB."""
    return MEMORY_GB + MEMORY_GB_PER_MEGAPIXEL * sum(width * height for width, height in sizes) / 1e6


def core_seconds(sizes: Iterable[tuple[int, int]], matched_side: int = 1600) -> float:
    """Time that the map takes on one core, if images are matched at a longest side of ``matched_side`` pixels."""
    pixels = sum(width * height * min(1.0, matched_side / max(width, height)) ** 2 for width, height in sizes)
    return CORE_SECONDS_PER_MEGAPIXEL * pixels / 1e6
