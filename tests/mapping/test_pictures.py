"""Pictures show the right things in the right places."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from overfly.cloud import Cloud
from overfly.data.footprints import sees
from overfly.geometry import Camera, pose, rotation_from_gimbal
from overfly.mapping.facts import cloud_facts
from overfly.mapping.gallery import gallery, upright, views_per_cell
from overfly.mapping.oblique import oblique_view, splat
from overfly.mapping.pictures import hillshade, jpeg, nice_length, overview, png, top_view
from overfly.mapping.raster import Grid, Surface
from overfly.mapping.tiles import write_tiles


def town(n: int = 20_000) -> Cloud:
    """Grass, with a red roof 12 m up in the north-east."""
    points = np.random.default_rng(0).uniform([0, 0, 0], [100, 80, 0.05], (n, 3))
    roof = (points[:, 0] > 70) & (points[:, 1] > 50)
    points[roof, 2] += 12
    colors = np.where(roof[:, None], (200, 30, 30), (60, 140, 50)).astype(np.uint8)
    predicted = points[:, 0] < 20
    return Cloud(points, colors, views=np.where(predicted, 1, 3).astype(np.uint8), predicted=predicted)


def test_from_above_north_is_up_and_east_is_right() -> None:
    seen = overview(town())
    image = top_view(seen)
    rows, columns = image.shape[:2]
    assert image[rows // 8, -columns // 8].tolist() == [200, 30, 30]
    assert image[-rows // 8, columns // 8].tolist() == [60, 140, 50]
    assert seen.filled.mean() > 0.97  # no dots
    assert columns / rows == pytest.approx(100 / 80, rel=0.05)


def test_light_comes_from_the_north_west() -> None:
    rows, columns = np.mgrid[:20, :20]
    facing = Surface(Grid(0, 20, 1, 20, 20), 0.5 * (rows + columns).astype(float) * -1, None, np.ones((20, 20), int))
    away = Surface(facing.grid, -facing.heights, None, facing.counts)
    flat = Surface(facing.grid, 0 * facing.heights, None, facing.counts)
    middle = (10, 10)
    # heights fall towards the south-east: that slope turns its back to the light
    assert hillshade(facing)[middle] < hillshade(flat)[middle] < hillshade(away)[middle]
    assert hillshade(flat)[middle] == pytest.approx(np.sin(np.pi / 4), abs=1e-6)


def test_splat_keeps_the_nearest_point() -> None:
    colors = np.array([[255, 0, 0], [0, 255, 0]], np.uint8)
    for order in ([0, 1], [1, 0]):
        u, depth = np.array([5.5, 5.5]), np.array([10.0, 20.0])
        image = splat(u[order], u[order], depth[order], colors[order], 11, 11, 1)
        assert image[5, 5].argmax() == 0
        assert (image[0, 0] == 255).all()


def test_oblique_view_stands_the_roof_behind_the_grass() -> None:
    image = oblique_view(town(), width=300, height=200, azimuth_deg=0.0, elevation_deg=35.0)
    drawn = (image < 250).any(-1)
    assert 0.25 < drawn.mean() < 0.95
    red = np.argwhere((image[..., 0] > 90) & (image[..., 1] < 60))
    green = np.argwhere((image[..., 1] > 60) & (image[..., 0] < 80))
    assert len(red) > 50
    assert red[:, 0].mean() < green[:, 0].mean()  # north is further away, so higher in the picture
    assert red[:, 1].mean() > green[:, 1].mean()  # and east to the right
    rows, columns = np.nonzero(drawn)
    assert rows.min() > 0
    assert columns.max() < 299


def test_gallery_has_every_picture_and_counts_views() -> None:
    camera = Camera.from_fov(400, 320, 90)
    poses = np.stack([pose(rotation_from_gimbal(0, -90), [x, 40.0, 50.0]) for x in (20.0, 80.0)])
    shown, seen = gallery(
        town(),
        [camera] * 2,
        poses,
        ["a.jpg", "b.jpg"],
        gsd=0.25,
        unit="m",
        missing=[("c.jpg", np.array([50.0, 10, 50]))],
    )
    assert [p.title for p in shown] == [
        "From above", "Heights", "The cloud", "Images", "Overlap", "Measured and predicted ground",
    ]  # fmt: skip
    from PIL import Image

    for picture in shown:
        image = Image.open(io.BytesIO(picture.data))
        assert min(image.size) > 200
        assert np.asarray(image).std() > 5  # something is drawn
    assert seen.views is not None
    columns = seen.grid.columns
    row = seen.views[seen.grid.rows // 2]
    assert row[columns // 20] == 1  # x = 5 m: the first camera only
    assert row[columns // 2] == 2


def test_ground_that_two_images_see_and_that_has_no_point_is_counted(tmp_path: Path) -> None:
    camera = Camera.from_fov(400, 320, 90)
    poses = np.stack([pose(rotation_from_gimbal(0, -90), [x, 40.0, 50.0]) for x in (40.0, 60.0)])
    cloud = town()
    hole = (np.abs(cloud.points[:, 0] - 50) < 10) & (np.abs(cloud.points[:, 1] - 40) < 10)
    found = {}
    for name, some in (("whole", cloud), ("torn", cloud[~hole])):
        _, seen = gallery(some, [camera] * 2, poses, ["a.jpg", "b.jpg"], gsd=0.25, unit="m")
        assert seen.views is not None
        twice = np.count_nonzero(seen.views >= 2) * seen.grid.cell**2
        found[name] = cloud_facts(write_tiles(tmp_path / name, [some]), some, seen, 0.25)["unmatched_share"]
    assert found["whole"] < 0.02
    # What lies in the bend of an L is not within the map.
    bend = (cloud.points[:, 0] > 50) & (cloud.points[:, 1] > 40)
    _, seen = gallery(cloud[~bend], [camera] * 2, poses, ["a.jpg", "b.jpg"], gsd=0.25, unit="m")
    assert cloud_facts(write_tiles(tmp_path / "bent", [cloud]), cloud, seen, 0.25)["unmatched_share"] < 0.1
    assert found["torn"] == pytest.approx(400 / twice, rel=0.3)


@pytest.mark.parametrize(
    "gimbals",
    [
        [(30, -80), (210, -80), (30, -85)],  # strips there and back
        [(90, -45), (90, -45), (270, -45), (180, -45)],  # oblique
        [(yaw, -10) for yaw in range(0, 360, 45)],  # round a tower, to the horizon
        [(12, -88), (12, -88)],  # one strip
    ],
)
def test_an_unknown_up_is_found_from_the_cameras(gimbals: list[tuple[float, float]]) -> None:
    poses = np.stack([pose(rotation_from_gimbal(yaw, pitch), [yaw, 40.0, 50.0]) for yaw, pitch in gimbals])
    turned = np.eye(4)
    turned[:3, :3] = rotation_from_gimbal(77, -20, 140)
    for frame in (np.eye(4), turned):
        turn = upright(frame @ poses)
        np.testing.assert_allclose(turn[:3, :3] @ turn[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(turn[:3, :3]) > 0
        up = turn[:3, :3] @ frame[:3, 2]  # where true up goes
        assert up[2] > np.cos(np.radians(3))


def test_nice_lengths_and_files() -> None:
    assert [nice_length(v) for v in (0.3, 7, 26, 1999)] == [0.2, 5, 20, 1000]
    image = np.zeros((8, 8, 3), np.uint8)
    assert png(image).startswith(b"\x89PNG")
    assert jpeg(image).startswith(b"\xff\xd8")


def test_views_are_counted_as_if_every_cell_were_looked_at() -> None:
    seen = overview(town())
    camera = Camera(400, 320, 300.0, 310.0, 190.0, 165.0, k1=-0.15, k2=0.05, p1=0.002)
    poses = np.stack(
        [
            pose(rotation_from_gimbal(yaw, pitch), [x, y, 45.0])
            for x, y, yaw, pitch in ((20, 30, 0, -90), (70, 40, 45, -60), (-40, 10, 90, -20), (50, 50, 10, 60))
        ]
    )
    cells = np.concatenate([seen.grid.centres(), seen.heights[..., None]], axis=-1)
    plain = sum(sees(cells, camera, p).astype(float) for p in poses)
    found = views_per_cell(seen, [camera] * 4, poses)
    np.testing.assert_array_equal(found, np.where(seen.filled, plain, np.nan))
    assert 0 < np.nanmean(found) < 4
