"""The rough mesh: a height field within a budget of faces, with roofs, ground and colours where the cloud has them."""

from __future__ import annotations

import numpy as np
import pytest

from overfly.cloud import Cloud
from overfly.errors import InputError
from overfly.mapping.rough_mesh import FILL, cell_of, filled_share, rough_mesh, without_spikes
from overfly.mesh import Mesh
from overfly.rendering import topology

ROOF = 10.0


def box_on_plane(n: int = 60_000, side: float = 60.0) -> Cloud:
    """Ground at 0, green, and in its middle a box of 20 m with a red roof; no points on the walls."""
    rng = np.random.default_rng(0)
    xy = rng.uniform(-side / 2, side / 2, (n, 2))
    roof = (np.abs(xy) < 10).all(1)
    return Cloud(
        np.c_[xy, np.where(roof, ROOF, 0.0)], np.where(roof[:, None], [200, 30, 20], [20, 180, 40]).astype("u1")
    )


def normals(mesh: Mesh) -> np.ndarray:
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a)


@pytest.mark.parametrize("faces", [1000, 3000, 9000])
def test_the_budget_of_faces_is_kept(faces: int) -> None:
    assert len(rough_mesh(box_on_plane(), faces=faces).faces) == pytest.approx(faces, rel=0.1)


@pytest.mark.parametrize("faces", [1000, 5000])
def test_the_budget_is_kept_where_the_cloud_covers_only_a_part_of_its_grid(faces: int) -> None:
    points = box_on_plane().points
    strip = Cloud(points[np.abs(points[:, 0] - points[:, 1]) < 10])
    assert len(rough_mesh(strip, faces=faces).faces) == pytest.approx(faces, rel=0.1)


def test_what_only_closes_a_gap_is_told() -> None:
    cloud = box_on_plane()
    away = np.abs(cloud.points[:, :2] - [-20, -20]).max(1)
    torn = cloud[away > 5]
    assert filled_share(rough_mesh(cloud, faces=9000), cloud) < 0.01
    assert filled_share(rough_mesh(torn, faces=9000), torn) == pytest.approx(100 / 3600, rel=0.35)


def test_roof_and_ground_have_their_heights_and_nothing_lies_between() -> None:
    for faces in (300, 3000):
        mesh = rough_mesh(box_on_plane(), faces=faces)
        cell = 60 / np.sqrt(faces / 2)
        z, away = mesh.vertices[:, 2], np.abs(mesh.vertices[:, :2]).max(1) - 10
        np.testing.assert_allclose(z[away < -cell], ROOF, atol=1e-9)
        np.testing.assert_allclose(z[away > cell], 0, atol=1e-9)
        between = (z > 0.1 * ROOF) & (z < 0.9 * ROOF)
        assert between.mean() < 0.02  # a small part of the cells that the walls pass through


def test_colours_are_the_clouds_and_roofs_keep_theirs() -> None:
    mesh = rough_mesh(box_on_plane(), faces=3000)
    assert mesh.colors is not None
    assert mesh.colors.dtype == np.uint8
    z = mesh.vertices[:, 2]
    assert np.abs(mesh.colors[z == ROOF].astype(int) - [200, 30, 20]).max() <= 1
    assert np.abs(mesh.colors[z == 0].astype(int) - [20, 180, 40]).max() <= 1
    assert rough_mesh(Cloud(box_on_plane().points), faces=500).colors is None


def test_faces_look_up_are_connected_and_use_every_vertex() -> None:
    mesh = rough_mesh(box_on_plane(), faces=2000)
    assert (normals(mesh)[:, 2] > 0).all()
    found = topology(mesh.faces, len(mesh.vertices))  # refuses what is no surface
    assert np.array_equal(np.unique(mesh.faces), np.arange(len(mesh.vertices)))
    plan = normals(mesh)[:, 2].sum() / 2
    assert plan == pytest.approx(60 * 60, rel=0.1)
    border = 2 * len(found.edges) - 3 * len(mesh.faces)  # edges with one face
    assert border == pytest.approx(4 * np.sqrt(len(mesh.faces) / 2), rel=0.1)  # one outline and no holes


