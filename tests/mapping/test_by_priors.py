"""Cameras that start where GPS and gimbals say, on matches too few to build a model from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from two_lines import CAMERA, Block

from overfly.geometry import Array, fit_similarity, pose, project, rotation_from_gimbal
from overfly.mapping.adjustment import UP_SIGMA, adjusted
from overfly.mapping.bundle import Bundle, components
from overfly.mapping.by_priors import bundle_by_priors
from overfly.mapping.calibration import NORMAL, RAYLEIGH, gimbal_sigma, held_by_images
from overfly.mapping.guided import guided_matches
from overfly.mapping.overlays import Prior
from overfly.mapping.placing import agrees_with_gps, placed, tilted


def misses(block: Block, bundle: Bundle) -> float:
    """How far off, pixels, the cameras see the ground, median after the best similarity of their centres."""
    matrix = fit_similarity(bundle.centres, block.places[bundle.frames])
    moved = bundle.moved(matrix)
    off: list[Array] = []
    for k, i in enumerate(bundle.frames.tolist()):
        points = block.ground[block.seen[i]]
        found, true = (project(points, CAMERA, matrix)[0] for matrix in (moved.pose(k), block.poses[i]))
        off.append(np.linalg.norm(found - true, axis=1))
    return float(np.median(np.concatenate(off)))


def test_few_matches_and_priors_make_a_block_with_every_frame() -> None:
    """A frame that nothing was matched with is found by looking where it must be."""
    block = Block()
    found = bundle_by_priors(block.frames, block.told, block.features, block.common(12, without=5), [1] * 8)
    assert found is not None
    assert found.frames.tolist() == list(range(8))
    assert np.bincount(found.image).min() >= 20
    assert np.median(found.errors()) < 0.5
    assert misses(block, found) < 6  # GPS alone: the test below
    assert found.lenses[0, 0] == pytest.approx(600, rel=1e-6)


def test_what_is_alike_where_priors_put_it_makes_a_block_of_images_that_nothing_has_matched() -> None:
    """Heights over the ground are told; one line is tilted by 40 degrees and looks back at the other's ground."""
    block = Block(tilt=40.0)
    level = np.median(block.ground[:, 2])
    turns = [rotation_from_gimbal(*(frame.gimbal or (0, 0, 0))) for frame in block.frames]
    priors = [
        Prior(CAMERA, pose(turn, [*place[:2], place[2] - level])) for turn, place in zip(turns, block.told, strict=True)
    ]
    few = {pair: rows[:8] for pair, rows in block.common(8).items() if pair == (0, 1)}
    assert bundle_by_priors(block.frames, block.told, block.features, {}, [1] * 8) is None
    found = bundle_by_priors(block.frames, block.told, block.features, few, [1] * 8, priors=priors)
    assert found is not None
    assert found.frames.tolist() == list(range(8))
    assert np.median(found.errors()) < 0.5
    assert misses(block, found) < 6
    assert any(k < 4 <= j for k, j in found.links()), "both lines are tied to each other"


def test_the_images_correct_what_gps_and_gimbals_say() -> None:
    block = Block(1)
    rotations = np.stack([rotation_from_gimbal(*(f.gimbal or (0, 0, 0))).T for f in block.frames])
    found = bundle_by_priors(block.frames, block.told, block.features, block.common(12), [1] * 8)
    assert found is not None
    off = [misses(block, bundle) for bundle in (found, Bundle(
        np.arange(8), rotations, block.told, np.zeros(8, np.intp), found.lenses, (1,), np.zeros((0, 3)),
        np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros((0, 2)),
    ))]  # fmt: skip
    assert off[0] < off[1] / 2


@pytest.mark.parametrize("lacking", ["gimbal", "gps", "matches"])
def test_without_priors_or_matches_there_is_no_block(lacking: str) -> None:
    block = Block()
    frames = [replace(f, gimbal=None) for f in block.frames] if lacking == "gimbal" else block.frames
    told = np.full_like(block.told, np.nan) if lacking == "gps" else block.told
    matches = {} if lacking == "matches" else block.common(12)
    assert bundle_by_priors(frames, told, block.features, matches, [1] * 8) is None


