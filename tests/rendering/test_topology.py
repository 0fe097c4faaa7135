"""Connections of triangle meshes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from overfly.errors import InputError
from overfly.rendering import topology


def test_two_triangles_by_hand() -> None:
    found = topology(np.array([[0, 1, 2], [2, 1, 3]]), 4)
    assert found.faces.dtype == found.neighbours.dtype == torch.int32
    assert found.neighbours.tolist() == [[1, -1, -1], [-1, -1, 0]]  # across 1-2, opposite corner 0 and corner 2
    assert found.edges.tolist() == [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]]
    assert found.pairs.tolist() == [[0, 1]]
    assert found.vertex_count == 4


def test_a_closed_mesh_has_three_neighbours_everywhere_and_they_share_the_side() -> None:
    mesh = trimesh.creation.icosphere(2)
    found = topology(torch.from_numpy(mesh.faces), len(mesh.vertices))
    assert (found.neighbours >= 0).all()
    assert len(found.edges) == len(found.pairs) == 3 * len(mesh.faces) // 2
    assert {tuple(e) for e in found.edges.tolist()} == {tuple(e) for e in mesh.edges_unique.tolist()}
    for k in range(3):
        side = found.faces[:, [(k + 1) % 3, (k + 2) % 3]]
        other = found.faces[found.neighbours[:, k].long()]
        assert (side[:, :, None] == other[:, None]).any(2).all()


def test_faces_without_area_and_no_faces_at_all_are_kept() -> None:
    found = topology(np.array([[0, 1, 2], [1, 1, 2], [2, 1, 3]]), 4)
    assert found.neighbours.tolist() == [[2, -1, -1], [-1, -1, -1], [-1, -1, 0]]
    empty = topology(np.zeros((0, 3), int), 0)
    assert empty.faces.shape == empty.neighbours.shape == (0, 3)
    assert len(empty.edges) == len(empty.pairs) == 0
    assert empty.to("cpu").vertex_count == 0


def test_what_is_no_surface_is_refused() -> None:
    with pytest.raises(InputError, match=r"^1 edges are shared by more than two faces: split"):
        topology(np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]), 5)
    with pytest.raises(InputError, match=r"^2 faces name vertices outside 0 to 2"):
        topology(np.array([[0, 1, 3], [0, 1, 2], [-1, 1, 2]]), 3)
    with pytest.raises(InputError, match=r"\(2, 4\)"):
        topology(np.zeros((2, 4), int), 3)
