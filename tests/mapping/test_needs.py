"""What a map may take decides what it holds, and what it holds does not grow with the flight."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from overfly.errors import InputError
from overfly.geometry import Camera
from overfly.mapping.dense import memory_budget
from overfly.mapping.map import check_memory
from overfly.mapping.needs import (
    HELD_MAPS,
    TILE_POINTS,
    allowed_gb,
    budget,
    core_seconds,
    cores,
    free_gb,
    least_gb,
    memory_gb,
)
from overfly.mapping.settings import MapSettings

LARGE = (5472, 3648)
HELD = ("tile_points", "held_maps", "sample", "workers")


def block(count: int = 4, size: tuple[int, int] = LARGE) -> Any:
    camera = Camera(*size, 4000.0, 4000.0, size[0] / 2, size[1] / 2)
    return SimpleNamespace(cameras=[camera] * count, frames=[None] * count)


@pytest.mark.parametrize("network", [True, False])
def test_memory_does_not_grow_with_the_flight(network: bool) -> None:
    assert memory_gb([LARGE] * 100, network=network) == memory_gb([LARGE] * 2000, network=network) < 6
    assert least_gb([LARGE] * 2000, network=network) < memory_gb([LARGE] * 2000, network=network)
    assert memory_gb([LARGE] * 10, 800, network=network) < memory_gb([LARGE] * 10, 1600, network=network)


def test_what_is_held_fits_into_what_is_allowed() -> None:
    from overfly.mapping.needs import _needed

    sizes = [LARGE] * 500
    least = least_gb(sizes)
    held = [budget(sizes, allowed) for allowed in np.linspace(least, 6, 20)]
    for allowed, found in zip(np.linspace(least, 6, 20), held, strict=True):
        assert _needed(sizes, 1600, True, *(getattr(found, name) for name in HELD)) <= allowed + 1e-9
    assert [b.tile_points for b in held] == sorted(b.tile_points for b in held)
    assert (held[-1].tile_points, held[-1].held_maps) == (TILE_POINTS[1], HELD_MAPS[1])
    smallest = budget(sizes, 0.01)
    assert (smallest.tile_points, smallest.held_maps) == (TILE_POINTS[0], HELD_MAPS[0])


def test_only_what_cannot_fit_is_refused() -> None:
    least = least_gb([LARGE] * 2000, network=False)
    check_memory([LARGE] * 2000, MapSettings(dense="stereo", max_memory_gb=least + 0.01))
    with pytest.raises(InputError, match=r"at the least.*--max-memory 0\.2.*--size than 1600"):
        check_memory([LARGE] * 9, MapSettings(dense="stereo", max_memory_gb=0.2))
    check_memory([LARGE] * 9, MapSettings(dense="stereo"))  # nobody said how much: the smallest is tried


def test_what_nobody_said_follows_from_the_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    assert free_gb() > 0
    monkeypatch.setattr("overfly.mapping.needs.free_gb", lambda: 3.0)
    assert allowed_gb() == 1.5
    few = memory_budget(block(2000), MapSettings(dense="stereo")).tile_points
    monkeypatch.setattr("overfly.mapping.needs.free_gb", lambda: 64.0)
    assert allowed_gb() == 6
    assert few < memory_budget(block(2000), MapSettings(dense="stereo")).tile_points


def test_cores_are_those_of_the_process_or_fewer_if_it_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    own = cores()
    assert own >= 1
    for said, meant in (("1", 1), ("4096", own), ("0", own), ("many", own)):
        monkeypatch.setenv("OMP_NUM_THREADS", said)
        assert cores() == meant


def test_no_more_frames_are_matched_side_by_side_than_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("overfly.mapping.needs.cores", lambda: 16)
    found = [budget([LARGE] * 9, allowed, network=False).workers for allowed in (0.1, 1.5, 3.0, 60.0)]
    assert found == sorted(found)
    assert found[0] == 1
    assert 1 < found[2] < found[3] == 16


def test_time_goes_with_the_matched_pixels() -> None:
    assert core_seconds([(1600, 900)] * 18) == pytest.approx(100)
    assert core_seconds([(3200, 1800)] * 36) == pytest.approx(200)