def test_a_bundle_that_contradicts_gps_is_told_from_one_that_is_only_off_by_some_metres() -> None:
    block = Block()
    found = bundle_by_priors(block.frames, block.told, block.features, block.common(12), [1] * 8)
    assert found is not None
    assert agrees_with_gps(found, block.told, block.frames)
    scaled = found.moved(np.diag([3.0, 3.0, 3.0, 1.0]))  # a similarity away
    assert agrees_with_gps(scaled, block.told, block.frames)
    late = block.told + np.where(np.arange(8) < 4, 1, -1)[:, None] * [0.0, 5.0, 0.0]  # GPS lags on lines to and fro
    assert agrees_with_gps(found, late, block.frames)
    folded = replace(found, centres=np.where(np.arange(8)[:, None] < 4, found.centres, found.centres[::-1]))
    assert not agrees_with_gps(folded, block.told, block.frames)
    lost = replace(found, centres=found.centres + 300.0 * (np.arange(8) == 2)[:, None])
    assert not agrees_with_gps(lost, block.told, block.frames)


def test_guided_matches_are_the_right_ones() -> None:
    block = Block()
    exact = Bundle(
        np.arange(8), np.linalg.inv(block.poses[:, :3, :3]), block.places, np.zeros(8, np.intp),
        np.array([[600.0, 400, 300, 0, 0]]), (1,), np.zeros((0, 3)), np.zeros(0, np.intp), np.zeros(0, np.intp),
        np.zeros((0, 2)),
    )  # fmt: skip
    pixels, descriptors = zip(block.features[0], block.features[1], strict=True)
    rows = guided_matches(exact, (0, 1), pixels, descriptors, (-1.0, 9.0), 3.0)
    common = len(np.intersect1d(block.seen[0], block.seen[1]))
    assert (block.seen[0][rows[:, 0]] == block.seen[1][rows[:, 1]]).mean() > 0.97
    assert len(rows) > 0.8 * common
    far = exact.moved(np.eye(4))
    far.centres[1] += [5000, 0, 0]
    assert len(guided_matches(far, (0, 1), pixels, descriptors, (-1.0, 9.0), 3.0)) == 0


def test_key_points_without_descriptors_and_a_camera_of_its_own() -> None:
    """Those of a network follow SIFT's; and a lens goes with the last image that has it."""
    block = Block()
    more = [(np.concatenate([pixels, pixels[:40] + 0.3]), looks) for pixels, looks in block.features]
    found = bundle_by_priors(block.frames, block.told, more, block.common(12), [1, 1, 1, 1, 1, 2, 1, 1])
    assert found is not None
    assert len(found.lenses) == 2
    rest = found.without(np.arange(8) == 5)
    assert rest.lens_ids == (1,)
    assert len(rest.lenses) == 1
    assert (rest.lens_of == 0).all()
    (whole,) = components(rest)
    assert whole.camera(0, 800, 600).fx == pytest.approx(600, rel=1e-6)


@pytest.mark.parametrize("times", [1, 5])
def test_larger_images_are_placed_as_well(times: int) -> None:
    block = Block()
    for k, (pixels, looks) in enumerate(block.features):
        block.features[k] = (pixels * times, looks)
        frame = block.frames[k]
        block.frames[k] = replace(frame, width=800 * times, height=600 * times, focal_px=600.0 * times)
    found = bundle_by_priors(block.frames, block.told, block.features, block.common(12, without=5), [1] * 8)
    assert found is not None
    assert np.bincount(found.image).min() >= 100


def test_parts_without_common_points_are_told_apart() -> None:
    block = Block()
    matches = {(i, j): rows for (i, j), rows in block.common(12).items() if (i < 3) == (j < 3)}
    blank = [(pixels, np.zeros_like(looks)) for pixels, looks in block.features]
    found = bundle_by_priors(block.frames, block.told, blank, matches, [1] * 8)
    assert found is not None
    assert [part.frames.tolist() for part in components(found)] == [[3, 4, 5, 6, 7], [0, 1, 2]]


