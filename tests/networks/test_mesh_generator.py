"""The networks that hold a scene's mesh: they start from it exactly, learn, are subdivided, saved and resumed."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn
from torch.autograd import gradcheck

from overfly.networks.mesh_generator import FreeVertices, MeshGenerator, PReLU, clamped

KINDS = [FreeVertices, MeshGenerator]


def rough(count: int = 50, seed: int = 0) -> tuple[Tensor, Tensor]:
    """A cloud of vertices about 80 m wide, off the origin, and colours that include black and white."""
    generator = torch.Generator().manual_seed(seed)
    vertices = torch.rand(count, 3, generator=generator) * torch.tensor([80.0, 60, 15]) + torch.tensor([20.0, -9, 3])
    colors = torch.rand(count, 3, generator=generator)
    colors[0], colors[-1] = 0, 1
    return vertices, colors


def trained(kind: type[nn.Module], count: int = 50, steps: int = 5, **options: int) -> nn.Module:
    """A network that has followed a random target for a few steps."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = kind(*rough(count), step=0.1, **options)
    vertices, colors = rough(count, seed=1)
    optimiser = torch.optim.Adam(network.parameters(), lr=0.01)
    for _ in range(steps):
        optimiser.zero_grad()
        present, painted = network()
        ((present - vertices).square().mean() + (painted - colors).square().mean()).backward()
        optimiser.step()
    return network


@pytest.mark.parametrize("kind", KINDS)
def test_the_first_mesh_is_the_rough_one(kind) -> None:
    vertices, colors = rough()
    network = kind(vertices.double(), colors.double(), step=0.1)
    for got, wanted in zip(network(), (vertices, colors)):
        assert got.dtype == torch.float32
        assert got.requires_grad
        assert torch.equal(got, wanted)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_reach_every_parameter(kind) -> None:
    network = trained(kind, steps=2)
    network.zero_grad()
    vertices, colors = network()
    (vertices.square().sum() + colors.square().sum()).backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.abs().max() > 0, name
    if kind is MeshGenerator:
        assert (network.codes.grad.abs().amax(1) > 0).all()  # every vertex has its own say


@pytest.mark.parametrize("kind", KINDS)
def test_both_learn_details_that_no_neighbour_shares(kind) -> None:
    """A random offset and colour for every vertex: the generator's codes must hold them."""
    vertices, colors = rough()
    generator = torch.Generator().manual_seed(5)
    target = vertices + 0.1 * torch.randn(vertices.shape, generator=generator)
    painted = (colors + 0.1 * torch.randn(vertices.shape, generator=generator)).clamp(0, 1)

    def loss() -> Tensor:
        present = network()
        return (present[0] - target).square().mean() + (present[1] - painted).square().mean()

    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = kind(vertices, colors, step=0.1)
    optimiser = torch.optim.Adam(network.parameters(), lr=0.01)
    start = loss().item()
    for _ in range(150):
        optimiser.zero_grad()
        loss().backward()
        optimiser.step()
    assert loss() < 0.3 * start


def test_adam_moves_a_vertex_by_learning_rate_times_step() -> None:
    network = FreeVertices(*rough(), step=0.25, color_step=0.5)
    optimiser = torch.optim.Adam(network.parameters(), lr=0.1)
    vertices, colors = network()
    (vertices.sum() + colors[2:].sum()).backward()
    optimiser.step()
    torch.testing.assert_close(network()[0], vertices - 0.025, rtol=0, atol=1e-5)
    torch.testing.assert_close(network()[1][2:], (colors[2:] - 0.05).clamp(0, 1), rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_subdivision_carries_the_present_mesh_over(kind) -> None:
    network = trained(kind)
    kept = torch.arange(50)[:, None].expand(-1, 2)
    middles = torch.randint(50, (70, 2), generator=torch.Generator().manual_seed(3))
    parents = torch.cat([kept, middles])
    state = torch.random.get_rng_state()
    finer = network.subdivided(parents)
    assert torch.equal(torch.random.get_rng_state(), state)
    for old, new in zip(network(), finer()):
        assert torch.equal(new[:50], old)
        assert torch.equal(new, (old[parents[:, 0]] + old[parents[:, 1]]) / 2)
    if kind is MeshGenerator:
        assert torch.equal(finer.codes[:50], network.codes)
        assert torch.equal(finer.stem.weight, network.stem.weight)
        assert torch.equal(finer.blocks[1].residual[1].weight, network.blocks[1].residual[1].weight)
        assert finer.head.weight.abs().max() == 0
        assert torch.equal(finer.scale, network.scale)
    again = finer.subdivided(torch.arange(120)[:, None].expand(-1, 2))  # and once more, after learning on
    assert torch.equal(again()[0], finer()[0])
    assert (finer.step, finer.color_step) == (network.step, network.color_step)


@pytest.mark.parametrize("kind", KINDS)
def test_a_saved_network_goes_on_elsewhere(kind, tmp_path) -> None:
    finer = trained(kind).subdivided(torch.randint(50, (80, 2), generator=torch.Generator().manual_seed(3)))
    optimiser = torch.optim.Adam(finer.parameters(), lr=0.01)
    finer()[0].square().sum().backward()
    optimiser.step()
    torch.save(finer.state_dict(), tmp_path / "weights.pt")
    resumed = kind(*rough(20, seed=8), step=0.1)  # another mesh of another size
    held = dict(resumed.named_parameters())
    resumed.load_state_dict(torch.load(tmp_path / "weights.pt", weights_only=True))
    assert all(parameter is held[name] for name, parameter in resumed.named_parameters())
    for got, wanted in zip(resumed(), finer()):
        assert torch.equal(got, wanted)


def test_the_mesh_generator_s_options() -> None:
    network = trained(MeshGenerator, width=8, blocks=1, code=0, frequencies=2)
    assert network.stem.weight.shape == (8, 3 + 12 + 3)
    finer = network.subdivided(torch.tensor([[0, 1], [2, 2]]))
    assert torch.equal(finer()[0], network()[0][[0, 1, 2, 2]].reshape(2, 2, 3).mean(1))
    assert finer.options == network.options


def test_one_vertex_has_no_extent_and_works() -> None:
    vertices, colors = rough(1)
    assert torch.equal(MeshGenerator(vertices, colors, step=0.1)()[0], vertices)


def test_clamped_colors_find_their_way_back() -> None:
    colors = torch.tensor([-0.5, -0.5, 0.5, 1.5, 1.5], requires_grad=True)
    assert clamped(colors).tolist() == [0, 0, 0.5, 1, 1]
    clamped(colors).backward(torch.tensor([1.0, -1, 1, 1, -1]))
    assert colors.grad.tolist() == [0, -1, 1, 1, 0]  # descent would lead 0 and 4 farther out


def test_prelu_is_torch_s() -> None:
    features = torch.randn(7, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64, requires_grad=True)
    ours, theirs = PReLU().double(), nn.PReLU().double()
    torch.testing.assert_close(ours(features), theirs(features))
    for network in (ours, theirs):
        network(features).square().sum().backward()
    torch.testing.assert_close(ours.weight.grad, theirs.weight.grad)
    assert gradcheck(ours, features)


def test_the_mesh_s_shape_is_checked() -> None:
    vertices, colors = rough()
    for kind in KINDS:
        with pytest.raises(ValueError, match=r"colours \[V, 3\], not \(50, 3\) and \(49, 3\)"):
            kind(vertices, colors[1:], step=0.1)
