"""Which points of a frame's depth map stand, beside what its partners say."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from overfly.cloud import Cloud
from overfly.files import save_arrays
from overfly.flights import Frame
from overfly.geometry import Camera
from overfly.mapping.depth_map import DepthMap
from overfly.mapping.frame_points import AWAY, NEAR, cleaned, frame_points
from overfly.mapping.thinning import BLOCK, thinned_tile


def word(
    camera: Camera, folder: Path, sure: float, once: bool | NDArray[np.bool_]
) -> tuple[DepthMap, Frame, dict[str, NDArray[Any]]]:
    """A frame of which a network alone has spoken: 50 m everywhere, so sure; where no other frame sees the place."""
    shape = camera.height, camera.width
    data = {
        "depth": np.full(shape, 50, np.float32), "sigma": np.full(shape, 0.1, np.float32),
        "support": np.zeros(shape, np.uint8), "score": np.full(shape, -1, np.float32),
        "paired": np.zeros(shape, bool), "guessed": np.ones(shape, bool), "second": np.ones(shape, bool),
        "sure": np.full(shape, sure, np.float32), "once": np.broadcast_to(once, shape),
    }  # fmt: skip
    frame = Frame("a", folder / "a.png", camera.width, camera.height, camera=camera)
    Image.fromarray(np.zeros((*shape, 3), np.uint8)).save(frame.path)
    return DepthMap("a", camera, np.eye(4), [], folder / "a.npz"), frame, data


@pytest.mark.parametrize(
    ("others", "sure", "share"), [(1, 0.5, 0.5), (1, 0.75, 1.0), (2, 0.75, 0.5), (2, 0.85, 1.0), (4, 0.99, 0.5)]
)
def test_a_word_alone_must_be_surer_the_more_other_frames_see_the_place(
    camera: Camera, others: int, sure: float, share: float, tmp_path: Path
) -> None:
    """What other frames have inside and could not match is mostly wood and water, where networks err, too."""
    once = np.arange(camera.width) < camera.width // 2
    own, frame, data = word(camera, tmp_path, sure, once)
    silent = data | {"depth": np.full_like(data["depth"], np.nan)}
    cloud, *_ = frame_points(own, data, [(own, silent, None)] * others, frame, single=True)
    assert cloud.predicted is not None
    assert cloud.predicted.all()
    assert len(cloud) == pytest.approx(share * camera.width * camera.height, abs=camera.height)


@pytest.mark.parametrize(
    ("further", "sure", "kept"), [(0, 0.55, False), (0, 0.65, True), (1, 0.65, False), (1, 0.85, True), (1, 0.95, True)]
)
def test_a_word_that_another_frame_agrees_with_must_be_surer_where_a_further_one_does_not(
    camera: Camera, further: int, sure: float, kept: bool, tmp_path: Path
) -> None:
    """Two frames agree by chance on waves and shadows, three do not."""
    own, frame, data = word(camera, tmp_path, sure, False)
    silent = data | {"depth": np.full_like(data["depth"], np.nan)}
    partners = [(own, data, None), *[(own, silent, None)] * further]
    cloud, apart, given, _ = frame_points(own, data, partners, frame, single=True)
    assert len(cloud) == (camera.width * camera.height if kept else 0)
    assert (apart == (AWAY if further and sure < 0.9 else NEAR)).all()
    assert given.all()  # no later frame is asked about what this one doubts


@pytest.mark.parametrize(("pixels", "once", "apart"), [(6.9, True, NEAR), (7.1, True, AWAY), (1, False, AWAY)])
def test_only_what_is_carried_on_exactly_stands_beside_measured_points(
    camera: Camera, pixels: float, once: bool, apart: int, tmp_path: Path
) -> None:
    """``pixels``: standard deviation on the ground."""
    own, frame, data = word(camera, tmp_path, 0.75, once)
    data["sigma"][:] = pixels * 50 / camera.fx
    cloud, cells, *_ = frame_points(own, data, [], frame, single=True)
    assert len(cloud) == camera.width * camera.height
    assert (cells == apart).all()


def test_no_point_comes_from_where_the_lens_has_shown_nothing(camera: Camera, tmp_path: Path) -> None:
    """Undistorted, a picture has an empty rim: points there were black."""
    shape = camera.height, camera.width
    lens = replace(camera, k1=0.3)
    data = {name: np.ones(shape, np.float32) for name in ("sigma", "sure")} | {
        name: np.ones(shape, bool) for name in ("guessed", "second", "once")
    }
    data |= {"depth": np.full(shape, 50, np.float32), "support": np.zeros(shape, np.uint8)}
    data |= {"score": np.full(shape, -1, np.float32), "paired": np.zeros(shape, bool)}
    frame = Frame("a", tmp_path / "a.png", camera.width, camera.height, camera=lens)
    Image.fromarray(np.full((*shape, 3), 200, np.uint8)).save(frame.path)
    cloud, *_ = frame_points(DepthMap("a", camera, np.eye(4), [], tmp_path / "a.npz"), data, [], frame, single=True)
    assert 0.3 * camera.width * camera.height < len(cloud) < 0.98 * camera.width * camera.height
    assert cloud.colors is not None
    assert cloud.colors.min() > 190


@pytest.mark.parametrize(
    ("partners", "score", "kept"), [(1, 0.35, True), (2, 0.35, False), (2, 0.45, True), (3, 0.5, False)]
)
def test_a_pair_alone_must_correlate_better_where_more_partners_see_the_place(
    camera: Camera, partners: int, score: float, kept: bool, tmp_path: Path
) -> None:
    shape = camera.height, camera.width
    blank = {"sigma": np.full(shape, 0.1, np.float32), "support": np.ones(shape, np.uint8)}
    data = blank | {"depth": np.full(shape, 50, np.float32), "score": np.full(shape, score, np.float32)}
    empty = blank | {"depth": np.full(shape, np.nan, np.float32)}  # sees the place and has matched nothing there
    own, other = (DepthMap(name, camera, np.eye(4), [], tmp_path / f"{name}.npz") for name in ("a", "b"))
    frame = Frame("a", tmp_path / "a.png", camera.width, camera.height, camera=camera)
    Image.fromarray(np.full((*shape, 3), 200, np.uint8)).save(frame.path)
    near = [(other, data, None), *[(other, empty, None)] * (partners - 1)]
    cloud, *_ = frame_points(own, data, near, frame, single=True)
    assert len(cloud) == (camera.width * camera.height if kept else 0)


@pytest.mark.parametrize(
    ("sideways", "there", "kept"),
    [(5.0, np.nan, False), (70.0, np.nan, True), (70.0, 40.0, True), (5.0, 40.0, False), (70.0, 300.0, False)],
)
def test_wide_partners_speak_against_a_place_only_where_they_see_through_it(
    camera: Camera, sideways: float, there: float, kept: bool, tmp_path: Path
) -> None:
    """They look at it from another side: something nearer may hide it, and often they match nothing."""
    shape = camera.height, camera.width
    blank = {"sigma": np.full(shape, 0.1, np.float32), "support": np.ones(shape, np.uint8)}
    data = blank | {"depth": np.full(shape, 50, np.float32), "score": np.full(shape, 0.35, np.float32)}
    turned = np.arctan2(sideways, 50)
    aside = np.eye(4)
    aside[:3, :3] = [[np.cos(turned), 0, -np.sin(turned)], [0, 1, 0], [np.sin(turned), 0, np.cos(turned)]]
    aside[0, 3] = sideways
    own, other = (DepthMap(name, camera, np.eye(4), [], tmp_path / f"{name}.npz") for name in ("a", "b"))
    further = DepthMap("c", camera, aside, [], tmp_path / "c.npz")
    frame = Frame("a", tmp_path / "a.png", camera.width, camera.height, camera=camera)
    Image.fromarray(np.full((*shape, 3), 200, np.uint8)).save(frame.path)
    near = [(other, data, None), (further, blank | {"depth": np.full(shape, there, np.float32)}, None)]
    cloud, *_ = frame_points(own, data, near, frame, single=True)
    middle = np.abs(cloud.points[:, :2]).max(axis=1) < 2  # which both have inside
    assert bool(middle.any()) == kept


@pytest.mark.parametrize(("others", "kept"), [(0, True), (1, False)])
def test_a_wall_that_two_frames_alone_see_stands_though_its_depth_changes_from_pixel_to_pixel(
    camera: Camera, others: int, kept: bool, tmp_path: Path
) -> None:
    """Between the depths of two neighbouring pixels of the other frame lies what the first one sees of the wall."""
    shape = camera.height, camera.width
    blank = {"sigma": np.full(shape, 0.01, np.float32), "support": np.ones(shape, np.uint8)}
    wall = np.full(shape, 50, np.float32) + 2 * (np.arange(camera.width) % 2).astype(np.float32)
    data = blank | {"depth": np.full(shape, 51, np.float32), "score": np.full(shape, 0.9, np.float32)}
    own, other = (DepthMap(name, camera, np.eye(4), [], tmp_path / f"{name}.npz") for name in ("a", "b"))
    frame = Frame("a", tmp_path / "a.png", camera.width, camera.height, camera=camera)
    Image.fromarray(np.full((*shape, 3), 200, np.uint8)).save(frame.path)
    empty = blank | {"depth": np.full(shape, np.nan, np.float32)}
    near = [(other, data | {"depth": wall}, None), *[(other, empty, None)] * others]
    cloud, *_ = frame_points(own, data, near, frame, single=True)
    assert len(cloud) == (camera.width * camera.height if kept else 0)
    off = [(other, data | {"depth": wall + 4}, None)]
    assert not len(frame_points(own, data, off, frame, single=True)[0])


@pytest.mark.parametrize("partners", [1, 3])
def test_partners_that_confirm_a_place_do_not_count_against_it(camera: Camera, partners: int, tmp_path: Path) -> None:
    shape = camera.height, camera.width
    data = {"sigma": np.full(shape, 0.1, np.float32), "support": np.ones(shape, np.uint8)}
    data |= {"depth": np.full(shape, 50, np.float32), "score": np.full(shape, 0.35, np.float32)}
    own = DepthMap("a", camera, np.eye(4), [], tmp_path / "a.npz")
    frame = Frame("a", tmp_path / "a.png", camera.width, camera.height, camera=camera)
    Image.fromarray(np.full((*shape, 3), 200, np.uint8)).save(frame.path)
    cloud, *_ = frame_points(own, data, [(own, data, None)] * partners, frame, single=True)
    assert len(cloud) == camera.width * camera.height


@pytest.mark.parametrize(("step", "kept"), [(4, True), (12, False)])
def test_a_sliver_of_wall_is_one_piece_where_its_depth_changes_by_a_few_pixels(
    camera: Camera, step: int, kept: bool, tmp_path: Path
) -> None:
    """``step``: pixels of disparity, of four standard deviations each, from row to row."""
    shape = camera.height, camera.width
    inverse = np.full(shape, np.nan)
    inverse[:20, 10:13] = 0.02 + 4 * step * 1e-5 * np.arange(20)[:, None]
    depth = (1 / inverse).astype(np.float32)
    path = tmp_path / "a.npz"
    save_arrays(
        path,
        {
            "depth": depth,
            "sigma": np.nan_to_num(1e-5 * depth**2, nan=1).astype(np.float16),
            "support": np.ones(shape, np.uint8),
            "score": np.full(shape, 60, np.int8),
            "paired": np.ones(shape, bool),
        },
    )
    found = cleaned(DepthMap("a", camera, np.eye(4), [], path))["depth"]
    assert np.isfinite(found).sum() == (60 if kept else 0)


@pytest.mark.parametrize("others", [None, True])
def test_partners_may_have_images_of_another_shape(camera: Camera, others: bool | None, tmp_path: Path) -> None:
    def level(name: str, lens: Camera, score: float) -> tuple[DepthMap, dict]:
        shape = lens.height, lens.width
        data = {"sigma": np.full(shape, 0.1, np.float32), "support": np.ones(shape, np.uint8)}
        data |= {"depth": np.full(shape, 50, np.float32), "score": np.full(shape, score, np.float32)}
        if others:
            data |= {"second": np.zeros(shape, bool), "guessed": np.zeros(shape, bool)}
        return DepthMap(name, lens, np.eye(4), [], tmp_path / f"{name}.npz"), data

    upright = replace(camera, width=camera.height, height=camera.width, cx=camera.cy, cy=camera.cx)
    own, data = level("a", camera, 0.9)
    partner, seen = level("b", upright, 0.9)
    seen["depth"][:] += 3 * (np.arange(upright.width) % 2)  # so that neighbours are asked, too
    frame = Frame("a", tmp_path / "a.png", camera.width, camera.height, camera=camera)
    Image.fromarray(np.full((camera.height, camera.width, 3), 200, np.uint8)).save(frame.path)
    cloud, *_ = frame_points(own, data, [(partner, seen, None)], frame, single=True)
    assert 0 < len(cloud) < camera.width * camera.height  # what the upright image has inside


def test_a_guess_stands_as_far_from_matched_points_as_it_must() -> None:
    """A column of matched points and a row of guesses away from it, of each kind."""
    x = np.arange(60) + 0.5

    def row(points: NDArray[Any]) -> Cloud:
        n = len(points)
        rest = {"confidence": np.full(n, 0.9, np.float32), "sigma_m": np.ones(n, np.float32)}
        return Cloud(points, np.zeros((n, 3), np.uint8), **rest, views=np.ones(n, np.uint8), predicted=np.ones(n, bool))

    matched = row(np.column_stack([0 * x + 0.5, x % 4, x // 4]))
    lines = [row(np.column_stack([x, 0 * x + y, 0 * x])) for y in (0.5, 1.5)]
    apart = np.repeat(np.array([NEAR, AWAY], np.uint8), 60)
    guesses = Cloud(*(np.concatenate([getattr(part, name) for part in lines]) for name in (
        "points", "colors", "confidence", "sigma_m", "views", "predicted")))  # fmt: skip
    found = thinned_tile(matched, guesses, apart, 1.0, np.zeros(2, int), np.full(2, BLOCK)).points[len(matched) :]
    assert found[found[:, 1] == 0.5, 0].min() == NEAR + 0.5
    assert found[found[:, 1] == 1.5, 0].min() == AWAY + 0.5


def spoken(
    camera: Camera, folder: Path, depth: NDArray[Any], support: int, said: NDArray[Any], sure: float, views: int = 2
) -> DepthMap:
    """A map of which pairs have matched ``depth``, and of which a network says ``said``, give or take 1 m."""
    shape = camera.height, camera.width
    small = shape[0] // 2, shape[1] // 2
    answer = {
        "depth": said, "alone": said, "sigma": np.ones(small), "confidence": np.full(small, sure),
        "views": np.full(small, views, np.uint8),
    }  # fmt: skip
    path = folder / "depth.npz"
    save_arrays(path, {
        "depth": depth.astype(np.float32), "sigma": np.full(shape, 0.1, np.float16),
        "support": np.where(np.isfinite(depth), support, 0).astype(np.uint8), "score": np.full(shape, 90, np.int8),
        "paired": np.isfinite(depth), **{f"opinion_{name}": values.astype(np.uint8 if name == "views" else np.float32)
        for name, values in answer.items()},
    })  # fmt: skip
    return DepthMap("a", camera, np.eye(4), [], path)


@pytest.mark.parametrize(
    ("support", "off", "sure", "stands"),
    [
        (1, 3.5, 0.5, True), (1, 3.7, 0.5, False), (1, 6.7, 0.9, True), (1, 7, 0.9, False),
        (2, 5.2, 0.5, True), (2, 5.5, 0.5, False), (2, 10, 0.9, True), (2, 10.5, 0.9, False),
    ],
)  # fmt: skip
def test_what_was_matched_must_not_contradict_the_network(
    camera: Camera, support: int, off: float, sure: float, stands: bool, tmp_path: Path
) -> None:
    """Where the network is not sure images match badly: there pairs are doubted sooner, one alone most."""
    depth = np.full((camera.height, camera.width), 50.0)
    said = np.full((camera.height // 2, camera.width // 2), 50.0 + off)
    data = cleaned(spoken(camera, tmp_path, depth, support, said, sure))
    assert (data["depth"] == (50 if stands else np.float32(50 + off))).all()
    assert (data["guessed"] != stands).all()
    assert (data["support"] == (support if stands else 0)).all()
    assert not data["second"][~data["guessed"]].any()


@pytest.mark.parametrize("views", [1, 2])
def test_only_what_several_frames_show_the_network_overrules_pairs(camera: Camera, views: int, tmp_path: Path) -> None:
    """What it says of a place that it has seen once was carried on from around, and is sure of the ground there."""
    depth = np.full((camera.height, camera.width), 50.0)
    said = np.full((camera.height // 2, camera.width // 2), 60.0)
    data = cleaned(spoken(camera, tmp_path, depth, 3, said, 0.5, views))
    assert (data["depth"] == (50 if views == 1 else 60)).all()


@pytest.mark.parametrize("views", [1, 2])
def test_a_network_may_say_nothing(camera: Camera, views: int, tmp_path: Path) -> None:
    depth = np.full((camera.height, camera.width), 50.0)
    depth[:, :100] = np.nan
    nothing = np.full((camera.height // 2, camera.width // 2), np.nan)
    data = cleaned(spoken(camera, tmp_path, depth, 1, nothing, 0.5, views))
    np.testing.assert_array_equal(data["depth"], depth.astype(np.float32))
    assert not data["guessed"].any()


def test_a_networks_word_follows_the_measured_depths_around_it(camera: Camera, tmp_path: Path) -> None:
    """It is 2 m off on one side, as its neighbours tell; on the other they are of another surface, or far away."""
    depth = np.full((camera.height, camera.width), 50.0)
    hole, half = 12, camera.width // 2
    depth[:, half:] = 44
    depth[camera.height // 2 - 5 : camera.height // 2 + 5, 40 : 40 + hole] = np.nan
    depth[camera.height // 2 - 5 : camera.height // 2 + 5, half + 40 : half + 40 + hole] = np.nan
    depth[-60:, :] = np.nan
    said = np.full((camera.height // 2, camera.width // 2), 52.0)
    data = cleaned(spoken(camera, tmp_path, depth, 2, said, 0.9))
    row = camera.height // 2
    assert data["guessed"][row, 46]
    assert data["depth"][row, 46] == pytest.approx(50, abs=0.5)
    assert data["depth"][row, half + 46] == pytest.approx(52)
    assert data["depth"][-1, 46] == pytest.approx(52, abs=0.01)