@pytest.mark.parametrize(("cells", "closed"), [(FILL, True), (4 * FILL, False)])
def test_gaps_are_closed_up_to_the_limit(cells: int, closed: bool) -> None:
    points = box_on_plane(200_000).points
    half = cells / 2 * np.sqrt(2 * 60 * 60 / 9000)
    gap = (np.abs(points[:, 0]) < half) & (np.abs(points[:, 1]) < half)
    mesh = rough_mesh(Cloud(points[~gap] * [1, 1, 0] + [0, 0, 5]), faces=9000)
    inside = (np.abs(mesh.vertices[:, :2]) < half / 4).all(1)
    assert inside.any() == closed
    np.testing.assert_allclose(mesh.vertices[:, 2], 5)


def test_the_diagonal_follows_the_edge_of_a_roof() -> None:
    """Along a diagonal ridge no triangle cuts from the lower to the upper side."""
    rng = np.random.default_rng(1)
    xy = rng.uniform(0, 20, (100_000, 2))
    mesh = rough_mesh(Cloud(np.c_[xy, -np.abs(xy[:, 0] - xy[:, 1])]), faces=800)
    z = mesh.vertices[mesh.faces][..., 2]
    middle = mesh.vertices[mesh.faces][..., :2].mean(1)
    error = np.abs(z.mean(1) + np.abs(middle[:, 0] - middle[:, 1]))
    assert error.mean() < 0.1


def test_what_is_no_ground_is_refused() -> None:
    cloud = box_on_plane(2000)
    with pytest.raises(InputError, match=r"^A mesh of 7 faces shows no landscape: ask for"):
        rough_mesh(cloud, faces=7)
    with pytest.raises(InputError, match=r"^5 points are too few"):
        rough_mesh(Cloud(cloud.points[:5]), faces=100)
    apart = np.c_[np.repeat(np.arange(10.0), 10), np.tile(np.arange(10.0), 10), np.zeros(100)]
    with pytest.raises(InputError, match="no connected ground"):
        rough_mesh(Cloud(apart), faces=30_000)
    for line in (apart * [1, 0, 0], apart * [0, 0, 1], apart * [0, 1e-9, 0]):
        with pytest.raises(InputError, match="no connected ground"):
            rough_mesh(Cloud(line), faces=1000)


def test_a_few_neighbours_in_a_sparse_cloud_do_not_make_cells_without_number() -> None:
    rng = np.random.default_rng(2)
    sparse = np.c_[rng.uniform(0, 100, (600, 2)), np.zeros(600)]
    dense = np.c_[rng.uniform(50, 53, (400, 2)), np.zeros(400)]
    mesh = rough_mesh(Cloud(np.concatenate([sparse, dense])), faces=2000)
    assert 0 < len(mesh.faces) <= 2200


def test_spikes_go_and_edges_of_roofs_stay() -> None:
    rough = rough_mesh(box_on_plane(), faces=3000)
    assert cell_of(rough) == pytest.approx(60 / np.sqrt(1500), rel=0.05)
    mesh = without_spikes(rough)
    changed = mesh.vertices != rough.vertices
    assert changed.sum() <= 2  # half way up a wall
    assert np.isin(mesh.vertices[changed], [0, ROOF]).all()
    x, y, _ = mesh.vertices.T
    ground = np.flatnonzero((np.abs(x) < 25) & (np.abs(y) < 25) & ((np.abs(x) > 14) | (np.abs(y) > 14)))
    alone = ground[::37]  # no two of them side by side, but for the pair
    pair = mesh.faces[(mesh.faces == alone[0]).any(1)][0][:2]
    raised = np.concatenate([alone, pair])
    vertices, colors = mesh.vertices.copy(), mesh.colors
    assert colors is not None
    vertices[raised, 2] = np.where(np.arange(len(raised)) % 2, 12.0, -12.0)
    vertices[pair, 2] = 15.0
    colors = colors.copy()
    colors[raised] = 255
    clean = without_spikes(Mesh(vertices, mesh.faces, colors))
    np.testing.assert_allclose(clean.vertices, mesh.vertices, atol=1e-9)
    assert clean.colors is not None
    assert np.abs(clean.colors[raised].astype(int) - [20, 180, 40]).max() <= 1