@pytest.mark.parametrize(("shared", "placed_too"), [(9, False), (14, True)])
def test_an_image_is_not_placed_by_what_few_points_it_shares(shared: int, placed_too: bool) -> None:
    block = Block()
    matches = {pair: rows for pair, rows in block.common(20).items() if 7 not in pair or pair == (6, 7)}
    matches[6, 7] = matches[6, 7][:shared]
    blank = [(pixels, np.zeros_like(looks)) for pixels, looks in block.features]
    found = bundle_by_priors(block.frames, block.told, blank, matches, [1] * 8)
    assert found is not None
    assert found.frames.tolist() == [*range(7), *([7] if placed_too else [])]


def test_headings_hold_what_hardly_any_point_does() -> None:
    """Frame 7 has no points, and starts with a heading that is 8 degrees wrong."""
    block = Block()
    found = bundle_by_priors(block.frames, block.told, block.features, block.common(12), [1] * 8)
    assert found is not None
    at = placed([found], block.frames, block.told, [])
    turned = at.bundle.rotations.copy()
    turned[7] = turned[7] @ rotation_from_gimbal(8, 0) @ rotation_from_gimbal(0, 0).T
    start = replace(at.bundle, rotations=turned).kept(at.bundle.image != 7)
    held = replace(held_by_images(start, block.frames), ups=at.ups, places=at.places, place_sigmas=at.sigmas)
    off = []
    for easts in (at.easts, held.easts):
        north = adjusted(start, replace(held, easts=easts)).bundle.rotations[7][:, 1]
        off.append(np.degrees(np.abs(north @ at.easts[7])))
    assert off[0] < 0.1
    assert off[1] > 5


def test_headings_that_the_block_contradicts_hold_nothing() -> None:
    block = Block()
    found = bundle_by_priors(block.frames, block.told, block.features, block.common(12), [1] * 8)
    assert found is not None
    backwards = [
        replace(f, gimbal=(f.gimbal[0] + 180 * (k < 3), *f.gimbal[1:])) for k, f in enumerate(block.frames) if f.gimbal
    ]
    backwards[4] = replace(backwards[4], gimbal=None)
    known = np.isfinite(placed([found], backwards, block.told, []).easts).all(1)
    assert known.tolist() == [False, False, False, True, False, True, True, True]


def test_headings_are_told_without_the_error_of_the_compass() -> None:
    """All gimbals turned by 30 degrees tell the same easts, and as GPS places the block."""
    block = Block()
    found = bundle_by_priors(block.frames, block.told, block.features, block.common(12), [1] * 8)
    assert found is not None
    turned = [replace(f, gimbal=(f.gimbal[0] + 30, *f.gimbal[1:])) for f in block.frames if f.gimbal]
    at, again = (placed([found], frames, block.told, []) for frames in (block.frames, turned))
    np.testing.assert_allclose(again.easts, at.easts, atol=1e-3)
    assert np.degrees(np.linalg.norm(at.easts - at.bundle.rotations[:, :, 0], axis=1)).max() < 3


@pytest.mark.parametrize(
    ("turned_deg", "tilted_deg", "rays", "left_out"),
    [(0, 6, 40, True), (8, 0, 40, False), (0, 6, 400, False), (0, 1, 40, False)],
)
def test_an_image_of_few_rays_that_contradicts_its_gimbal_is_left_out(
    turned_deg: float, tilted_deg: float, rays: int, left_out: bool
) -> None:
    block = Block()
    found = bundle_by_priors(block.frames, block.told, block.features, block.common(200), [1] * 8)
    assert found is not None
    rotations = found.rotations.copy()
    rotations[3] = rotations[3] @ rotation_from_gimbal(turned_deg, tilted_deg) @ rotation_from_gimbal(0, 0).T
    own = np.flatnonzero(found.image == 3)
    assert len(own) > 150
    wrong = replace(found, rotations=rotations)
    if rays < len(own):
        wrong = wrong.kept(~np.isin(np.arange(len(found.image)), own[rays:]))
    warnings: list[str] = []
    at = placed([wrong], block.frames, block.told, warnings)
    assert at.bundle.frames.tolist() == [k for k in range(8) if k != 3 or not left_out]
    assert len(at.places) == len(at.easts) == len(at.bundle)
    assert bool([w for w in warnings if "1 images (3.jpg) were left out" in w]) == left_out


