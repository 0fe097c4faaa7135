"""The orthophoto against the truth: colours, edges, shadows of sight, exposures, windows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import house
import numpy as np
import pytest

from overfly.errors import InputError
from overfly.geodesy import Origin, crs_from_enu, enu_from_crs
from overfly.mapping.fill import FILL, FILLED
from overfly.mapping.orthophoto import Orthophoto
from overfly.mapping.raster import Grid
from overfly.mapping.sight import DepthBuffer

FINE = Grid(-16.0, 16.0, 0.125, 256, 256)
ORIGIN = Origin(52.2, 21.0, 100.0)


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory):
    return house.frames(tmp_path_factory.mktemp("house"))


def over(frames, grid=None, heights=None, **settings) -> Orthophoto:
    if grid is None:
        grid, heights = house.surface()
    return Orthophoto(frames, *house.overview(grid, heights), **settings)


def beside_edge(xy: np.ndarray, cell: float) -> np.ndarray:
    """Whether points lie within one cell of the outline of the roof."""
    outside = np.abs(xy) - house.HALF
    return np.asarray((outside.max(-1) > -cell) & (outside.max(-1) < cell))


def is_meadow(rgb: np.ndarray) -> np.ndarray:
    return np.asarray(rgb[..., 1].astype(int) - rgb[..., 0] > 20)


@pytest.mark.parametrize("origin", [None, ORIGIN])
def test_colours_are_true_and_roofs_end_within_one_cell(flight, origin: Origin | None) -> None:
    grid, heights = house.surface()
    fine = FINE
    if origin is not None:  # the same ground in UTM, whose north is turned by 4 degrees here
        east, north, level = crs_from_enu([[0, 0, 0]], origin)[0]
        shift = np.round([east, north])
        grid = replace(grid, x_min=grid.x_min + shift[0], y_max=grid.y_max + shift[1])
        fine = replace(fine, x_min=fine.x_min + shift[0], y_max=fine.y_max + shift[1])

        def local(xy: np.ndarray) -> np.ndarray:
            flat = np.c_[xy.reshape(-1, 2), np.full(xy[..., 0].size, level)]
            return enu_from_crs(flat, origin)[:, :2].reshape(xy.shape)

        heights, xy = house.height(local(grid.centres())) + level, local(fine.centres())
    else:
        xy = fine.centres()
    rgb, alpha = over(flight, grid, heights, origin=origin).window(fine, grid, heights)
    assert rgb.shape == (256, 256, 3)
    assert (rgb.dtype, alpha.dtype) == (np.uint8, np.uint8)
    assert (alpha[np.abs(xy).max(-1) < 14] > 0).all()
    # A cell of the surface model, a quarter of a metre, is the best that can be known of the edge.
    clear = ~beside_edge(xy, grid.cell * (1 if origin is None else 1.5)) & (alpha == 255)
    off = np.abs(rgb.astype(float) - house.color(xy)).max(-1)[clear]
    assert np.median(off) < 3
    assert np.quantile(off, 0.999) < 12
    np.testing.assert_array_equal(is_meadow(rgb)[clear], ~house.on_roof(xy)[clear])


def test_a_roof_hides_the_ground_beside_it(flight, monkeypatch: pytest.MonkeyPatch) -> None:
    grid, heights = house.surface()
    xy = FINE.centres()
    ground = ~house.on_roof(xy) & ~beside_edge(xy, grid.cell)
    rgb, _ = over(flight[:3]).window(FINE, grid, heights)
    ghost = (~is_meadow(rgb) & rgb.any(-1) & ground).sum()
    monkeypatch.setattr(DepthBuffer, "hides", lambda self, u, v, depth: np.zeros(depth.shape, bool))
    rgb, _ = over(flight[:3]).window(FINE, grid, heights)
    blind = (~is_meadow(rgb) & rgb.any(-1) & ground).sum()
    assert blind > 1000
    assert ghost < 0.03 * blind  # pixels on the outline show both; no other frame is there to tell better


def test_one_frame_alone_leaves_blank_what_it_does_not_see(tmp_path: Path) -> None:
    frames = house.frames(tmp_path, [house.nadir(-16, 0)])
    grid, heights = house.surface()
    rgb, alpha = over(frames).window(FINE, grid, heights)
    xy = FINE.centres()
    # From 16 m to the west the eastern edge of the roof, 22 m off, hides 22 * 8 / 42 m of the ground.
    shadow = (xy[..., 0] > 6) & (xy[..., 0] < 6 + 22 * 8 / 42) & (np.abs(xy[..., 1]) < 4)
    deep = shadow & (np.abs(xy[..., 1]) < 4 - 2 * FILL * 0.125 - 0.5) & (alpha < 255)
    assert deep.any()
    assert (alpha[deep] == 0).all()
    again, covered = over(frames).window(FINE, grid, heights, np.ones(heights.shape, bool))
    seen = alpha == 255
    np.testing.assert_array_equal(again[seen], rgb[seen])
    np.testing.assert_array_equal(covered == 255, seen)
    shown = deep & (covered == FILLED)
    assert xy[shown, 0].max() < xy[deep & ~shown, 0].min()  # the rest lies beyond the photograph
    assert (~is_meadow(again))[shown].mean() > 0.9  # what hides it shows: the roof, twice
    assert not rgb[deep].any()
    assert (alpha == FILLED).any()
    seen = (alpha == 255) & ~beside_edge(xy, grid.cell)
    assert not seen[shadow & (xy[..., 0] < 9)].any()
    off = np.abs(rgb.astype(float) - house.color(xy)).max(-1)[seen]
    assert np.quantile(off, 0.999) < 12
    filled = (alpha == FILLED) & ~beside_edge(xy, grid.cell)
    np.testing.assert_array_equal(is_meadow(rgb)[filled], ~house.on_roof(xy)[filled])


@pytest.mark.parametrize(("side", "coloured"), [(1.0, True), (6.0, False)])
def test_a_pit_that_no_frame_looks_into_takes_the_colour_around_it(tmp_path: Path, side: float, coloured: bool) -> None:
    """Between leaves; ``side``: metres. A wide one stays blank."""
    frames = house.frames(tmp_path, [house.nadir(-16, 0)])
    grid, heights = house.surface()
    at, xy = grid.centres(), FINE.centres()
    heights = np.where((np.abs(at - [-6, 0]) < side / 2).all(-1), -40, heights)
    rgb, alpha = over(frames, grid, heights).window(FINE, grid, heights)
    bottom = (np.abs(xy - [-6, 0]) < 0.2).all(-1)
    assert (alpha[bottom] == (FILLED if coloured else 0)).all()
    assert (is_meadow(rgb)[bottom] == coloured).all()


@pytest.mark.parametrize("even", [True, False])
def test_a_darker_frame_leaves_no_step(tmp_path: Path, even: bool) -> None:
    frames = house.frames(tmp_path, exposures={5: 0.8})
    grid, heights = house.surface()
    photo = over(frames)
    others = np.delete(photo.gains.colors, 5, axis=0)
    assert photo.gains.colors[5].mean() / others.mean() == pytest.approx(1 / 0.8, rel=0.06)
    if not even:  # the blending alone
        photo.gains.colors[:] = 1
    rgb, alpha = photo.window(FINE, grid, heights)
    assert (alpha[~beside_edge(FINE.centres(), grid.cell)] == 255).all()
    ratio = rgb / house.color(FINE.centres())
    ratio[beside_edge(FINE.centres(), 0.5)] = np.nan
    means = np.nanmean(ratio.reshape(16, 16, 16, 16, 3), axis=(1, 3, 4))
    steps = np.abs(np.diff(np.stack([means, means.T]), axis=1)).max()
    assert steps < (0.025 if even else 0.06)
    # Between neighbouring cells too: the seams of a mosaic without any evening out are steps of 20 %.
    flat = cv2.medianBlur(np.nan_to_num(ratio.mean(-1), nan=1).astype(np.float32), 5)
    assert np.nanmax(np.abs(np.diff(flat, axis=1))) < (0.03 if even else 0.05)


def test_the_mean_brightness_stays(tmp_path: Path) -> None:
    frames = house.frames(tmp_path, exposures={0: 0.7, 1: 0.8, 6: 1.1})
    gains = over(frames).gains.colors
    means = np.array([f.image().reshape(-1, 3).mean(0) for f in frames])
    np.testing.assert_allclose((means * gains).mean(0), means.mean(0), rtol=0.01)
    assert np.ptp((means * gains).mean(1)) < 0.6 * np.ptp(means.mean(1))


def test_blurred_frames_count_less(tmp_path: Path) -> None:
    frames = house.frames(tmp_path)
    rng = np.random.default_rng(0)
    for i, frame in enumerate(frames):
        image = np.clip(frame.image() + rng.normal(0, 8, (240, 320, 1)), 0, 255).astype(np.uint8)
        cv2.imwrite(str(frame.path), cv2.GaussianBlur(image, (0, 0), 2) if i == 4 else image)
    sharpness = over(frames).gains.sharpness
    assert sharpness[4] < 0.8
    assert np.delete(sharpness, 4).min() > 0.9


def test_what_one_frame_of_many_shows_is_left_out(tmp_path: Path) -> None:
    """A blue car drives through the middle of the frame that sees that ground best."""
    frames = house.frames(tmp_path)
    image = cv2.imread(str(frames[1].path))
    image[108:132, 148:172] = (230, 40, 20)  # BGR
    cv2.imwrite(str(frames[1].path), image)
    grid, heights = house.surface()
    rgb, _ = over(frames).window(FINE, grid, heights)
    alone, _ = over(frames[1:2]).window(FINE, grid, heights)
    assert (alone[..., 2] > 150).sum() > 300
    assert (rgb[..., 2] > 150).sum() == 0


def test_the_empty_surface_is_transparent(flight) -> None:
    grid, heights = house.surface()
    pond = (np.abs(grid.centres() - [-10, 10]) < 3).all(-1)
    heights = np.where(pond, np.nan, heights)
    photo = over(flight, grid, heights)
    rgb, alpha = photo.window(FINE, grid, heights)
    pond = (np.abs(FINE.centres() - [-10, 10]) < 3).all(-1)
    assert (alpha[pond] == 0).all()
    assert not rgb[pond].any()
    assert (alpha[~pond & ~beside_edge(FINE.centres(), 0.25)] == 255).all()
    rgb, alpha = photo.window(FINE, grid, np.full_like(heights, np.nan))
    assert not alpha.any()
    assert not rgb.any()


@pytest.mark.parametrize("placed", [False, True])
def test_windows_agree_with_the_whole_to_the_last_bit(flight, placed: bool) -> None:
    grid, heights = house.surface()
    heights = heights + np.random.default_rng(0).normal(0, 0.15, heights.shape)  # specks in the masks
    heights[20:30, 40:60] = np.nan
    fine = replace(FINE, cell=0.1, rows=300, columns=310)
    origin = ORIGIN if placed else None
    if placed:
        shift = np.round(crs_from_enu([[0, 0, 0]], ORIGIN)[0])
        grid, fine = (replace(g, x_min=g.x_min + shift[0], y_max=g.y_max + shift[1]) for g in (grid, fine))
        heights = heights + ORIGIN.height
    photo = over(flight, grid, heights, origin=origin)
    rgb, alpha = photo.window(fine, grid, heights)
    assert set(np.unique(alpha)) == {0, 255}
    margin = int(np.ceil(photo.halo(fine.cell) / grid.cell))
    for rows in (slice(0, 130), slice(130, 300)):
        for columns in (slice(0, 77), slice(77, 310)):
            part = Grid(
                fine.x_min + columns.start * fine.cell,
                fine.y_max - rows.start * fine.cell,
                fine.cell,
                rows.stop - rows.start,
                columns.stop - columns.start,
            )
            west, east, south, north = part.extent
            top = max(0, int((grid.y_max - north) / grid.cell) - margin)
            left = max(0, int((west - grid.x_min) / grid.cell) - margin)
            bottom = min(grid.rows, int((grid.y_max - south) / grid.cell) + margin)
            right = min(grid.columns, int((east - grid.x_min) / grid.cell) + margin)
            corner = grid.x_min + left * grid.cell, grid.y_max - top * grid.cell
            cut = Grid(*corner, grid.cell, bottom - top, right - left)
            cut_rgb, cut_alpha = photo.window(part, cut, heights[top:bottom, left:right])
            np.testing.assert_array_equal(cut_alpha, alpha[rows, columns])
            np.testing.assert_array_equal(cut_rgb, rgb[rows, columns])


def test_coarse_cells_average_the_photographs(flight) -> None:
    """Cells of 1 m, five pixels wide: thinned images alias, averaged ones give the mean of the ground."""
    grid, heights = house.surface()
    coarse = Grid(-16.0, 16.0, 1.0, 32, 32)
    rgb, _ = over(flight).window(coarse, grid, heights)
    truth = house.color(FINE.centres()).reshape(32, 8, 32, 8, 3).mean((1, 3))
    clear = ~beside_edge(coarse.centres(), 1.5)
    off = np.abs(rgb - truth).max(-1)[clear]
    assert np.median(off) < 5


def test_what_cannot_be_done_is_said(flight) -> None:
    grid, heights = house.surface()
    with pytest.raises(InputError, match="surface model is empty"):
        Orthophoto(flight, grid, np.full_like(heights, np.nan))
    with pytest.raises(InputError, match="No frame stands above"):
        Orthophoto(flight, grid, heights + 100)
