from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from plane import CAMERA, make_record, surface

from overfly.data.dataset import WindowDataset, WindowSampler, WindowSettings, mirrored, recoloured, reference_points
from overfly.data.footprints import footprint
from overfly.data.record import write_record
from overfly.data.windows import to_world, window_frame
from overfly.errors import InputError
from terrain import make_batch

EXACT = WindowSettings(
    frames=3,
    points=256,
    choice="overlap",
    ground_sigma_m=0.0,
    position_sigma_m=0.0,
    rotation_sigma_deg=0.0,
    shrink=1,
    drop_share=0.0,
    light_sigma=0.0,
    colour_sigma=0.0,
    camera_sigma_px=0.0,
)
SETTINGS = replace(EXACT, position_sigma_m=1.0, rotation_sigma_deg=1.0)


def dataset(folder: Path, augment: bool = True, seed: int = 5) -> WindowDataset:
    return WindowDataset([folder], SETTINGS, seed=seed, augment=augment)


def test_an_item_has_the_shapes_and_types_of_the_contract(record_folder: Path) -> None:
    item = dataset(record_folder)[0, 2]
    shapes = {name: tuple(value.shape) for name, value in item.items()}
    assert shapes["images"] == (3, 3, 24, 32)
    assert shapes["depth"] == (3, 24, 32)
    assert shapes["reference"] == (256, 3)
    assert shapes["camera_from_window"] == shapes["prior_from_window"] == (3, 4, 4)
    assert shapes["scale"] == shapes["scene"] == ()
    assert item["reference"].dtype == item["depth"].dtype == torch.float32
    assert int(item["scene"]) == 3


def test_reference_and_depth_are_the_same_surface(record_folder: Path) -> None:
    item = dataset(record_folder)[0, 2]
    scale = float(item["scale"])
    points = item["reference"].numpy().astype(float)
    # The camera faces north, so window axes are the world's; the frame stands over x = 0.
    np.testing.assert_allclose(points[:, 2] * scale, surface(points * scale), atol=0.06)
    assert np.abs(points[:, 0]).max() == pytest.approx(1, abs=0.05)
    assert np.abs(points[:, 1]).max() == pytest.approx(24 / 32, abs=0.05)  # the footprint has the image's shape
    # Each point projected into the first frame meets the depth map there.
    camera = item["camera_from_window"][0].numpy().astype(float)
    local = points @ camera[:3, :3].T + camera[:3, 3]
    pixels = local @ item["intrinsics"][0].numpy().T
    uv = (pixels[:, :2] / pixels[:, 2:]).astype(int)
    inside = (uv >= 0).all(1) & (uv[:, 0] < CAMERA.width) & (uv[:, 1] < CAMERA.height)
    assert inside.sum() > 100
    depth = item["depth"][0].numpy()[uv[inside, 1], uv[inside, 0]]
    np.testing.assert_allclose(local[inside, 2], depth, rtol=0.01)


def test_randomness_depends_on_seed_epoch_and_index_alone(record_folder: Path) -> None:
    first, second = dataset(record_folder), dataset(record_folder)
    _ = first[0, 1]  # drawing another item before changes nothing
    torch.testing.assert_close(first[4, 2]["reference"], second[4, 2]["reference"], rtol=0, atol=0)
    assert not torch.equal(first[4, 2]["reference"], first[5, 2]["reference"])
    assert not torch.equal(first[4, 2]["reference"], dataset(record_folder, seed=6)[4, 2]["reference"])
    fixed = dataset(record_folder, augment=False)
    torch.testing.assert_close(fixed[4, 2]["reference"], fixed[5, 2]["reference"], rtol=0, atol=0)


def test_priors_are_wrong_by_what_was_asked(record_folder: Path) -> None:
    data = dataset(record_folder)
    errors = []
    for epoch in range(40):
        item = data[epoch, 2]
        scale = float(item["scale"])
        true, prior = (torch.linalg.inv(item[k].double()) for k in ("camera_from_window", "prior_from_window"))
        errors.append((true - prior)[:, :3, 3].numpy() * scale)
    assert np.std(errors) == pytest.approx(1.0, abs=0.15)


def test_consecutive_windows_follow_time(tmp_path: Path) -> None:
    write_record(make_record(), tmp_path / "r")
    settings = replace(EXACT, choice="consecutive")
    windows = [window for _, window in WindowDataset([tmp_path / "r"], settings, seed=0, augment=False).windows]
    assert windows == [[0, 1, 2], [1, 2, 3], [2, 3, 4], [3, 4, 5], [4, 3, 5], [5, 3, 4]]