@pytest.mark.parametrize("turned", [90, 180])
def test_images_of_few_rays_whose_headings_are_wrong_on_a_whole_line_stay(turned: float) -> None:
    block = Block()
    found = bundle_by_priors(block.frames, block.told, block.features, block.common(12), [1] * 8)
    assert found is not None
    nth = np.array([np.count_nonzero(found.image[:k] == found.image[k]) for k in range(len(found.image))])
    few = found.kept(nth < 120)
    frames = [
        replace(f, gimbal=(f.gimbal[0] + turned * (k < 3), *f.gimbal[1:]))
        for k, f in enumerate(block.frames)
        if f.gimbal
    ]
    at = placed([few], frames, block.told, [])
    assert at.bundle.frames.tolist() == list(range(8))
    assert np.isfinite(at.easts).all(1).tolist() == [k >= 3 for k in range(8)]


def test_gimbals_weigh_what_they_scatter_by() -> None:
    """Those that are far better than usual hold more, down to a fifth of a degree; of a few nothing is told."""
    rng = np.random.default_rng(0)
    for true, expected in ((0.5, 0.5), (0.01, 0.2), (3.0, 1.3)):
        off = np.deg2rad(true) * np.linalg.norm(rng.normal(size=(300, 2)), axis=1) / RAYLEIGH
        assert np.rad2deg(gimbal_sigma(off, UP_SIGMA)) == pytest.approx(expected, rel=0.1)
        one = np.deg2rad(true) * np.abs(rng.normal(size=300)) / NORMAL
        assert np.rad2deg(gimbal_sigma(one, UP_SIGMA)) == pytest.approx(expected, rel=0.15)
        assert gimbal_sigma(off[:7], UP_SIGMA) == UP_SIGMA


def test_a_bundle_without_an_image() -> None:
    block = Block()
    found = bundle_by_priors(block.frames, block.told, block.features, block.common(12), [1] * 8)
    assert found is not None
    rest = found.without(np.arange(8) == 2)
    assert rest.frames.tolist() == [0, 1, 3, 4, 5, 6, 7]
    assert np.bincount(rest.point).min() >= 2
    np.testing.assert_array_equal(rest.centres, np.delete(found.centres, 2, 0))
    assert np.median(rest.errors()) < 0.5


def test_an_image_that_is_tilted_otherwise_than_its_gimbal_contradicts_the_priors() -> None:
    block = Block()
    found = bundle_by_priors(block.frames, block.told, block.features, block.common(12), [1] * 8)
    assert found is not None
    assert not tilted(found, block.frames).any()
    leaning = rotation_from_gimbal(0, -60) @ rotation_from_gimbal(0, -90).T
    rotations = found.rotations.copy()
    rotations[3] = rotations[3] @ leaning.T
    wrong = replace(found, rotations=rotations)
    anywhere = np.eye(4)
    anywhere[:3, :3] = rotation_from_gimbal(70, -20)  # whatever frame a sparse model stands in
    assert np.flatnonzero(tilted(wrong.moved(anywhere), block.frames)).tolist() == [3]
    assert not agrees_with_gps(wrong, block.told, block.frames)
    warnings: list[str] = []
    placed([wrong], block.frames, block.told, warnings)
    assert [w for w in warnings if "1 images (3.jpg) are tilted by more than 20 degrees" in w]
    # Headings the other way round, or gimbals that are wrong in every image, prove nothing.
    reversed_ = [
        replace(f, gimbal=(f.gimbal[0] + 180 * (k < 3), *f.gimbal[1:])) for k, f in enumerate(block.frames) if f.gimbal
    ]
    assert not tilted(found, reversed_).any()
    spread = [replace(f, gimbal=(0.0, -90.0 + 20 * k, 0.0)) for k, f in enumerate(block.frames)]
    assert not tilted(found, spread).any()
    assert not tilted(wrong, [replace(f, gimbal=None) for f in block.frames]).any()
