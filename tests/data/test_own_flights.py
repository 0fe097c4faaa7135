"""The user's own flights: how their frames are shared out."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from overfly.data.folder import FolderFlights
from overfly.errors import InputError
from overfly.flights import Flight

SOURCE = FolderFlights(
    root="flown", reference=None, val_share=0.2, test_share=0.2, image_size=(64, 48), cache_dir="cache"
)


def shared_out(count: int, split: str) -> list[Any]:
    frames = [SimpleNamespace(camera=True, world_from_camera=True, number=i) for i in range(count)]
    flight = cast(Flight, SimpleNamespace(root=Path("flown"), frames=frames))
    return [cast(Any, frame).number for frame in SOURCE._frames(flight, split)]


def test_the_frames_are_shared_out_in_order() -> None:
    assert [shared_out(10, split) for split in ("train", "val", "test")] == [[0, 1, 2, 3, 4, 5], [6, 7], [8, 9]]


@pytest.mark.parametrize("count", [6, 7, 9])
def test_a_small_flight_has_two_frames_in_every_split(count: int) -> None:
    found = [shared_out(count, split) for split in ("train", "val", "test")]
    assert [len(part) for part in found[1:]] == [2, 2]
    assert [number for part in found for number in part] == list(range(count))


@pytest.mark.parametrize(("count", "left"), [(5, 1), (4, 0), (2, 0)])
def test_a_split_of_less_than_two_frames_is_refused(count: int, left: int) -> None:
    with pytest.raises(InputError, match=f"flown has {count} frames with cameras, which leaves {left} for train"):
        shared_out(count, "train")