def test_a_reference_that_misses_the_window_is_an_error() -> None:
    record = make_record()
    frame, scale = window_frame(CAMERA, record.world_from_camera[0], 0.0)
    area = footprint(CAMERA, record.world_from_camera[0], 0.0) + 5000
    with pytest.raises(InputError, match="less than a tenth"):
        reference_points(record, area, frame, scale, 64, np.random.default_rng(0))


def test_points_keep_their_metres(record_folder: Path) -> None:
    record = make_record()
    frame, scale = window_frame(CAMERA, record.world_from_camera[2], 0.0)
    area = footprint(CAMERA, record.world_from_camera[2], 0.0)
    points = reference_points(record, area, frame, scale, 64, np.random.default_rng(0))
    world = to_world(points, frame, scale)
    np.testing.assert_allclose(world[:, 2], surface(world), atol=0.06)
    width = 2 * 100 * np.tan(np.radians(35))  # of the footprint of a 70 degree camera at 100 m
    assert 2 * scale == pytest.approx(width, rel=1e-6)


def test_an_unknown_choice_is_an_error() -> None:
    with pytest.raises(InputError, match="overlap or consecutive"):
        replace(EXACT, choice="best")


@pytest.mark.parametrize("world", [1, 3])
def test_the_sampler_covers_every_window_once_in_an_order_of_its_own(world: int) -> None:
    samplers = [WindowSampler(10, seed=1, shuffle=True, rank=rank, world=world) for rank in range(world)]
    drawn = [list(sampler) for sampler in samplers]
    counts = Counter(index for part in drawn for _, index in part)
    assert set(counts) == set(range(10))
    assert len({len(part) for part in drawn}) == 1
    assert sum(counts.values()) < 10 + world
    again = list(samplers[0])
    assert again == drawn[0]
    samplers[0].set_epoch(1)
    assert list(samplers[0]) != drawn[0]
    assert all(epoch == 1 for epoch, _ in samplers[0])


def test_a_mirrored_window_is_one_that_could_have_been_flown() -> None:
    batch = {name: value.numpy() for name, value in make_batch(1, frames=3).items()}
    sample = {name: batch[name][0] for name in ("images", "depth", "intrinsics", "camera_from_window")}
    sample["prior_from_window"], sample["reference"] = sample["camera_from_window"], batch["reference"][0]
    swapped = mirrored(sample)
    assert np.linalg.det(swapped["camera_from_window"][1, :3, :3]) == pytest.approx(1, abs=1e-5)
    point = np.array([*swapped["reference"][5], 1.0])
    for k in range(3):
        pixels = []
        for given, x in ((sample, point * [-1, 1, 1, 1]), (swapped, point)):
            local = given["intrinsics"][k] @ (given["camera_from_window"][k] @ x)[:3]
            pixels.append(local[:2] / local[2])
        width = sample["images"].shape[3]
        assert pixels[1] == pytest.approx([width - pixels[0][0], pixels[0][1]], abs=1e-3)
    np.testing.assert_array_equal(mirrored(swapped)["images"], sample["images"])


def test_other_colours_are_the_same_in_all_frames_of_a_window() -> None:
    image = np.random.default_rng(0).uniform(0.3, 0.7, (1, 3, 8, 8)).astype(np.float32)
    twice = np.concatenate([image, image])
    found = recoloured(twice, 0.3, np.random.default_rng(1))
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)
    assert np.abs(found - twice).max() > 0.02
    assert found.min() >= 0
    assert found.max() <= 1
    np.testing.assert_allclose(recoloured(twice, 0.0, np.random.default_rng(1)), twice, atol=1e-6)


def test_estimated_cameras_take_the_place_of_the_true_ones(record_folder: Path) -> None:
    data, plain = (WindowDataset([folder], EXACT, seed=5, augment=False) for folder in (record_folder, record_folder))
    number, chosen = data.windows[2]
    lost = chosen[2]
    found = make_record().world_from_camera.copy()
    found[:, 0, 3] += 0.5  # metres to the east, all alike
    found[lost] = np.nan
    data.estimated[number] = found
    item, exact = data[2], plain[2]
    scale = float(item["scale"])
    assert item["placed"].tolist() == [True, True, False]
    assert torch.equal(item["images"][2], item["images"][0])  # the reference again, as where neighbours are few
    away = torch.linalg.inv(item["true_camera_from_window"].double()) - torch.linalg.inv(
        item["camera_from_window"].double()
    )
    assert away[:2, :3, 3].numpy() * scale == pytest.approx(np.tile([-0.5, 0, 0], (2, 1)), abs=1e-4)
    assert "placed" not in exact
    assert torch.equal(item["images"][:2], exact["images"][:2])
    found[chosen[0]] = np.nan
    alone = data[2]
    assert not alone["placed"][0]
    assert all(torch.equal(alone["images"][k], exact["images"][0]) for k in range(3))
