"""Losses of a mesh's shape: known values, true gradients, no NaN for broken faces."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd import gradcheck

from overfly.mesh_losses import edge_length, laplacian, normal_consistency

# A roof: two triangles that share the edge 0-1 along x.
FACES = torch.tensor([[0, 1, 2], [1, 0, 3]])
EDGES = torch.tensor([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3]])
PAIRS = torch.tensor([[0, 1]])


def roof(rise: float = 0.0) -> Tensor:
    """The ridge lies ``rise`` above the two eaves."""
    return torch.tensor([[0, 0, rise], [1, 0, rise], [0.5, 1, 0], [0.5, -1, 0]], dtype=torch.float64)


def grid(side: int) -> tuple[Tensor, Tensor]:
    """An even plane of side x side vertices, with its edges along x and y."""
    y, x = torch.meshgrid(*[torch.arange(side, dtype=torch.float64)] * 2, indexing="ij")
    index = torch.arange(side * side).reshape(side, side)
    along_x = torch.stack([index[:, :-1], index[:, 1:]], -1).reshape(-1, 2)
    along_y = torch.stack([index[:-1], index[1:]], -1).reshape(-1, 2)
    return torch.stack([x, y, 0 * x], -1).reshape(-1, 3), torch.cat([along_x, along_y])


def test_laplacian_of_a_plane_and_of_a_spike() -> None:
    vertices, edges = grid(5)
    values = laplacian(vertices, edges).reshape(5, 5)
    assert values[1:-1, 1:-1].abs().max() == 0
    assert values[0, 0] == 0.5  # the mean of a corner's neighbours lies half an edge inwards in x and in y
    vertices[12, 2] = 3.0
    values = laplacian(vertices, edges).reshape(5, 5)
    assert values[2, 2] == 9.0
    assert values[1, 2] == (3 / 4) ** 2
    assert values[1, 1] == 0


def test_laplacian_equals_the_slow_form() -> None:
    vertices, edges = grid(6)
    vertices += torch.rand(vertices.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    slow = []
    for i, vertex in enumerate(vertices):
        neighbours = [int(b) for a, b in torch.cat([edges, edges.flip(1)]) if a == i]
        slow.append((vertices[neighbours].mean(0) - vertex).square().sum())
    torch.testing.assert_close(laplacian(vertices, edges), torch.stack(slow), rtol=1e-12, atol=1e-14)


def test_a_vertex_without_an_edge_has_no_laplacian() -> None:
    vertices = torch.cat([roof(), torch.full((1, 3), 9.0, dtype=torch.float64)])
    assert laplacian(vertices, EDGES)[4] == 0


def test_normals_of_a_roof() -> None:
    assert normal_consistency(roof(0), FACES, PAIRS).item() == 0
    right_angle = normal_consistency(roof(1), FACES, PAIRS)  # both slopes at 45 degrees
    torch.testing.assert_close(right_angle, torch.ones(1, dtype=torch.float64))
    folded = roof()
    folded[3, 1] = 1.0
    torch.testing.assert_close(normal_consistency(folded, FACES, PAIRS), torch.full((1,), 2.0, dtype=torch.float64))


def test_edge_length_is_squared() -> None:
    assert edge_length(roof(2), EDGES).tolist() == [1.0, 5.25, 5.25, 5.25, 5.25]


def test_gradcheck() -> None:
    vertices = roof(0.3).requires_grad_()
    assert gradcheck(lambda v: laplacian(v, EDGES), vertices)
    assert gradcheck(lambda v: normal_consistency(v, FACES, PAIRS), vertices)
    assert gradcheck(lambda v: edge_length(v, EDGES), vertices)


def test_degenerate_faces_have_neither_value_nor_gradient() -> None:
    for broken in (roof() * 0, roof() * torch.tensor([1.0, 0, 0]), roof().float() * 1e-15):
        vertices = broken.clone().requires_grad_()
        value = normal_consistency(vertices, FACES, PAIRS)
        assert value.tolist() == [0]
        for loss in (value, laplacian(vertices, EDGES), edge_length(vertices, EDGES)):
            assert torch.isfinite(torch.autograd.grad(loss.sum(), vertices)[0]).all()
        (gradient,) = torch.autograd.grad(normal_consistency(vertices, FACES, PAIRS).sum(), vertices)
        assert gradient.abs().max() == 0


def test_no_edges_and_no_pairs() -> None:
    none = torch.zeros(0, 2, dtype=torch.int64)
    assert laplacian(roof(), none).tolist() == [0] * 4
    assert edge_length(roof(), none).shape == normal_consistency(roof(), FACES, none).shape == (0,)
