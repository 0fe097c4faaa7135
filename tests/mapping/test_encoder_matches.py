"""The encoder's correspondences: where they must lie is known, on the hill and on a shifted picture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from conftest import bar
from overfly.errors import InputError
from overfly.flights import Flight
from overfly.flights.locate import gps_frame
from overfly.geometry import fit_similarity, project, transform
from overfly.losses import correspondence
from overfly.mapping.align import align
from overfly.mapping.correlate import refine
from overfly.mapping.encoder_matches import match_pair, overlay, picture
from overfly.mapping.matches import encoder_matches, priors
from overfly.mapping.overlays import Prior, apart
from overfly.mapping.settings import MapSettings
from overfly.networks.encoder import Encoder
from overfly.networks.matching import cell_pixels

STEPS = 40


@pytest.fixture(scope="module")
def encoder(hill) -> Encoder:  # type: ignore[no-untyped-def]
    """Trained for a few seconds: pieces of the hill's texture, and the same pieces turned, scaled and shifted."""
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    sizes = {"widths": (8, 16, 16, 16), "features": 32, "descriptor": 16, "match_channels": 32, "correction_width": 8}
    encoder = Encoder(size=(64, 64), **sizes)  # type: ignore[arg-type]
    optimizer = torch.optim.Adam(encoder.parameters(), lr=5e-3)
    cells = cell_pixels(64, 64)
    for step in range(STEPS):
        images, places = [], []
        for _ in range(2):
            zoom = 1 + step % 2
            x, y = rng.integers(0, 960 - 128 * zoom, 2)
            piece = cv2.resize(
                hill.texture[y : y + 128 * zoom, x : x + 128 * zoom], (128, 128), interpolation=cv2.INTER_AREA
            )
            angle, scale = rng.uniform(-0.2, 0.2), rng.uniform(0.9, 1.1)
            linear = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            shift = np.array([64, 64]) - linear @ [64, 64] + rng.uniform(-16, 16, 2)
            index = np.column_stack([linear, shift + linear @ [0.5, 0.5] - 0.5])  # of pixels whose centres are at 0
            turned = cv2.warpAffine(piece, index, (128, 128), borderMode=cv2.BORDER_REFLECT)
            images += [piece, np.clip(turned * rng.uniform(0.9, 1.1), 0, 255)]
            places.append(torch.from_numpy(cells.numpy() @ linear.T + shift).float())
        stacked = torch.from_numpy(np.stack(images)).float()[:, None].expand(-1, 3, -1, -1) / 255
        maps = encoder.dense(stacked).match_map
        at = torch.stack(places)
        inside = ((at > 4) & (at < 124)).all(2)
        chosen = torch.stack([torch.from_numpy(rng.permutation(torch.nonzero(x)[:, 0].numpy())[:96]) for x in inside])
        queries = torch.stack([m.flatten(1)[:, c].T for m, c in zip(maps[::2], chosen, strict=True)])
        where = torch.stack([x[c] for x, c in zip(at, chosen, strict=True)]) / 2
        loss = correspondence(queries, maps[1::2], where).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return encoder.eval()


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small images need few key points, and tests little time."""
    monkeypatch.setattr("overfly.mapping.encoder_matches.WIDTHS", (160, 320))
    monkeypatch.setattr("overfly.mapping.encoder_matches.POINTS", (200, 500))


def seen_from(hill, camera, first, second, pixels):  # type: ignore[no-untyped-def]
    """Where pixels [M, 2] of the first camera's image appear in the second's."""
    surface = hill.surface(camera, first)
    at = [
        cv2.remap(surface[..., k].astype(np.float32), *(pixels - 0.5).astype(np.float32).T, 1).ravel() for k in range(3)
    ]
    return project(np.stack(at, 1).astype(float), camera, second)[0]


def test_refinement_finds_a_known_motion_to_a_fraction_of_a_pixel_and_says_what_does_not_agree(hill) -> None:  # type: ignore[no-untyped-def]
    image = np.clip(hill.texture[:500, :600], 0, 255).astype(np.uint8)
    turn = np.array([[0.9, -0.5, 140.3], [0.5, 0.9, -60.7]])  # of pixels whose centres are at +0.5
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    index = np.linalg.inv(half) @ np.vstack([turn, [0, 0, 1]]) @ half
    moved = cv2.warpPerspective(image, index, (600, 500), flags=cv2.INTER_CUBIC)
    rng = np.random.default_rng(0)
    pixels = rng.uniform([200, 150], [400, 350], (80, 2))
    true = pixels @ turn[:, :2].T + turn[:, 2]
    jacobians = np.broadcast_to(turn[:, :2], (80, 2, 2))
    found, score = refine(image, moved, pixels, true + rng.uniform(-5, 5, (80, 2)), jacobians, error_px=7)
    good = score > 0.9
    assert good.mean() > 0.95
    assert np.median(np.linalg.norm(found - true, axis=1)[good]) < 0.1
    _, score = refine(image, moved, pixels, true + 60, jacobians, error_px=7)
    assert (score > 0.9).mean() < 0.05
    assert refine(image, moved, pixels[:0], true[:0], jacobians[:0], error_px=7)[0].shape == (0, 2)


@pytest.mark.parametrize(("partner", "known"), [(1, False), (7, True), (7, False)])
def test_key_points_are_found_in_a_neighbour_and_in_a_turned_strip(  # type: ignore[no-untyped-def]
    hill, camera, strips, encoder, partner: int, known: bool
) -> None:
    poses = strips[0], strips[partner]
    first, second = (
        picture(encoder, hill.render(camera, pose), Prior(camera, pose) if known else None) for pose in poses
    )
    found = match_pair(encoder, first, second)
    assert len(found.rows) > 40
    true = seen_from(hill, camera, *poses, first.points[found.rows])
    error = np.linalg.norm(found.pixels - true, axis=1)
    assert np.median(error) < 0.15
    assert (error < 1).mean() > 0.9


def test_pictures_of_different_places_do_not_match(hill, camera, strips, encoder) -> None:  # type: ignore[no-untyped-def]
    first = picture(encoder, hill.render(camera, strips[0]))
    noise = np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    second = picture(encoder, noise)
    assert overlay(encoder, first, second) is None
    assert len(match_pair(encoder, first, second).rows) == 0


def test_a_key_point_keeps_its_place_in_all_pairs(hill, camera, strips, encoder, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    frames = hill.frames(tmp_path, camera, strips[:3], known=False)
    pixels, matches = encoder_matches(
        frames, [(0, 1), (1, 2)], encoder, priors=[None] * 3, progress=lambda done, total: None
    )
    own = len(picture(encoder, frames[1].image()).points)
    left, right = set(matches[0, 1][:, 1].tolist()), set(matches[1, 2][:, 0].tolist())
    assert len({k for k in left & right if k < own}) > 20  # tracks of three frames
    for (i, j), rows in matches.items():
        assert rows[:, 0].max() < len(pixels[i])
        assert rows[:, 1].max() < len(pixels[j])


def test_priors_tell_which_pictures_lie_apart(camera, strips) -> None:  # type: ignore[no-untyped-def]
    def moved(metres: float) -> Prior:
        pose = strips[0].copy()
        pose[0, 3] += metres
        return Prior(camera, pose)

    here = Prior(camera, strips[0])  # 80 m wide on the ground
    assert [apart(here, moved(x)) for x in (0, 60, 90, 130, 400)] == [False, False, False, True, True]
    assert not apart(None, moved(400))
    assert not apart(here, None)
    level = strips[0].copy()
    level[:3, :3] = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # the horizon is in the picture
    assert not apart(here, Prior(camera, level))


def test_where_priors_are_right_no_turns_are_tried(  # type: ignore[no-untyped-def]
    hill, camera, strips, encoder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []

    def counted(*arguments: Any) -> Any:
        asked.append(len(arguments[3]))
        return overlay(*arguments)

    monkeypatch.setattr("overfly.mapping.matches.overlay", counted)
    frames = hill.frames(tmp_path, camera, strips[:3], known=False)
    given = [Prior(camera, pose) for pose in strips[:3]]
    _, matches = encoder_matches(frames, PAIRS, encoder, priors=given, progress=lambda done, total: None)
    assert list(matches) == PAIRS
    assert asked == [1, 1, 1]  # the ground plane alone


PAIRS = [(0, 1), (1, 2), (0, 2)]


@pytest.mark.parametrize("wrong", ["a position", "all heights"])
def test_wrong_priors_cost_no_pair(hill, camera, strips, encoder, tmp_path: Path, wrong: str) -> None:  # type: ignore[no-untyped-def]
    frames = hill.frames(tmp_path, camera, strips[:3], known=False)
    poses = [pose.copy() for pose in strips[:3]]
    if wrong == "a position":
        poses[2][0, 3] += 400
    else:
        for pose in poses:
            pose[2, 3] /= 4  # a take-off on a hill
    given = [Prior(camera, pose) for pose in poses]
    _, matches = encoder_matches(frames, PAIRS, encoder, priors=given, progress=lambda done, total: None)
    assert list(matches) == PAIRS


@pytest.mark.parametrize("matcher", ["encoder", "both"])
def test_cameras_from_the_encoders_matches(  # type: ignore[no-untyped-def]
    hill, camera, strips, encoder, tmp_path: Path, matcher: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("overfly.mapping.features.FEATURES", 600)
    poses = [*strips[:2], *strips[6:]]
    flight = hill.flight(tmp_path, camera, poses)
    block = align(flight, workdir=tmp_path / "work", seed=0, bar=bar, matcher=matcher, encoder=lambda: encoder)
    assert len(block.frames) == 4
    assert block.metric
    assert block.reprojection_px < 0.5
    truth, found = np.array([p[:3, 3] for p in poses]), block.poses[:, :3, 3]
    assert np.linalg.norm(transform(fit_similarity(found, truth), found) - truth, axis=1).max() < 0.5


def test_priors_need_gps_gimbal_and_height_above_ground(hill, camera, strips, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    frames = hill.frames(tmp_path, camera, strips[:3], known=False)
    told = gps_frame(Flight(tmp_path, frames))[1]
    frames[0] = replace(frames[0], gimbal=(0.0, -90.0, 0.0), relative_altitude=80.0)
    frames[1] = replace(frames[1], gimbal=(0.0, -90.0, 0.0))
    found = priors(frames, told)
    assert [prior is not None for prior in found] == [True, False, False]
    assert found[0] is not None
    np.testing.assert_allclose(found[0].world_from_camera[2, 3], 80)
    assert priors(frames, None) == [None] * 3


def test_a_matcher_without_a_network_or_unknown_is_refused() -> None:
    with pytest.raises(InputError, match="--network RUN"):
        MapSettings(dense="stereo", matcher="both")
    with pytest.raises(InputError, match="--matcher"):
        MapSettings(dense="stereo", matcher="orb")
