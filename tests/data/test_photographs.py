"""Photographs through a pinhole, which of them are held out, and their pairs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from overfly.data.photographs import NEIGHBOURS, PhotographPairs, Photographs, held_out, photographs, undistorted
from overfly.errors import InputError
from overfly.flights import Frame
from overfly.geometry import Camera, pixel_grid, pose, project, rotation_from_gimbal, unproject

LENS = Camera(200, 150, 180.0, 182.0, 104.0, 71.0, k1=-0.15, k2=0.05, p1=0.002, p2=-0.001)


def nadir(x: float, y: float = 0.0, z: float = 50.0) -> np.ndarray:
    return pose(rotation_from_gimbal(20, -80, 3), [x, y, z])


def frame(folder: Path, name: str, image: np.ndarray, camera: Camera, world_from_camera: np.ndarray) -> Frame:
    path = folder / f"{name}.png"
    Image.fromarray(image).save(path)
    size = {"width": camera.width, "height": camera.height}
    return Frame(name=path.name, path=path, camera=camera, world_from_camera=world_from_camera, **size)


def dot(camera: Camera, at: np.ndarray) -> np.ndarray:
    """A soft white dot on black, its middle at a pixel [2]."""
    away = pixel_grid(camera.width, camera.height) - at
    return np.repeat(np.rint(255 * np.exp(-(away**2).sum(-1) / 8))[..., None], 3, 2).astype(np.uint8)


def middle(image: np.ndarray) -> np.ndarray:
    """The pixel [2] in the middle of a dot in [H, W]."""
    weights = np.where(image > 0.1, image, 0.0)
    return (pixel_grid(image.shape[1], image.shape[0]) * weights[..., None]).sum((0, 1)) / weights.sum()


def some(folder: Path, count: int = 12, hold_out: int = 4) -> Photographs:
    """One strip, 10 m between photographs."""
    camera = Camera(32, 32, 30.0, 30.0, 16.0, 16.0)
    image = np.zeros((32, 32, 3), np.uint8)
    frames = [frame(folder, f"{i:02d}", image, camera, nadir(10.0 * i)) for i in range(count)]
    return photographs(frames, width=None, hold_out=hold_out, multiple=16, origin=np.zeros(3))


@pytest.mark.parametrize("width", [None, 112])
def test_a_point_is_where_the_pinhole_sees_it(tmp_path: Path, width: int | None) -> None:
    """Lens, size, cut and shift at once: known points against their dots in the undistorted photograph."""
    origin = np.array([1000.0, -2000.0, 100.0])
    for i, (u, v) in enumerate([(30.0, 25.0), (172.0, 120.0), (100.0, 75.0), (165.0, 20.0)]):
        pose_of = nadir(1000 + i, -2000, 150)
        point = unproject(np.array([[u, v]]), np.array([40.0]), LENS, pose_of)
        seen, _ = project(point, LENS, pose_of)
        np.testing.assert_allclose(seen, [[u, v]], atol=1e-6)  # of the real, bent camera
        two = [frame(tmp_path, f"{i}_{k}", dot(LENS, seen[0]), LENS, pose_of) for k in range(2)]
        found = photographs(two, width=width, hold_out=0, multiple=16, origin=origin)
        assert found.size == ((192, 144) if width is None else (112, 80))
        local = found.camera_from_local[0] @ np.r_[point[0] - origin, 1]
        told = (found.intrinsics[0] @ local[:3])[:2] / local[2]
        assert np.linalg.norm(middle(found.images[0, 0]) - told) < 0.3, (u, v)
        bent = seen[0] * (1 if width is None else width / 200)
        assert i == 2 or np.linalg.norm(bent - told) > 0.5  # the lens matters


def test_what_the_photograph_does_not_cover_is_not_valid() -> None:
    image = np.full((LENS.height, LENS.width, 3), 200, np.uint8)
    barrel, pincushion = replace(LENS, k1=0.2, k2=0.0), replace(LENS, k1=-0.2, k2=0.0)
    for camera in (barrel, pincushion):
        _, valid = undistorted(image, camera)
        ideal = camera.undistorted()
        pixels = pixel_grid(camera.width, camera.height).reshape(-1, 2)
        points = unproject(pixels, np.ones(len(pixels)), ideal, np.eye(4))
        source, _ = project(points, camera, np.eye(4))
        inside = ((source >= 0.5) & (source <= [camera.width - 0.5, camera.height - 0.5])).all(1)
        sure = np.abs(source - np.clip(source, 0.5, [camera.width - 0.5, camera.height - 0.5])).max(1)
        differs = valid.ravel() != inside
        assert not (differs & ((sure > 0.01) | inside)).any()
    assert not undistorted(image, barrel)[1][0, 0]
    assert undistorted(image, pincushion)[1].all()
    same, valid = undistorted(image, LENS.undistorted())
    assert same is image
    assert valid.all()


def test_intrinsics_follow_size_and_cut(tmp_path: Path) -> None:
    camera = Camera(100, 75, 90.0, 92.0, 48.0, 40.0)
    image = np.random.default_rng(0).integers(0, 255, (75, 100, 3), dtype=np.uint8)
    two = [frame(tmp_path, f"{i}", image, camera, nadir(i)) for i in range(2)]
    whole = photographs(two, width=4000, hold_out=0, multiple=16, origin=np.zeros(3))
    assert whole.images.shape == (2, 3, 64, 96)
    np.testing.assert_allclose(whole.intrinsics[0], camera.matrix())
    np.testing.assert_allclose(whole.images[0], image[:64, :96].transpose(2, 0, 1) / 255, atol=1e-6)
    assert whole.images.dtype == whole.intrinsics.dtype == whole.camera_from_local.dtype == np.float32
    half = photographs(two, width=50, hold_out=0, multiple=16, origin=np.zeros(3))
    assert half.size == (48, 32)
    np.testing.assert_allclose(half.intrinsics[0, 0], [45, 0, 24])
    np.testing.assert_allclose(half.intrinsics[0, 1], [0, 92 * 38 / 75, 40 * 38 / 75], rtol=1e-6)
    first = half.cameras[0]
    assert (first.width, first.height, first.is_distorted) == (48, 32, False)
    np.testing.assert_allclose(first.matrix(), half.intrinsics[0])


def test_the_origin_becomes_zero(tmp_path: Path) -> None:
    image, camera = np.zeros((32, 32, 3), np.uint8), Camera(32, 32, 30.0, 30.0, 16.0, 16.0)
    far = np.array([500_000.0, 5_000_000.0, 300.0])
    two = [frame(tmp_path, f"{i}", image, camera, nadir(far[0] + i, far[1], far[2] + 50)) for i in range(2)]
    found = photographs(two, width=None, hold_out=0, multiple=16, origin=far)
    centres = -np.einsum("nji,nj->ni", found.camera_from_local[:, :3, :3], found.camera_from_local[:, :3, 3])
    np.testing.assert_allclose(centres, [[0, 0, 50], [1, 0, 50]], atol=1e-4)
    np.testing.assert_array_equal(found.origin, far)


@pytest.mark.parametrize(
    ("count", "every", "held"),
    [
        (12, 6, [3, 9]), (13, 6, [3, 9]), (6, 2, [1, 3]), (7, 2, [1, 3, 5]), (10, 3, [1, 4, 7]), (4, 6, [2]),
        (3, 6, [1]), (2, 6, []), (2, 2, []), (9, 0, []), (20, 100, [10]),
    ],
)  # fmt: skip
def test_the_middle_of_every_few_is_held_out(count: int, every: int, held: list[int]) -> None:
    assert np.flatnonzero(held_out(count, every)).tolist() == held


def test_the_ends_are_never_held_out() -> None:
    for count in range(2, 40):
        for every in (0, *range(2, 45)):
            found = held_out(count, every)
            assert not found[[0, -1]].any(), (count, every)
            assert found.any() == (every > 0 and count > 2), (count, every)


def test_what_cannot_be_refined_on_is_refused(tmp_path: Path) -> None:
    for every in (1, -1, -6):
        with pytest.raises(InputError, match=f"^hold_out={every} leaves no photograph to refine on: hold out every"):
            held_out(10, every)
    image, camera = np.zeros((40, 40, 3), np.uint8), Camera(40, 40, 30.0, 30.0, 20.0, 20.0)
    one = frame(tmp_path, "one", image, camera, nadir(0))
    options = {"width": None, "hold_out": 0, "multiple": 16, "origin": np.zeros(3)}
    with pytest.raises(InputError, match=r"^1 photograph cannot show depth"):
        photographs([one], **options)
    wide = frame(tmp_path, "wide", np.zeros((40, 60, 3), np.uint8), replace(camera, width=60), nadir(1))
    with pytest.raises(InputError, match=r"several sizes \(32 x 32 and 48 x 32\)"):
        photographs([one, wide], **options)
    with pytest.raises(InputError, match=r"^one\.png is compared at only 12 x 12 pixels"):
        photographs([one, one], **{**options, "width": 12})


def test_pairs_are_near_reproducible_and_never_held_out_or_the_same(tmp_path: Path) -> None:
    shots = some(tmp_path)
    shots.images[:] = np.arange(12, dtype=np.float32)[:, None, None, None] / 12  # so that each is known by its colour
    pairs = PhotographPairs(shots, ~shots.held_out, seed=3)
    assert pairs.indices.tolist() == np.flatnonzero(~shots.held_out).tolist()
    drawn: dict[int, set[int]] = {}
    for epoch in range(40):
        for place in range(len(pairs)):
            item = pairs[epoch, place]
            index, other = int(item["index"]), round(float(item["other_image"][0, 0, 0]) * 12)
            assert index == pairs.indices[place]
            assert torch.equal(item["image"], torch.from_numpy(shots.images[index]))
            for name, values in (("intrinsics", shots.intrinsics), ("camera_from_local", shots.camera_from_local)):
                assert torch.equal(item[f"other_{name}"], torch.from_numpy(values[other]))
            drawn.setdefault(index, set()).add(other)
    free = np.flatnonzero(~shots.held_out)
    for index, others in drawn.items():
        away = np.sort(np.abs(free[free != index] - index))
        assert len(others) == NEIGHBOURS
        assert index not in others
        assert not shots.held_out[list(others)].any()
        assert max(abs(other - index) for other in others) <= away[NEIGHBOURS - 1]
    again = PhotographPairs(shots, ~shots.held_out, seed=3)
    other_seed = PhotographPairs(shots, ~shots.held_out, seed=4)

    def order(which: PhotographPairs, epoch: int) -> list[float]:
        return [float(which[epoch, place]["other_image"].mean()) for place in range(len(which))]

    assert order(pairs, 5) == order(again, 5)
    assert order(pairs, 5) != order(pairs, 6)
    assert order(pairs, 5) != order(other_seed, 5)


def test_held_out_photographs_are_paired_with_those_that_are_refined_on(tmp_path: Path) -> None:
    shots = some(tmp_path)
    shots.images[:] = np.arange(12, dtype=np.float32)[:, None, None, None] / 12
    pairs = PhotographPairs(shots, shots.held_out, seed=0)
    assert [int(pairs[place]["index"]) for place in range(len(pairs))] == np.flatnonzero(shots.held_out).tolist()
    for epoch in range(10):
        for place in range(len(pairs)):
            assert not shots.held_out[round(float(pairs[epoch, place]["other_image"][0, 0, 0]) * 12)]


def test_two_photographs_are_each_others_pair(tmp_path: Path) -> None:
    shots = some(tmp_path, count=2, hold_out=6)
    pairs = PhotographPairs(shots, ~shots.held_out, seed=0)
    for place in range(2):
        assert torch.equal(
            pairs[place]["other_camera_from_local"], torch.from_numpy(shots.camera_from_local[1 - place])
        )
