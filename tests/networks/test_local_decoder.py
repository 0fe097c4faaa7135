"""The local decoder: what its points are shown, and that the stages train it."""

from __future__ import annotations

from functools import partial

import lightning as L
import pytest
import torch
from torch.utils.data import DataLoader

from overfly import losses
from overfly.errors import InputError
from overfly.networks import LocalDecoder
from overfly.networks.ground import initial_cloud
from overfly.networks.local_decoder import shown
from overfly.stages import EncoderStage, FullStage, GanStage
from terrain import make_batch, make_local_network


@pytest.fixture
def network() -> LocalDecoder:
    return make_local_network()


def test_shapes(network: LocalDecoder) -> None:
    output = network(make_batch(2))
    assert output["points"].shape == (2, 256, 3)
    assert output["match_map"].shape == (2, 3, 8, 16, 32)
    assert output["correction"].shape == (2, 2, 6)
    assert output["descriptor"].shape == (2, 3, 16)


@pytest.mark.parametrize("frames", [1, 2, 5])
def test_any_number_of_frames_gives_one_cloud(network: LocalDecoder, frames: int) -> None:
    assert network(make_batch(2, frames=frames))["points"].shape == (2, 256, 3)


def test_first_clouds_are_nearly_the_initial_cloud(network: LocalDecoder) -> None:
    batch = make_batch(1)
    assert (network.eval()(batch)["points"] - initial_cloud(256, batch)).abs().max() < 0.5


def test_points_are_shown_the_features_of_their_places() -> None:
    batch = make_batch(1, frames=2)
    rows, columns = torch.meshgrid(torch.arange(16) + 0.5, torch.arange(32) + 0.5, indexing="ij")
    maps = torch.stack([2 * columns, 2 * rows])[None, None].expand(1, 2, -1, -1, -1)  # every cell shows its pixel
    camera, intrinsics = batch["camera_from_window"], batch["intrinsics"]
    points = torch.tensor([[[0.0, 0.0, 0.0], [0.3, 0.2, 0.1], [9.0, 9.0, 0.0]]])
    mean, spread, share = shown(points, maps, camera, intrinsics)
    pixels = []
    for k in range(2):
        local = points @ camera[:, k, :3, :3].transpose(1, 2) + camera[:, k, None, :3, 3]
        at = local @ intrinsics[:, k].transpose(1, 2)
        pixels.append(at[..., :2] / at[..., 2:])
    both = torch.stack(pixels)[:, 0, :2]
    assert torch.allclose(mean[0, :2], both.mean(0), atol=1e-3)
    assert torch.allclose(spread[0, :2], both.std(0, correction=0), atol=2e-3)
    assert share[0, :, 0].tolist() == [1, 1, 0]
    assert not mean[0, 2].any()
    assert not spread[0, 2].any()


def test_frames_that_do_not_see_a_point_do_not_count() -> None:
    batch = make_batch(1, frames=2)
    maps = torch.randn(1, 2, 8, 16, 32)
    away = batch["camera_from_window"].clone()
    away[:, 1, 0, 3] += 50
    mean, spread, share = shown(initial_cloud(16, batch), maps, away, batch["intrinsics"])
    alone, _, _ = shown(
        initial_cloud(16, batch), maps[:, :1], batch["camera_from_window"][:, :1], batch["intrinsics"][:, :1]
    )
    assert torch.allclose(mean, alone)
    assert spread.max() < 1e-2
    assert (share == 0.5).all()


def test_a_window_does_not_influence_its_neighbours_in_the_batch(network: LocalDecoder) -> None:
    batch = make_batch(3)
    alone = {key: value[1:2] for key, value in batch.items()}
    network.eval()
    assert torch.allclose(network(batch)["points"][1], network(alone)["points"][0], atol=1e-5)


def test_one_batch_is_learnt(network: LocalDecoder) -> None:
    batch = make_batch(2, relief=0.6)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-2)
    values = []
    for _ in range(60):
        loss = losses.chamfer(network(batch)["points"], batch["reference"]).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        values.append(loss.item())
    assert min(values[-5:]) < 0.5 * values[0]


@pytest.mark.parametrize("kind", [EncoderStage, GanStage, FullStage])
@pytest.mark.filterwarnings("ignore:.*treespec, LeafSpec.*:FutureWarning")
@pytest.mark.filterwarnings("ignore:.*does not have many workers")
def test_every_stage_trains_it(kind: type, network: LocalDecoder) -> None:
    adam = partial(torch.optim.Adam, lr=1e-3)
    options: dict = {
        "discriminator_optimizer": adam,
        "emd_points": 64,
        "emd_batches": 1,
        "discriminator_noise": 0.03,
        "discriminator_patches": 1,
    }
    more = {EncoderStage: {"keypoints": 32, "pixels": 32}, GanStage: {**options, "freeze_encoder": True}}
    loss = {"chamfer": 20.0, "adversarial": 0.02, "correspondence": 1.0, "retrieval": 0.2, "correction": 1.0}
    stage = kind(
        network=network, loss=loss, optimizer=adam, epochs=1, clip_norm=5.0, seed=1,
        **more.get(kind, {**options, "pixels": 32}),
    )  # fmt: skip
    loader = DataLoader([make_batch(2)], batch_size=None)
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False, "accelerator": "cpu"}
    L.Trainer(**quiet, fast_dev_run=True).fit(stage, loader, loader)
    assert int(network.encoder.steps) + int(network.generator.steps) > 0


def test_a_number_that_is_no_square_is_refused() -> None:
    with pytest.raises(InputError, match="points=1024"):
        make_local_network(points=1000)
