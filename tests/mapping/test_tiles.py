"""A cloud in tiles: the same points however it is cut, killed, resumed or damaged."""

from __future__ import annotations

import errno
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from overfly.cloud import Cloud
from overfly.errors import Damaged, InputError
from overfly.mapping.depth_map import DepthMap
from overfly.mapping.fuse import fuse
from overfly.mapping.layout import Layout
from overfly.mapping.parts import read_part, read_squares, write_part
from overfly.mapping.stereo import stereo
from overfly.mapping.thinning import BLOCK, accompanied
from overfly.mapping.tiles import Tiles, keep_tiles, kept_tiles, write_tile, write_tiles, written_tile


@pytest.fixture(scope="module")
def flight(hill, strips, camera, tmp_path_factory) -> tuple[list[DepthMap], list[Any]]:  # type: ignore[no-untyped-def]
    folder = tmp_path_factory.mktemp("maps")
    frames = hill.frames(folder, camera, [*strips[:3], *strips[5:]], known=True)
    return stereo(frames, workdir=folder / "work"), frames


VOXEL = 0.05
"""A fifth of the sampling, so that one block of voxels is 6 m and there are many tiles."""


def rows(cloud: Cloud) -> np.ndarray:
    """All that is known of each point, in an order of its own."""
    table = np.column_stack(
        [cloud.points, cloud.colors, cloud.confidence, cloud.sigma_m, cloud.views, cloud.predicted]  # type: ignore[list-item]
    )
    return table[np.lexsort(table.T)]


def contents(tiles: Tiles) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in sorted(tiles.folder.iterdir())}


@pytest.mark.parametrize("voxel", [None, VOXEL, 0.31])
def test_tiles_have_no_seams(flight, tmp_path: Path, voxel: float | None) -> None:  # type: ignore[no-untyped-def]
    maps, frames = flight
    one = fuse(maps, frames, workdir=tmp_path / "one", voxel_m=voxel)
    many = fuse(maps, frames, workdir=tmp_path / "many", voxel_m=voxel, tile_points=5000)
    assert len(one.tiles) == 1
    assert len(many.tiles) >= (20 if voxel == VOXEL else 4)
    np.testing.assert_array_equal(rows(many.whole()), rows(one.whole()))
    assert not list((tmp_path / "many").glob("points-*")), "parts that no tile needs any more were kept"
    layout = Layout.read(tmp_path / "many" / "layout.json")
    assert layout is not None
    for tile in many:
        at = np.floor(tile.points[:, :2] / layout.voxel)
        assert any(((at >= low) & (at < high)).all() for low, high in layout.tiles)
        assert len(np.unique(np.floor(tile.points / layout.voxel), axis=0)) >= 0.5 * len(tile)


def test_strays_are_left_out_alone_and_kept_in_company() -> None:
    crowd = np.random.default_rng(0).uniform(0, 4, (200, 3))
    stray = [[100.0, 3, 3], [-1e7, 0, 0], [3e9, 3e9, 3e9]]
    five = np.random.default_rng(1).uniform(60, 61, (5, 3))
    kept = accompanied(np.concatenate([crowd, stray, five]), 0.5)
    assert kept[:200].all()
    assert not kept[200:].any()
    assert accompanied(np.concatenate([five, five[:1] + 0.1]), 0.5).all()


class Stopped(KeyboardInterrupt):
    """A kill, at a moment that the test chooses."""


@pytest.mark.parametrize("moment", [0, 2, 5, 6, 9, 14])
def test_a_kill_at_any_moment_changes_no_bit(flight, tmp_path: Path, moment: int) -> None:  # type: ignore[no-untyped-def]
    maps, frames = flight
    settings: dict[str, Any] = {"voxel_m": VOXEL, "tile_points": 5000}
    whole = contents(fuse(maps, frames, workdir=tmp_path / "whole", **settings))
    calls = 0
    made: list[int] = []

    def stop(done: int, total: int) -> None:
        nonlocal calls
        calls += 1
        if calls > moment:
            raise Stopped

    with pytest.raises(Stopped):
        fuse(maps, frames, workdir=tmp_path / "cut", progress=stop, progress_of_tiles=stop, **settings)
    (tmp_path / "cut" / "points-00003.npz.part").write_bytes(b"half")  # as a process leaves it that is killed outright
    parts = {p: p.stat().st_mtime_ns for p in (tmp_path / "cut").glob("*.npz")}
    tiles = {p: p.stat().st_mtime_ns for p in (tmp_path / "cut").glob("tiles/*.npz")}
    # Another amount of memory than before must not change what comes out.
    again = fuse(maps, frames, workdir=tmp_path / "cut", progress=lambda k, n: made.append(k), voxel_m=VOXEL,
                 tile_points=5000 if moment < 6 else 10**6)  # fmt: skip
    assert contents(again) == whole
    assert all(p.stat().st_mtime_ns == t for p, t in tiles.items()), "finished tiles were made again"
    assert all(p.stat().st_mtime_ns == t for p, t in parts.items() if p.exists()), "finished parts were made again"


