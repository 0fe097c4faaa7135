"""Points in three images: what hands the length of one base on to the next, and what must not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from overfly.flights import Frame
from overfly.geometry import Camera, fit_similarity, pose, project, rotation_from_gimbal, transform
from overfly.mapping.bundle import Bundle
from overfly.mapping.calibration import adjusted_twice, held_by_images
from overfly.mapping.placing import without_faults
from overfly.mapping.ties import placed_by_others, unchecked_ties, untied

CAMERA = Camera(800, 600, 600.0, 600.0, 400.0, 300.0)
PLACES = np.array([(0.0, 50.0 * k, 100.0) for k in range(4)] + [(60.0, 150.0, 100.0)])
"""A line with half of every image in the next one and nothing in the one after that; beside its last image another."""


def line(tracks: list[tuple[int, ...]], seed: int = 0) -> Bundle:
    """Cameras above rough ground that see the points whose images ``tracks`` tells."""
    rng = np.random.default_rng(seed)
    points, rays = [], []
    for number, images in enumerate(tracks):
        middle = PLACES[list(images), :2].mean(0)
        points.append([*(middle + rng.uniform(-15, 15, 2)), rng.uniform(0, 8)])
        rays += [(i, number) for i in images]
    poses = [pose(rotation_from_gimbal(0, -90), place) for place in PLACES]
    image, point = np.array(rays, np.intp).T
    ground = np.array(points)
    pixels = np.array([project(ground[p : p + 1], CAMERA, poses[i])[0][0] for i, p in rays])
    return Bundle(
        frames=np.arange(len(PLACES), dtype=np.intp),
        rotations=np.stack([matrix[:3, :3].T for matrix in poses]),
        centres=PLACES.copy(),
        lens_of=np.zeros(len(PLACES), np.intp),
        lenses=np.array([[600.0, 400.0, 300.0, 0.0, 0.0]]),
        lens_ids=(1,),
        points=ground,
        image=image,
        point=point,
        pixels=pixels + rng.normal(0, 0.1, pixels.shape),
    )


PAIRS = [(0, 1)] * 150 + [(1, 2)] * 150 + [(2, 3)] * 150
FIRM = [(2, 3, 4)] * 60
ALL = np.ones(len(PLACES), bool)


@pytest.mark.parametrize(("ties", "stands"), [(1, False), (3, False), (4, True), (30, True)])
def test_few_ties_are_left_out_and_enough_are_kept(ties: int, stands: bool) -> None:
    """Of three nothing is known; the second image has 300 rays besides, of which a hundredth is three."""
    bundle = line(PAIRS + FIRM + [(0, 1, 2)] * ties)
    out = unchecked_ties(bundle, ALL)
    left = bundle.kept(~out)
    assert len(left.points) == len(bundle.points), "of every point two rays are left"
    assert bool(out.any()) != stands
    assert untied(left).tolist() == [not stands, not stands, False, False, False]


def test_gps_is_only_wrong_where_other_images_tell_so(tmp_path: Path) -> None:
    """An image at the end of a line, which pairs alone hold, may have run off along its base: GPS is what holds it."""
    bundle = line(PAIRS + FIRM)
    gps = PLACES.copy()
    gps[0, 1:] -= 300.0, 30.0
    gps[4, 0] += 300.0
    frames = [Frame(f"{k}.jpg", tmp_path / f"{k}.jpg", 800, 600) for k in range(len(PLACES))]
    warnings: list[str] = []
    found = without_faults(bundle, gps, frames, warnings)
    assert np.isnan(found[4]).all()
    np.testing.assert_array_equal(found[:4], gps[:4])
    assert len(warnings) == 1
    assert "1 images (4.jpg)" in warnings[0]


def test_wrong_gps_of_images_in_a_row_is_wrong_together() -> None:
    chain = line([(0, 1, 2), (1, 2, 3), (2, 3, 4)] * 20)
    assert placed_by_others(chain, np.array([True, True, False, False, False])).all()
    assert not placed_by_others(line(PAIRS + FIRM), np.array([True, True, False, False, False]))[2:].any()


def test_images_without_gps_tell_nobody_that_his_is_wrong() -> None:
    """Two whose places nothing tells."""
    chain = line([(0, 1, 2)] * 20 + [(3, 4)] * 20)
    gps = PLACES.copy()
    gps[:2], gps[2, 0] = np.nan, 300.0
    found = without_faults(chain, gps, [Frame(f"{k}.jpg", Path(f"{k}.jpg"), 800, 600) for k in range(5)], [])
    np.testing.assert_array_equal(found, gps)


def test_many_matches_ask_for_more_ties() -> None:
    many = line(PAIRS * 5 + FIRM + [(0, 1, 2)] * 6)
    assert untied(many.kept(~unchecked_ties(many, ALL))).tolist() == [True, True, False, False, False]


def test_a_track_keeps_what_is_firm_in_it() -> None:
    bundle = line(PAIRS + FIRM + [(1, 2, 3, 4)])
    out = unchecked_ties(bundle, ALL)
    assert bundle.image[out].tolist() == [1]


def test_an_image_that_hardly_anything_else_places_keeps_its_ties() -> None:
    bundle = line(PAIRS[:300] + [(1, 2, 3)] * 60 + [(1, 2, 4)] * 3)
    assert not unchecked_ties(bundle, ALL).any()


def test_ties_of_one_image_with_many_pairs_add_up() -> None:
    """Two of each are few, but all of them tell the same image's place."""
    bundle = line(PAIRS + FIRM + [(0, 1, 4)] * 2 + [(1, 2, 4)] * 2 + [(0, 1, 2)] * 2)
    assert not unchecked_ties(bundle, ALL).any()


