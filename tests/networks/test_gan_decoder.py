"""The faithful network: shapes, the generator's start from the encoder, invariance of the discriminator."""

from __future__ import annotations

import pytest
import torch

from overfly.errors import InputError
from overfly.networks import GanDecoder
from overfly.networks.discriminator import z_order
from overfly.networks.ground import initial_cloud
from terrain import make_batch, make_network


@pytest.fixture
def network() -> GanDecoder:
    return make_network()


def test_shapes(network: GanDecoder) -> None:
    batch = make_batch(2)
    output = network(batch)
    assert output["points"].shape == (2, 256, 3)
    assert output["features"].shape == (2, 3, 32)
    assert output["match_map"].shape == (2, 3, 8, 16, 32)
    assert output["correction"].shape == (2, 2, 6)
    assert torch.allclose(output["descriptor"].norm(dim=-1), torch.ones(2, 3))
    assert torch.allclose(output["match_map"].norm(dim=2), torch.ones(2, 3, 16, 32), atol=1e-5)


@pytest.mark.parametrize("frames", [1, 2, 5])
def test_any_number_of_frames_gives_one_cloud(network: GanDecoder, frames: int) -> None:
    assert network(make_batch(2, frames=frames))["points"].shape == (2, 256, 3)


def test_initial_cloud_is_uniform_and_flat() -> None:
    batch = make_batch(1)
    height, width = batch["images"].shape[-2:]
    cloud = initial_cloud(16, batch)[0]  # from the image's top left: north-west
    assert torch.allclose(cloud[0], torch.tensor([-0.75, 0.75 * height / width, 0]), atol=1e-5)
    assert torch.allclose(cloud[1], torch.tensor([-0.25, 0.75 * height / width, 0]), atol=1e-5)
    assert torch.allclose(cloud[15], torch.tensor([0.75, -0.75 * height / width, 0]), atol=1e-5)
    with pytest.raises(InputError, match="points=1024"):
        initial_cloud(1000, batch)


def test_first_clouds_are_nearly_the_initial_cloud(network: GanDecoder) -> None:
    network.eval()
    batch = make_batch(1)
    assert (network(batch)["points"] - initial_cloud(256, batch)).abs().max() < 0.5


def test_generator_blocks_start_as_the_encoders(network: GanDecoder) -> None:
    network.train()
    network(make_batch(2))  # so that batch statistics differ from their start
    line = network.generator.start_from(network.encoder)
    assert "10 residual blocks" in line
    assert "2 3 2 3 2 3 2 3 2 3" in line  # widths 4, 8, 8, 16; the generator has 8
    for number, block in enumerate(network.generator.blocks):
        source = network.encoder.blocks[1 + number % 2].state_dict()
        for key, value in block.state_dict().items():
            assert torch.equal(value, source[key]), key


def test_generator_of_a_width_that_the_encoder_lacks_is_refused() -> None:
    network = make_network(generator={"width": 12})
    with pytest.raises(InputError, match=r"12 channels.*\[4, 8, 8, 16\]"):
        network.generator.start_from(network.encoder)


def test_concatenating_the_features_to_every_point_is_what_the_entry_computes(network: GanDecoder) -> None:
    generator, code = network.generator, torch.randn(1, 32)
    initial = initial_cloud(256, make_batch(1))[0]
    weight = torch.cat([generator.from_features.weight, generator.from_point.weight], 1)
    joined = torch.cat([code.expand(256, -1), initial], 1)
    expected = joined @ weight.T + generator.from_features.bias
    entry = generator.from_features(code)[:, None] + generator.from_point(initial)
    assert torch.allclose(entry[0], expected, atol=1e-6)


def test_discriminator_does_not_care_for_the_order_of_points(network: GanDecoder) -> None:
    cloud = torch.rand(3, 256, 3) * 2 - 1
    shuffled = cloud[:, torch.randperm(256)]
    assert torch.equal(network.discriminator(cloud), network.discriminator(shuffled))
    assert not torch.allclose(network.discriminator.logits(cloud), network.discriminator.logits(cloud * 0.5))
    assert torch.allclose(network.discriminator(cloud), torch.sigmoid(network.discriminator.logits(cloud)))


def test_discriminator_has_neither_pooling_by_maximum_nor_batch_statistics(network: GanDecoder) -> None:
    kinds = {type(module).__name__ for module in network.discriminator.modules()}
    assert not any("MaxPool" in kind or "BatchNorm" in kind for kind in kinds)
    slopes = [m.negative_slope for m in network.discriminator.modules() if isinstance(m, torch.nn.LeakyReLU)]
    assert set(slopes) == {0.3}


def test_every_point_of_a_cloud_reaches_the_discriminator(network: GanDecoder) -> None:
    cloud = (torch.rand(1, 256, 3) * 2 - 1).requires_grad_()
    network.discriminator.logits(cloud).sum().backward()
    assert cloud.grad is not None
    assert (cloud.grad.abs().sum(-1) > 0).all()


def test_z_order_keeps_quarters_together() -> None:
    cloud = torch.rand(1, 400, 3) * 2 - 1
    ordered = cloud[0, z_order(cloud)[0]]
    quarter = (ordered[:, 0] > 0).long() + 2 * (ordered[:, 1] > 0).long()
    assert (quarter.diff() != 0).sum() == 3


def test_images_of_another_size_are_refused(network: GanDecoder) -> None:
    with pytest.raises(InputError, match="64 x 32 pixels, not 96 x 32"):
        network(make_batch(1, width=96))
    with pytest.raises(InputError, match=r"image_size=\[96,64\]"):
        make_network(size=[100, 70])


def test_a_window_does_not_influence_its_neighbours_in_the_batch(network: GanDecoder) -> None:
    network.eval()
    batch = make_batch(3)
    alone = {key: value[1:2] for key, value in batch.items()}
    assert torch.allclose(network(batch)["points"][1], network(alone)["points"][0], atol=1e-5)