def test_damaged_parts_tiles_and_masks_are_made_again(flight, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    maps, frames = flight
    settings: dict[str, Any] = {"voxel_m": VOXEL, "tile_points": 5000}
    whole = contents(fuse(maps, frames, workdir=tmp_path / "whole", **settings))
    calls = 0

    def stop(done: int, total: int) -> None:
        nonlocal calls
        calls += 1
        if calls == 60:
            raise Stopped

    work = tmp_path / "cut"
    with pytest.raises(Stopped):
        fuse(maps, frames, workdir=work, progress_of_tiles=stop, **settings)
    (work / "points-00005.npz").write_bytes((work / "points-00005.npz").read_bytes()[:-500])
    (work / "points-00004.npz").unlink()
    flip(work / "points-00003.npz", 0.5)
    (work / "given-00002.npz").write_bytes(b"")
    flip(min((work / "tiles").glob("*.npz")), 0.7)
    assert contents(fuse(maps, frames, workdir=work, **settings)) == whole


def flip(path: Path, where: float) -> None:
    """Change one byte of a file."""
    content = bytearray(path.read_bytes())
    content[int(where * len(content))] ^= 0xFF
    path.write_bytes(content)


@pytest.mark.parametrize("harm", ["cut off", "changed", "empty"])
def test_a_damaged_depth_map_is_found_and_made_again(
    hill, strips, camera, tmp_path: Path, harm: str  # type: ignore[no-untyped-def]
) -> None:  # fmt: skip
    frames = hill.frames(tmp_path, camera, strips[:2], known=True)
    maps = stereo(frames, workdir=tmp_path / "work")
    before = [m.load() for m in maps]
    path = maps[1].path
    if harm == "changed":
        flip(path, 0.5)
    else:
        path.write_bytes(path.read_bytes()[: 10_000 if harm == "cut off" else 0])
    with pytest.raises(Damaged, match="depth-00001"):
        maps[1].load()
    (tmp_path / "work" / "pair-00000-00001.npy").write_bytes(b"\x93NUMPY")
    again = stereo(frames, workdir=tmp_path / "work")
    for old, new in zip(before, again, strict=True):
        for name, values in new.load().items():
            np.testing.assert_array_equal(values, old[name])


def test_a_full_disk_loses_only_the_part_that_was_written(
    flight, tmp_path: Path, monkeypatch: pytest.MonkeyPatch  # type: ignore[no-untyped-def]
) -> None:  # fmt: skip
    maps, frames = flight
    whole = contents(fuse(maps, frames, workdir=tmp_path / "whole"))
    real, calls = np.savez, 0

    def full(file: Any, **arrays: Any) -> None:
        nonlocal calls
        calls += 1
        if calls > 7:
            file.write(b"half")
            raise OSError(errno.ENOSPC, "No space left on device")
        real(file, **arrays)

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez", full)
        with pytest.raises(OSError, match="No space left"):
            fuse(maps, frames, workdir=tmp_path / "cut")
    assert len(list((tmp_path / "cut").glob("points-*.npz"))) == 3
    assert not list((tmp_path / "cut").rglob("*.part"))
    assert contents(fuse(maps, frames, workdir=tmp_path / "cut")) == whole


def some_cloud(n: int = 3000) -> Cloud:
    rng = np.random.default_rng(5)
    return Cloud(
        rng.uniform([-700, -300, 0], [500, 900, 20], (n, 3)),
        rng.integers(0, 255, (n, 3), dtype=np.uint8),
        rng.random(n, dtype=np.float32),
        rng.random(n, dtype=np.float32),
        rng.integers(1, 9, n, dtype=np.uint8),
        rng.random(n) < 0.2,
    )


def test_a_frames_points_are_read_square_by_square(tmp_path: Path) -> None:
    cloud = some_cloud()
    apart = np.where(cloud.points[:, 2] > 15, 30, 0).astype(np.uint8)
    part = write_part(tmp_path / "a.npz", cloud, apart, gsd=0.4)
    assert part.side == 128  # the power of two from 256 ground pixels on
    again = read_part(tmp_path / "a.npz")
    np.testing.assert_array_equal(again.squares, part.squares)
    assert part.counts.sum() == len(cloud)
    low, high = np.array([-50.0, 0.0]), np.array([10.0, 20.0])
    records = read_squares(tmp_path / "a.npz", part.touched(low, high))
    inside = ((cloud.points[:, :2] >= low) & (cloud.points[:, :2] <= high)).all(1)
    assert {tuple(p) for p in cloud.points[inside]} <= {tuple(p) for p in records["points"]}
    assert len(records) < len(cloud) / 10
    np.testing.assert_array_equal(records["apart"] == 30, records["points"][:, 2] > 15)
    assert not len(write_part(tmp_path / "b.npz", cloud[:0], apart[:0], float("nan")).squares)
    assert not len(read_part(tmp_path / "b.npz").touched(low, high))


def test_samples_are_points_of_the_cloud_without_repetition(tmp_path: Path) -> None:
    cloud = some_cloud()
    tiles = write_tiles(tmp_path, [cloud[:100], cloud[100:100], cloud[100:]])
    assert (len(tiles), len(tiles.tiles)) == (3000, 2)
    assert cloud.predicted is not None
    assert tiles.predicted == cloud.predicted.sum()
    np.testing.assert_array_equal(rows(tiles.whole()), rows(cloud))
    np.testing.assert_array_equal(rows(tiles.sample(5000)), rows(cloud))
    few = tiles.sample(700, seed=3)
    assert len(np.unique(few.points, axis=0)) == len(few) == 700
    assert {tuple(p) for p in few.points} <= {tuple(p) for p in cloud.points}
    np.testing.assert_array_equal(few.points, tiles.sample(700, seed=3).points)
    assert 5 < np.isin(few.points[:, 0], cloud.points[:100, 0]).sum() < 45  # its share of 23
    assert sum(map(len, tiles.some(10**6))) == 3000
    up = tiles.moved(lambda c: c.with_points(c.points + np.array([0, 0, 50.0]), 32633))
    np.testing.assert_array_equal(up.bounds[:, :, 2], tiles.bounds[:, :, 2] + 50)
    assert up.whole().epsg == 32633


@pytest.mark.parametrize("harm", ["cut off", "changed", "gone", "index"])
def test_damage_is_named_when_tiles_are_read(tmp_path: Path, harm: str) -> None:
    cloud, (made, kept) = some_cloud(), (tmp_path / "made", tmp_path / "kept")
    tiles = write_tiles(made, [cloud[:900], cloud[900:]])
    kept.mkdir()
    keep_tiles(tiles, kept)
    shutil.rmtree(made)
    np.testing.assert_array_equal(rows(kept_tiles(kept).whole()), rows(cloud))
    path = kept / ("index.json" if harm == "index" else "tile-0001.npz")
    if harm == "gone":
        path.unlink()
    elif harm == "changed":
        flip(path, 0.4)
    else:
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(Damaged, match=f"{path.name} is damaged"):
        kept_tiles(kept)


def test_a_tile_that_holds_nothing_is_finished_too(tmp_path: Path) -> None:
    write_tile(tmp_path, "a", some_cloud()[:0])
    found = written_tile(tmp_path, "a")
    assert found is not None
    assert found.points == 0
    assert written_tile(tmp_path, "b") is None


def test_maps_without_any_depth_are_refused(flight, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    maps, frames = flight
    nothing = {k: np.zeros_like(v) if k == "support" else v for k, v in maps[0].load().items()}
    nothing["depth"] = np.full_like(nothing["depth"], np.nan)
    np.savez(tmp_path / "none.npz", **nothing)
    blind = [DepthMap(m.name, m.camera, m.world_from_camera, m.partners, tmp_path / "none.npz") for m in maps]
    with pytest.raises(InputError, match="no depth in any pair"):
        fuse(blind, frames, workdir=tmp_path / "work")


def test_tiles_end_where_the_filters_cells_do() -> None:
    from overfly.mapping.frame_points import AWAY, NEAR
    from overfly.mapping.thinning import CROWD

    assert BLOCK % CROWD == BLOCK % NEAR == BLOCK % AWAY == 0
