"""Synthetic flights: over procedural styles and over the user's own scenes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from overfly.cloud import Cloud, write_cloud
from overfly.data.record import read_record
from overfly.data.synthetic import SyntheticFlights
from overfly.errors import InputError
from overfly.geometry import unproject


def flights(tmp_path: Path, **changes: Any) -> SyntheticFlights:
    settings: dict[str, Any] = {
        "styles": ["suburb"], "unseen_styles": [], "images": {"test": 4}, "images_per_flight": 4, "cells": None,
        "altitude": 60, "overlap": 60, "side_overlap": None, "flight_path": {"name": "grid"}, "flight_paths": None,
        "camera": "mavic3e", "image_size": (64, 48), "supersample": 1, "seed": 3, "cache_dir": str(tmp_path / "cache"),
        "processes": 1,
    }  # fmt: skip
    return SyntheticFlights(**settings | changes)


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A level field of 300 x 200 m, 30 m over zero, with a hall 12 m high in the middle: a coloured cloud."""
    x, y = np.meshgrid(np.arange(0.5, 300), np.arange(0.5, 200))
    z = np.where((np.abs(x - 150) < 20) & (np.abs(y - 100) < 15), 42.0, 30.0)
    points = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    path = tmp_path_factory.mktemp("scene") / "hall.laz"
    write_cloud(Cloud(points, np.full(points.shape, (90, 120, 60), np.uint8)), path)
    return path


@pytest.mark.parametrize("altitude", [60, 240])
def test_a_scene_from_a_file_is_flown_over_where_it_is(hall: Path, tmp_path: Path, altitude: float) -> None:
    source = flights(tmp_path, styles=[str(hall)], altitude=altitude, overlap=80)
    (folder,) = source.prepare("test")
    record = read_record(folder)
    assert len(record) == 4
    seen = record.depth > 0
    assert seen.mean() == 1 if altitude == 60 else 0.1 < seen.mean() < 0.9  # from 240 m beyond its ends, too
    heights = []
    for depth, camera, pose in zip(record.depth, record.cameras, record.world_from_camera, strict=True):
        rows, columns = np.nonzero(depth > 0)
        pixels = np.stack([columns + 0.5, rows + 0.5], 1)
        heights.append(unproject(pixels, depth[rows, columns], camera, pose)[:, 2])
    assert np.quantile(np.concatenate(heights), [0.02, 0.995]) == pytest.approx([30, 42], abs=0.3)
    assert record.ground_height == pytest.approx(30, abs=1.5)
    assert np.median(record.world_from_camera[:, 2, 3]) == pytest.approx(30 + altitude, abs=2)


@pytest.mark.parametrize("path", ["circular", "random"])
def test_no_frame_looks_past_a_scene_from_a_file(hall: Path, tmp_path: Path, path: str) -> None:
    settings = {"images": {"test": 16}, "images_per_flight": 16, "flight_path": {"name": path}}
    (folder,) = flights(tmp_path, styles=[str(hall)], **settings).prepare("test")
    record = read_record(folder)
    assert len(record) == 16
    assert (record.depth > 0).mean((1, 2)).min() > 0.45


def test_a_scene_that_is_too_small_for_the_flight_is_one_sentence(hall: Path, tmp_path: Path) -> None:
    source = flights(tmp_path, styles=[str(hall)], altitude=450, overlap=30)
    with pytest.raises(InputError, match=r"only 0 frames over this scene.*fly lower or overlap more"):
        source.prepare("test")


def test_another_file_of_the_same_name_is_another_flight(hall: Path, tmp_path: Path) -> None:
    first = flights(tmp_path, styles=[str(hall)]).jobs("test")[0].key
    assert flights(tmp_path, styles=[str(hall)]).jobs("test")[0].key == first
    (hall.parent / "orthophoto.tif").write_bytes(b"other colours")
    colored = flights(tmp_path, styles=[str(hall)]).jobs("test")[0].key
    os.utime(hall, ns=(1, 1))
    assert len({first, colored, flights(tmp_path, styles=[str(hall)]).jobs("test")[0].key}) == 3


def test_neither_a_style_nor_a_file_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"'suburbs' is unknown; did you mean 'suburb'\?.*a file of a scene"):
        flights(tmp_path, styles=["suburbs"])


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"images": {"train": -1}}, "images.train=-1 is not possible"),
        ({"images": {"train": "abc"}}, "images.train=abc is not possible"),
        ({"images": {"train": 1.5}}, "images.train=1.5 is not possible"),
        ({"images": 5}, "a number for each of train, val"),
        ({"cells": []}, "at least one"),
        ({"cells": [{"altitude": 100}]}, "overlap .0 to 95 percent., share"),
        ({"cells": [{"altitude": 5, "overlap": 60, "share": 1}]}, "altitude .20 to 500 m."),
        ({"cells": [{"altitude": 60, "overlap": 60, "share": 0}]}, "share .above 0."),
        ({"cells": [{"altitude": 60, "overlap": 60, "share": 1, "path": "grid"}]}, "flight_path="),
        ({"cells": [{"altitude": 60, "overlap": 60, "share": 1, "flight_path": {"name": "gird"}}]}, "'grid'"),
        ({"flight_path": {"name": "grid", "heading": 5}}, "did you mean 'flight_path.heading_deg'"),
    ],
)
def test_counts_cells_and_paths_that_cannot_be_are_one_sentence(
    changes: dict[str, Any], says: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=says):
        flights(tmp_path, **changes)


def test_a_path_may_be_turned_and_a_cell_may_have_one_of_its_own(tmp_path: Path) -> None:
    path = {"name": "circular", "tilt_deg": 30}
    cells = [
        {"altitude": 60, "overlap": 60, "share": 1},
        {"altitude": 90, "overlap": 60, "share": 1, "flight_path": path},
    ]
    source = flights(tmp_path, cells=cells, flight_path={"name": "grid", "heading_deg": 45}, images={"test": 8})
    assert [job.flight_path for job in source.jobs("test")] == [{"name": "grid", "heading_deg": 45}, path]
