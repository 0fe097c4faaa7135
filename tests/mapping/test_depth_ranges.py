"""Which points tell how deep the surface lies, and where it may be matched."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from overfly.files import save_arrays
from overfly.geometry import Camera, look_at, pixel_grid, pose, rotation_from_gimbal, unproject
from overfly.mapping.coarse import _confirmed, coarse_points
from overfly.mapping.depth_ranges import beside_others, depth_ranges
from overfly.mapping.seen_heights import narrowed
from overfly.mapping.views import Views


def test_an_oblique_frame_does_not_see_far_under_the_ground_before_it() -> None:
    camera = Camera(80, 60, 60.0, 60.0, 40.0, 30.0)
    ahead = pose(rotation_from_gimbal(0, -35), [0, 0, 50])
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-60, 60, 4000), rng.uniform(20, 250, 4000), rng.uniform(-1, 9, 4000)])
    span = depth_ranges([camera], [ahead], points)[0]
    assert -20 < span.low < -1
    depth = np.full((60, 80), span.far * 0.9, np.float32)  # the far end of the range, matched wrongly everywhere
    z = unproject(pixel_grid(80, 60), depth, camera, ahead)[..., 2]
    kept = np.where(depth < span.floor(camera, ahead), depth, np.nan)
    assert np.isnan(kept[40:]).all()  # the lower rows look at ground that is near
    assert np.isfinite(kept[z > -1]).all()
    assert np.isnan(kept[z < -40]).all()


def test_a_first_look_at_oblique_images_finds_the_ground(camera: Camera, hill, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    around = [look_at([95 * np.sin(t), 95 * np.cos(t), 80], [0, 0, 0]) for t in np.radians(range(0, 360, 45))]
    frames = hill.frames(tmp_path, camera, around, known=True)
    points = coarse_points(frames, seed=0)
    off = np.abs(points[:, 2] - hill.height(points[:, :2]))
    assert len(points) > 400
    assert np.median(off) < 0.5
    assert (off < 3).mean() > 0.9
    np.testing.assert_array_equal(points, coarse_points(frames, seed=0))


def test_what_pairs_show_narrows_the_heights_that_are_searched(camera: Camera, hill, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    around = [look_at([60 * np.sin(t), 60 * np.cos(t), 80], [0, 0, 0]) for t in np.radians(range(0, 360, 30))]
    flight = Views(hill.frames(tmp_path, camera, around, known=True), 1600)
    points = hill.surface(camera, around[0])[::20, ::20].reshape(-1, 3)
    spans = depth_ranges(flight.full, flight.poses, points)
    partners = [[(i + 1) % 12, (i + 6) % 12] for i in range(12)]
    found = narrowed(flight, spans, partners, range(12), tmp_path / "heights.npz")
    true = np.concatenate([hill.surface(camera, p)[..., 2].ravel() for p in around])
    low, high = np.quantile(true, [0.001, 0.999])
    for before, after in zip(spans, found, strict=True):
        assert after.low < low
        assert high < after.high
        assert after.high - after.low < 0.6 * (before.high - before.low)
        assert after._replace(low=before.low, high=before.high) == before
    assert all(a.low >= b.low and a.high <= b.high for b, a in zip(spans, found, strict=True))
    for path in tmp_path.glob("*.png"):
        path.unlink()
    assert narrowed(Views(flight.frames, 1600), spans, partners, range(12), tmp_path / "heights.npz") == found  # kept
    # Where all partners stand far apart nothing is known, and nothing changes.
    wide = [[(i + 5) % 12] for i in range(12)]
    assert narrowed(flight, spans, wide, range(12), tmp_path / "others.npz") == spans
    # Nor where nobody has looked, nor where the land may be of any height.
    unknown = spans[1]._replace(low=-np.inf, high=np.inf)
    mixed = [spans[0], unknown, *spans[2:]]
    seen = np.load(tmp_path / "heights.npz")["heights"]
    seen[0] = np.nan
    save_arrays(tmp_path / "some.npz", {"heights": seen})
    some = narrowed(flight, mixed, partners, range(12), tmp_path / "some.npz")
    assert some[:2] == mixed[:2]
    assert some[2:] == found[2:]


def test_points_of_a_pair_that_other_pairs_contradict_are_left_out() -> None:
    rng = np.random.default_rng(0)
    plan = rng.uniform(0, 200, (1200, 2))
    pair = np.repeat(np.arange(6), 200)
    points = np.column_stack([plan, np.where(plan[:, 0] > 100, 40.0, 0.0) + rng.normal(0, 1, 1200)])  # a step
    wrong = (pair == 2) & (rng.random(1200) < 0.7)
    points[wrong, 2] = -130 + rng.normal(0, 2, wrong.sum())
    stands = _confirmed(points, pair, 15.0)
    assert not stands[wrong].any()
    assert stands[~wrong].mean() > 0.85  # not those on the step
    assert not _confirmed(points[:200], pair[:200], 15.0).any()  # one pair alone


def test_points_far_below_or_above_those_around_them_are_left_out() -> None:
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(0, 200, (400, 2)), rng.normal(10, 3, 400)])
    tower = np.column_stack([rng.uniform(90, 95, (30, 2)), rng.uniform(0, 60, 30)])
    wrong = np.column_stack([rng.uniform(0, 200, (8, 2)), [-900, -80, -60, 75, 90, -50, -300, 2000]])
    wrong[0, 0], wrong[6, 0] = 900, -2000  # with nothing around them
    centres = np.array([[x, 100, 110.0] for x in range(0, 200, 40)])
    good = beside_others(np.concatenate([points, tower, wrong]), centres)
    assert good[:400].all()
    assert good[400:430].mean() > 0.9
    assert not good[430:].any()
    assert beside_others(points[:5], centres).all()
    together = np.array([2000.0, 0, -1500]) + np.random.default_rng(1).uniform(-20, 20, (12, 3))
    crowd = np.concatenate([np.repeat(points, 8, axis=0), together])  # a hundredth at the most
    good = beside_others(crowd, centres)
    assert good[:-12].all()
    assert not good[-12:].any()
