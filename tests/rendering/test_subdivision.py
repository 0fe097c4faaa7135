"""Halved edges: the same surface with more faces, and the worst faces first."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import trimesh

from overfly.mesh import Mesh
from overfly.rendering import topology
from overfly.rendering.subdivision import SPLITS, sides, subdivide, wanted
from photographed import flat_mesh


def connections(faces: np.ndarray, vertices: int) -> tuple[np.ndarray, int]:
    """Edges [E, 2], and how many of them have one face only."""
    found = topology(faces, vertices)
    return found.edges.numpy(), len(found.edges) - len(found.pairs)


def halved_at_random(mesh: Mesh, share: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray, Mesh]:
    """Which edges were halved, the parents, and the finer mesh."""
    faces, (edges, _) = mesh.faces.astype(np.int64), connections(mesh.faces, len(mesh.vertices))
    halved = np.random.default_rng(seed).random(len(edges)) < share
    parents, new = subdivide(faces, edges, halved, len(mesh.vertices))
    return edges[halved], parents, Mesh(mesh.vertices[parents].mean(1), new.astype(np.int32))


def hilly() -> Mesh:
    mesh = flat_mesh(2.0)
    return Mesh(mesh.vertices + np.c_[np.zeros((len(mesh.vertices), 2)), np.sin(mesh.vertices[:, 0])], mesh.faces)


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 0.8, 1.0])
def test_the_surface_stays_the_same_without_gaps(share: float) -> None:
    for mesh in (hilly(), Mesh(*(lambda s: (s.vertices, s.faces))(trimesh.creation.icosphere(2)))):
        halved, parents, finer = halved_at_random(mesh, share)
        count = len(mesh.vertices)
        assert np.array_equal(parents[:count], np.arange(count)[:, None].repeat(2, 1))
        assert np.array_equal(parents[count:], halved)
        _, border = connections(mesh.faces, count)
        _, now = connections(finer.faces, len(finer.vertices))  # refuses edges with three faces
        outline = {tuple(e) for e in border_edges(mesh.faces, count)}
        assert now == border + sum(tuple(edge) in outline for edge in halved.tolist())
        assert finer.areas().sum() == pytest.approx(mesh.areas().sum(), rel=1e-12)
        assert finer.areas().min() > 0.05 * mesh.areas().min()
        inner = len(halved) - (now - border)
        assert len(finer.faces) == len(mesh.faces) + 2 * inner + (now - border)
        euler = count - len(connections(mesh.faces, count)[0]) + len(mesh.faces)
        edges = connections(finer.faces, len(finer.vertices))[0]
        assert len(finer.vertices) - len(edges) + len(finer.faces) == euler
        assert np.array_equal(np.unique(finer.faces), np.arange(len(finer.vertices)))


def border_edges(faces: np.ndarray, vertices: int) -> list[list[int]]:
    found = topology(faces, vertices)
    beside = np.bincount(sides(faces.astype(np.int64), found.edges.numpy(), vertices).ravel())
    return found.edges[np.flatnonzero(beside == 1)].tolist()


def test_faces_keep_their_winding() -> None:
    _, _, finer = halved_at_random(flat_mesh(2.0), 0.5)
    a, b, c = (finer.vertices[finer.faces[:, i]] for i in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()


@pytest.mark.parametrize("pattern", list(itertools.product((0, 1), repeat=3)), ids=str)
def test_every_pattern_of_halved_sides(pattern: tuple[int, int, int]) -> None:
    assert set(SPLITS) == set(itertools.product((0, 1), repeat=3))
    triangle, edges = np.array([[2, 0, 1]]), np.array([[0, 1], [0, 2], [1, 2]])  # sides 2-0, 0-1, 1-2
    ends = [[0, 2], [0, 1], [1, 2]]
    halved = np.array([pattern[ends.index(edge.tolist())] for edge in edges], bool)
    corners = np.array([[0.0, 0, 0], [4, 0, 0], [1, 3, 0]])
    parents, faces = subdivide(triangle, edges, halved, 3)
    finer = Mesh(corners[parents].mean(1), faces.astype(np.int32))
    assert len(faces) == 1 + sum(pattern)
    assert len(parents) == 3 + sum(pattern)
    a, b, c = (finer.vertices[finer.faces[:, i]] for i in range(3))
    areas = np.cross(b - a, c - a)[:, 2] / 2
    assert (areas > 0).all()  # the triangle 2, 0, 1 is counter-clockwise, too
    assert areas.sum() == pytest.approx(6.0)
    used = {frozenset(pair) for face in faces.tolist() for pair in itertools.combinations(face, 2)}
    for on, end in zip(pattern, ends, strict=True):
        assert (frozenset(end) in used) != bool(on)  # a halved side is gone, the others are left


def test_all_patterns_occur_in_one_mesh() -> None:
    mesh = hilly()
    edges, _ = connections(mesh.faces, len(mesh.vertices))
    halved = np.random.default_rng(0).random(len(edges)) < 0.5
    beside = halved[sides(mesh.faces.astype(np.int64), edges, len(mesh.vertices))]
    assert {tuple(row) for row in beside.astype(int).tolist()} == set(SPLITS)


def test_sides_name_the_edges_between_the_corners() -> None:
    faces = np.array([[0, 1, 2], [2, 1, 3]])
    edges = np.array([[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]])
    assert sides(faces, edges, 4).tolist() == [[0, 2, 1], [2, 3, 4]]


def scene() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Faces, edges, lengths and the plan middle of the faces."""
    mesh = flat_mesh(2.0)
    edges, _ = connections(mesh.faces, len(mesh.vertices))
    length = np.linalg.norm(mesh.vertices[edges[:, 0]] - mesh.vertices[edges[:, 1]], axis=1)
    return mesh.faces.astype(np.int64), edges, length, mesh.vertices[mesh.faces].mean(1)[:, :2]


@pytest.mark.parametrize("more", [0, 1, 2, 77, 400, 100_000])
def test_the_budget_is_a_limit_that_is_nearly_reached(more: int) -> None:
    faces, edges, length, _ = scene()
    error = np.random.default_rng(0).random(len(faces))
    budget = len(faces) + more
    halved = wanted(faces, edges, error, length, budget=budget, least=0.01)
    _, finer = subdivide(faces, edges, halved, int(faces.max()) + 1)
    assert len(finer) <= budget
    assert len(finer) >= min(budget - 1, 4 * len(faces))
    assert not wanted(faces, edges, error, length, budget=len(faces) - 50, least=0.01).any()


def test_the_largest_errors_come_first_and_short_edges_never() -> None:
    faces, edges, length, middle = scene()
    wrong = np.linalg.norm(middle - [6, 4], axis=1) < 4
    error = np.where(wrong, 10.0, 0.01)
    beside = sides(faces, edges, int(faces.max()) + 1)
    halved = wanted(faces, edges, error, length, budget=len(faces) + 60, least=0.01)
    assert halved.sum() >= 30
    assert np.isin(np.flatnonzero(halved), beside[wrong]).all()
    diagonal = length > 2.5
    worst = np.bincount(beside[wrong].ravel(), minlength=len(edges)) == 2
    assert halved[diagonal & worst].all()  # of equally wrong ones the longest
    assert not halved[~diagonal & worst].all()
    assert not wanted(faces, edges, error, length, budget=10**6, least=1.5).any()
    only = wanted(faces, edges, error, length, budget=10**6, least=1.2)
    assert np.array_equal(only, diagonal)
    assert not wanted(faces, edges, np.zeros(len(faces)), length, budget=10**6, least=0.01).any()
