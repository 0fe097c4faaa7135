"""Walls between a measured roof and the measured ground before it, and none under anything else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from overfly.cloud import Cloud
from overfly.flights import Frame
from overfly.geometry import Array, Camera, pixel_grid, pose, rays, rotation_from_gimbal, unproject
from overfly.mapping import walls
from overfly.mapping.depth_map import DepthMap
from overfly.mapping.frame_points import frame_points
from overfly.mapping.raster import Grid, Surface
from overfly.mapping.thinning import BLOCK, WALL, thinned_tile
from overfly.mapping.walls import wall_points

CAMERA = Camera(400, 300, 300.0, 300.0, 200.0, 150.0)
DOWN = pose(rotation_from_gimbal(0, -90), [0, 0, 75])  # a ground pixel is 25 cm
EAST, WEST, NORTH, SOUTH = 22.0, 8.0, 7.0, -7.0


def house(height: float = 10.0, rough: float = 0.0, size: float = 1.0) -> NDArray[np.float32]:
    """Depth [H, W] of level ground and a house east of the camera: its west wall is seen and not matched."""
    east = WEST + size * (EAST - WEST)
    cast = rays(pixel_grid(400, 300), CAMERA) @ DOWN[:3, :3].T  # one metre along the axis is one metre down

    def on(x: Array, y: Array) -> NDArray[np.bool_]:
        return np.asarray((x > WEST) & (x < east) & (y > SOUTH * size) & (y < NORTH * size))

    roof, ground = 75 - height, 75.0
    over = on(*(cast[..., i] * roof for i in (0, 1)))
    with np.errstate(divide="ignore", invalid="ignore"):
        down = WEST / cast[..., 0]  # depth where the ray comes to the west wall
    at_wall = (down > roof) & (down < ground) & (np.abs(cast[..., 1] * down) < NORTH * size)
    depth = np.where(over, roof, np.where(at_wall, np.nan, ground))
    depth[over] += np.random.default_rng(0).normal(0, rough, over.sum()) if rough else 0
    return depth.astype(np.float32)


def test_the_wall_that_an_image_shows_is_found_where_it_is() -> None:
    depth = house()
    points, rows, columns, _ = wall_points(depth, np.isfinite(depth), CAMERA, DOWN)
    assert len(points) > 1000
    assert np.abs(points[:, 0] - WEST).max() < 0.8  # the west wall, and none of those that look away
    assert points[:, 1].min() == pytest.approx(SOUTH, abs=0.8)
    assert points[:, 1].max() == pytest.approx(NORTH, abs=0.8)
    assert points[:, 2].min() == pytest.approx(0, abs=0.3)
    assert points[:, 2].max() == pytest.approx(10, abs=0.3)
    cells = np.unique(np.floor(points[:, 1:] / 0.5), axis=0)
    assert len(cells) > 0.9 * 28 * 20  # without gaps
    assert np.isnan(depth[rows, columns]).all()  # where the image shows it


@pytest.mark.parametrize(
    ("options", "why"),
    [({"height": 2.0}, "a hedge"), ({"rough": 2.0}, "a crown"), ({"size": 0.15}, "a shed")],
)
def test_nothing_stands_under_what_is_no_house(options: dict[str, float], why: str) -> None:
    depth = house(**options)
    assert not len(wall_points(depth, np.isfinite(depth), CAMERA, DOWN)[0]), why


def test_a_guess_beside_a_roof_is_no_ground() -> None:
    """At the border of what two images share a roof ends because nobody has matched the rest of it."""
    depth = house()
    measured = np.isfinite(depth)
    measured[:, :235] = False  # all ground before the wall
    assert not len(wall_points(depth, measured, CAMERA, DOWN)[0])
    assert not len(wall_points(np.full_like(depth, np.nan), measured, CAMERA, DOWN)[0])


def test_another_frame_tells_the_ground_that_this_one_could_not_match() -> None:
    depth = house()
    measured = np.isfinite(depth)
    measured[:, :235] = False  # all ground before the wall
    depth[:, :235] = np.nan
    ground = np.stack([*np.mgrid[-30:8:0.2, -20:20:0.2].reshape(2, -1), np.zeros(38000)], axis=1)
    points, *_ = wall_points(depth, measured, CAMERA, DOWN, [ground])
    assert len(points) > 1000
    assert np.abs(points[:, 0] - WEST).max() < 0.8
    ground[:, 2] = 8.5  # a terrace under the roof's edge: too low a step for a wall
    assert not len(wall_points(depth, measured, CAMERA, DOWN, [ground])[0])


@pytest.mark.parametrize(
    ("change", "stands"),
    [({}, True), ({"second": True}, False), ({"support": 1, "score": 0.4}, False), ({"support": 1}, True)],
)
def test_only_what_another_frame_has_surely_measured_makes_a_wall(
    change: dict[str, Any], stands: bool, tmp_path: Path
) -> None:
    """The other frame stands 20 m to the west and has matched the ground before the wall, which this one has not."""
    shape = CAMERA.height, CAMERA.width
    kinds = {"depth": np.float32, "sigma": np.float32, "score": np.float32, "support": np.uint8, "second": bool}
    facts = {"depth": 75, "sigma": 0.1, "score": 0.9, "support": 2, "second": False}
    depth, ground = house(), {name: np.full(shape, (facts | change)[name], kinds[name]) for name in kinds}
    depth[:, :235] = np.nan
    own = {**ground, "depth": depth, "second": np.isnan(depth), "support": np.full(shape, 2, np.uint8)}
    own["score"] = np.ones(shape, np.float32)
    aside = DOWN.copy()
    aside[0, 3] = -20
    ground["depth"][:, 300:] = np.nan  # it does not see the ground behind the house
    frame = Frame("a", tmp_path / "a.png", CAMERA.width, CAMERA.height, camera=CAMERA)
    Image.fromarray(np.zeros((*shape, 3), np.uint8)).save(frame.path)
    maps = [DepthMap(name, CAMERA, place, [], tmp_path / name) for name, place in (("a", DOWN), ("b", aside))]
    _, apart, *_ = frame_points(maps[0], own, [(maps[1], ground, None)], frame, single=True, walls=True)
    assert (np.count_nonzero(apart >= WALL) > 1000) == stands
    _, apart, *_ = frame_points(maps[0], own, [(maps[1], ground, None)], frame, single=True, walls=False)
    assert not (apart >= WALL).any()


@pytest.mark.parametrize(
    ("before", "flat", "foot"), [(2.0, False, 0.0), (2.0, True, np.nan), (np.nan, False, 0.0), (8.5, False, np.nan)]
)
def test_of_what_stands_before_a_wall_only_what_is_low_and_rough_is_passed_over(
    before: float, flat: bool, foot: float
) -> None:
    z = np.array([[10, np.nan, before, before, 0, 0] + [np.nan] * walls.GAP])
    edge = np.zeros(1, np.intp)
    found = walls._foot(z, z == 0, (z == before) & flat, edge, edge, (0, 1), 2.5)
    np.testing.assert_equal(found, [foot])


def test_a_wall_does_not_run_through_an_annex_that_another_frame_has_measured() -> None:
    depth = house()
    x, y = np.mgrid[WEST - 4 : WEST : 0.2, -3:3:0.2].reshape(2, -1)
    annex = np.stack([x, y, np.full(len(x), 3.0)], axis=1)
    beside = (np.abs(unproject(pixel_grid(400, 300), np.full_like(depth, 72), CAMERA, DOWN)[..., :2]) < [WEST, 3]).all(
        2
    )
    depth[beside & (np.arange(400) > 220)] = np.nan  # where this frame shows it, it has matched nothing
    points, *_ = wall_points(depth, np.isfinite(depth), CAMERA, DOWN, [annex])
    assert len(points) > 500
    assert not ((np.abs(points[:, 1]) < 2) & (points[:, 2] < 2.5)).any()


def test_a_wall_behind_what_another_frame_has_measured_is_not_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    depth = house()
    open_ = wall_points(depth, np.isfinite(depth), CAMERA, DOWN).points
    screen = DOWN[:3, 3] + 0.4 * (open_ - DOWN[:3, 3])  # 45 m up, before all of the wall
    depth[:, 200:235] = np.nan
    assert len(wall_points(depth, np.isfinite(depth), CAMERA, DOWN, [screen]).points) < 0.3 * len(open_)
    monkeypatch.setattr(walls, "_hidden", lambda points, row, *_: np.zeros(len(row), bool))
    assert len(wall_points(depth, np.isfinite(depth), CAMERA, DOWN, [screen]).points) > 0.5 * len(open_)


@pytest.mark.parametrize(("side", "stands"), [(3.0, False), (5.5, True)])
def test_least_plan_of_a_roof(side: float, stands: bool) -> None:
    grid = Grid(0.0, 24.0, 0.4, 60, 60)
    x, y = np.moveaxis(grid.centres() - 12, -1, 0)
    heights = np.where((np.abs(x) < side / 2) & (np.abs(y) < side / 2), 7.0, 0.0)
    seen = Surface(grid, heights, None, np.ones((60, 60), np.int64))
    assert bool(len(walls._curtains(seen, 0.1)[0])) == stands


@pytest.mark.parametrize("height", [10.0, 20.0, 30.0])
@pytest.mark.parametrize(("word", "stays"), [(1.0, False), (-1.0, True)])
def test_a_wall_takes_the_place_of_a_network_s_word_but_for_what_stands_before_it(
    height: float, word: float, stays: bool, tmp_path: Path
) -> None:
    """The word lies on the ground behind the wall, or on something that stands clearly before it."""
    shape = CAMERA.height, CAMERA.width
    depth = house(height)
    wall = np.isnan(depth)
    said = np.where(word > 0, 75, 75 - height - 5)
    data = {
        "depth": np.where(wall, said, depth).astype(np.float32), "sigma": np.full(shape, 0.1, np.float32),
        "support": np.where(wall, 0, 2).astype(np.uint8), "score": np.ones(shape, np.float32),
        "guessed": wall, "second": wall, "once": wall, "sure": np.full(shape, 0.8, np.float32),
    }  # fmt: skip
    frame = Frame("a", tmp_path / "a.png", CAMERA.width, CAMERA.height, camera=CAMERA)
    Image.fromarray(np.zeros((*shape, 3), np.uint8)).save(frame.path)
    own = DepthMap("a", CAMERA, DOWN, [], tmp_path / "a")
    plain, *_ = frame_points(own, data, [], frame, single=True, walls=False)
    cloud, apart, given, _ = frame_points(own, data, [], frame, single=True, walls=True)
    assert cloud.predicted is not None
    assert plain.predicted is not None
    words, on_wall = cloud.points[cloud.predicted & (apart < WALL)], cloud.points[apart >= WALL]
    assert plain.predicted.sum() == wall.sum()
    assert given[wall].all()  # later frames need not say it either
    if stays:
        assert len(words) == wall.sum()
        assert not len(on_wall)
    else:
        assert len(words) < 0.1 * wall.sum()
        assert len(on_wall) > 1000


def test_a_deck_under_which_the_ground_was_matched_has_no_walls() -> None:
    depth = house()
    depth[np.isnan(depth)] = 75
    assert not len(wall_points(depth, np.isfinite(depth), CAMERA, DOWN)[0])


def test_a_pit_of_wrong_matches_has_no_walls() -> None:
    depth = np.full((300, 400), 75, np.float32)
    depth[140:160, 240:260] = 85  # 5.7 m wide
    depth[135:165, 235:240] = np.nan  # and what matching left open beside it
    depth[135:165, 260:265] = np.nan
    assert not len(wall_points(depth, np.isfinite(depth), CAMERA, DOWN)[0])


def test_a_wall_is_cut_off_by_what_stands_before_it() -> None:
    depth = house()
    west, column = 195.0, np.arange(400)
    before = (column > west) & (column < 240)
    depth[:, before] = np.where(np.isnan(depth[:, before]), 60, depth[:, before])  # a screen, nearer than the wall
    points, *_ = wall_points(depth, np.isfinite(depth), CAMERA, DOWN)
    open_ = house()
    assert len(points) < 0.3 * len(wall_points(open_, np.isfinite(open_), CAMERA, DOWN)[0])


def test_a_point_on_a_wall_stands_under_the_roof_and_gives_way_to_what_was_matched() -> None:
    low, high = np.zeros(2, np.int64), np.full(2, BLOCK)

    def cloud(points: list[list[float]], predicted: bool) -> Cloud:
        n = len(points)
        return Cloud(
            np.array(points), np.zeros((n, 3), np.uint8), confidence=np.full(n, 0.9, np.float32),
            sigma_m=np.ones(n, np.float32), views=np.ones(n, np.uint8), predicted=np.full(n, predicted),
        )  # fmt: skip

    roof = [[10.5 + i % 3, 10.5 + i // 3, 30.5] for i in range(9)]
    part = [[10.5, 10.5, 12.5 + i] for i in range(8)]  # of the wall, which was matched
    walls = cloud([[10.5, 11.5, z + 0.5] for z in range(30)], True)
    made = thinned_tile(cloud(roof + part, False), walls, np.full(30, WALL + 2, np.uint8), 1.0, low, high)
    assert made.predicted is not None
    heights = np.sort(made.points[made.predicted, 2])
    assert heights.tolist() == [z + 0.5 for z in range(0, 30, 2) if not 12 <= z < 20]  # one of each cell


def test_a_crown_that_is_flat_along_two_cells_is_no_roof(monkeypatch: pytest.MonkeyPatch) -> None:
    grid = Grid(0.0, 24.0, 0.4, 60, 60)
    x, y = np.moveaxis(grid.centres() - 12, -1, 0)
    clumps = 0.25 * (np.sin(2 * np.pi * x / 2.2) + np.cos(2 * np.pi * y / 2.2))
    crown = np.where(np.hypot(x, y) < 6, 8 - (x**2 + y**2) / 14 + clumps, 0.0)
    roof = np.where((np.abs(x) < 5) & (np.abs(y) < 5), 7 - 0.5 * np.abs(x), 0.0)  # a gable

    def points(heights: Array) -> int:
        return len(walls._curtains(Surface(grid, heights, None, np.ones((60, 60), np.int64)), 0.1)[0])

    assert points(roof) > 10_000
    assert points(crown) == 0
    monkeypatch.setattr(walls, "LEVEL", 0.0)
    assert points(crown) > 1000


def test_a_wall_gives_way_to_what_two_frames_agree_on() -> None:
    low, high = np.zeros(2, np.int64), np.full(2, BLOCK)
    n = 12
    points = np.array([[10.5, 10.5, 2 * k + 0.5] for k in range(n)] * 2)
    guesses = Cloud(
        points, np.zeros((2 * n, 3), np.uint8), confidence=np.repeat([0.95, 0.85], n).astype(np.float32),
        sigma_m=np.ones(2 * n, np.float32), views=np.repeat([1, 3], n).astype(np.uint8),
        predicted=np.repeat([True, False], n),
    )  # fmt: skip
    made = thinned_tile(guesses[:0], guesses, np.repeat([WALL + 2, 4], n).astype(np.uint8), 1.0, low, high)
    assert made.predicted is not None
    assert not made.predicted.any()
    assert len(made) == n