def test_what_one_image_loses_is_no_tie_of_another() -> None:
    """Of the first image's four ties three are also the second's, which has no more."""
    bundle = line(PAIRS + FIRM + [(0, 1, 2)] * 3 + [(0, 3, 4)])
    left = bundle.kept(~unchecked_ties(bundle, ALL))
    assert untied(left).tolist() == [True, True, False, False, False]
    assert not unchecked_ties(left, ALL).any()


def test_images_without_position_keep_every_tie() -> None:
    """Nothing else holds these."""
    bundle = line([*PAIRS, *FIRM, (0, 1, 2)])
    assert not unchecked_ties(bundle, np.array([True, False, True, True, True])).any()
    assert unchecked_ties(bundle, np.array([True, True, True, True, False])).sum() == 1


def test_nothing_is_asked_of_an_empty_bundle() -> None:
    bundle = line(PAIRS).kept(np.zeros(900, bool))
    assert not unchecked_ties(bundle, ALL).any()
    assert not untied(bundle).any()


@pytest.mark.parametrize("matches", [30, 45, 150])
def test_one_wrong_tie_does_not_outweigh_gps(matches: int) -> None:
    """A key point of the second image joined to a wrong place on its line in the fourth moved the image by metres."""
    rng = np.random.default_rng(3)
    bundle = line([*PAIRS[:matches], *PAIRS[150 : 150 + matches], *PAIRS[300 : 300 + matches], *FIRM, (1, 3, 4)])
    wrong = np.flatnonzero((bundle.image == 1) & (bundle.point == len(bundle.points) - 1))
    bundle.pixels[wrong, 1] += 60
    frames = [
        Frame(f"{k}.jpg", Path(f"{k}.jpg"), 800, 600, focal_px=600.0, gimbal=(0.0, -90.0, 0.0))
        for k in range(len(PLACES))
    ]
    told = PLACES + rng.normal(0, 1.0, PLACES.shape)
    ups = bundle.rotations[:, :, 2].copy()
    held = replace(held_by_images(bundle, frames), places=told, place_sigmas=np.ones_like(told), ups=ups)
    found = adjusted_twice(replace(bundle, centres=told), held, frames).bundle
    off = transform(fit_similarity(found.centres, PLACES), found.centres) - PLACES
    assert np.abs(off[1]).max() < 1.5
