"""The three stages: they learn, leave the other player alone, save, load, resume and repeat themselves."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import lightning as L
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from torch.utils.data import DataLoader

from overfly.errors import InputError
from overfly.stages import EncoderStage, FullStage, GanStage
from overfly.stages.stage import Stage
from terrain import make_batch, make_network

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*treespec, LeafSpec.*:FutureWarning"),  # Lightning's own
    pytest.mark.filterwarnings("ignore:.*does not have many workers"),
    pytest.mark.filterwarnings("ignore:.*have no `val_dataloader`"),
    pytest.mark.filterwarnings("ignore:Checkpoint directory .* exists and is not empty"),
]

LOSS = {"chamfer": 20.0, "emd": 0.1, "adversarial": 0.02, "correspondence": 1.0, "retrieval": 0.2, "correction": 1.0}


def make_stage(
    name: str, *, network: Any = None, loss: dict[str, float] | None = None, lr: float = 5e-3, **changes: Any
) -> Stage:
    common: dict[str, Any] = {
        "network": network or make_network(),
        "loss": loss or LOSS,
        "optimizer": partial(torch.optim.Adam, lr=lr),
        "epochs": 100,
        "clip_norm": 5.0,
        "seed": 3,
    }
    players = {"discriminator_optimizer": partial(torch.optim.Adam, lr=1e-3), "emd_points": 64, "emd_batches": 1}
    players |= {"discriminator_noise": 0.03, "discriminator_patches": 1}
    if name == "encoder":
        return EncoderStage(**common, pixels=32, keypoints=32, **changes)
    if name == "gan":
        return GanStage(**common, **players, **{"freeze_encoder": True, **changes})
    return FullStage(**common, **players, pixels=32, **changes)


def loader(*batches: dict[str, torch.Tensor]) -> DataLoader:
    return DataLoader(list(batches), batch_size=None)


def make_trainer(folder: Path | None = None, **flags: Any) -> L.Trainer:
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False, "accelerator": "cpu"}
    flags = {"max_epochs": 1, "deterministic": True, "num_sanity_val_steps": 0, **flags}
    if folder is None:
        return L.Trainer(**quiet, enable_checkpointing=False, **flags)
    keep = ModelCheckpoint(dirpath=folder, filename="best", monitor="val/loss", save_last=True, save_weights_only=False)
    return L.Trainer(**quiet, callbacks=[keep], **flags)


class Losses(L.Callback):
    def __init__(self) -> None:
        self.values: list[float] = []

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        minimised = trainer.callback_metrics.get("train/loss_generator", trainer.callback_metrics["train/loss"])
        self.values.append(float(minimised))


@pytest.mark.parametrize("name", ["encoder", "gan", "full"])
def test_the_loss_of_one_batch_falls_by_half_within_30_steps(name: str) -> None:
    batch = make_batch(3, relief=0.6)
    losses = Losses()

    trainer = make_trainer(max_epochs=30, callbacks=[losses], limit_val_batches=0)
    trainer.fit(make_stage(name, lr=1e-2), loader(batch))
    assert len(losses.values) == 30
    assert losses.values[-1] < losses.values[0] / 2


@pytest.mark.parametrize("name", ["encoder", "gan", "full"])
def test_fast_dev_run_and_test_log_what_the_tables_need(name: str) -> None:
    stage, batch = make_stage(name), make_batch(2, points=256)
    trainer = make_trainer(fast_dev_run=True)
    trainer.fit(stage, loader(batch), loader(batch))
    wanted = {"loss", "accuracy"}
    if name == "encoder":
        wanted |= {"retrieval_top1", "prior_position_m", "corrected_position_m"}
    else:
        wanted |= {"chamfer_m2", "chamfer_sum_1024", "height_error_m", "discriminator_accuracy", "emd_sum_1024"}
    logged = set(trainer.callback_metrics)
    assert {f"val/{key}" for key in wanted} <= logged
    assert {f"train/{key}" for key in wanted - {"emd_sum_1024", "retrieval_top1"} if "position" not in key} <= logged
    results = make_trainer().test(stage, [loader(batch), loader(batch)], verbose=False)
    keys = {key for result in results for key in result}
    assert {f"{split}/{key}" for split in ("test", "unseen") for key in wanted - {"emd_sum_1024"}} <= keys
    assert not any("dataloader_idx" in key for key in keys)


def snapshot(stage: Stage, part: str) -> dict[str, torch.Tensor]:
    return {name: value.detach().clone() for name, value in stage.part(part).named_parameters()}


class Watch(L.Callback):
    """Which parts' weights each optimiser step of a GAN stage changes."""

    def __init__(self) -> None:
        self.changes: list[set[str]] = []

    def on_fit_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        assert isinstance(pl_module, Stage)
        stage, original = pl_module, pl_module.optimise

        def watched(*args: Any, **kwargs: Any) -> None:
            before = {part: snapshot(stage, part) for part in ("encoder", "generator", "discriminator")}
            original(*args, **kwargs)
            after = {part: snapshot(stage, part) for part in before}
            self.changes.append(
                {p for p, values in before.items() if any(not torch.equal(v, after[p][k]) for k, v in values.items())}
            )

        stage.optimise = watched  # type: ignore[method-assign]


def test_one_players_weights_stay_while_the_other_steps() -> None:
    watch = Watch()
    stage = make_stage("gan")
    stage.part("encoder").steps += 1  # trained, hence frozen
    make_trainer(max_epochs=2, limit_val_batches=0, callbacks=[watch]).fit(stage, loader(make_batch(2)))
    assert watch.changes == [{"discriminator"}, {"generator"}] * 2
    assert int(stage.part("generator").steps) == int(stage.part("discriminator").steps) == 2


def test_a_frozen_encoder_keeps_its_batch_statistics_too() -> None:
    stage = make_stage("gan")
    stage.part("encoder").steps += 1
    before = {key: value.clone() for key, value in stage.part("encoder").state_dict().items()}
    make_trainer(limit_val_batches=0).fit(stage, loader(make_batch(2)))
    assert all(torch.equal(before[key], value) for key, value in stage.part("encoder").state_dict().items())


def test_an_untrained_encoder_is_never_frozen() -> None:
    watch = Watch()
    make_trainer(limit_val_batches=0, callbacks=[watch]).fit(make_stage("gan"), loader(make_batch(2)))
    assert watch.changes == [{"discriminator"}, {"encoder", "generator"}]


def test_the_full_stage_moves_encoder_and_generator_together() -> None:
    watch = Watch()
    make_trainer(limit_val_batches=0, callbacks=[watch]).fit(make_stage("full"), loader(make_batch(2)))
    assert watch.changes == [{"discriminator"}, {"encoder", "generator"}]


def test_without_an_adversarial_term_no_discriminator_is_trained() -> None:
    stage = make_stage("gan", loss={"chamfer": 1.0})
    before = snapshot(stage, "discriminator")
    trainer = make_trainer(limit_val_batches=0)
    trainer.fit(stage, loader(make_batch(2)))
    assert all(torch.equal(value, before[key]) for key, value in snapshot(stage, "discriminator").items())
    assert "train/discriminator_accuracy" not in trainer.callback_metrics


@pytest.mark.parametrize("name", ["encoder", "gan", "full"])
def test_a_checkpoint_is_saved_and_gives_equal_outputs(name: str, tmp_path: Path) -> None:
    stage, batch = make_stage(name), make_batch(2)
    make_trainer(tmp_path).fit(stage, loader(batch), loader(batch))
    saved = torch.load(tmp_path / "best.ckpt", weights_only=True)  # nothing is unpickled
    again = make_stage(name, network=make_network(generator={"width": 8}))
    again.load_state_dict(saved["state_dict"])
    stage.eval(), again.eval()
    assert torch.equal(stage(batch)["points"], again(batch)["points"])
    assert torch.equal(stage(batch)["match_map"], again(batch)["match_map"])


def test_resuming_gives_the_same_weights_as_training_through(tmp_path: Path) -> None:
    batches = [make_batch(2, seed=s) for s in range(2)]
    through = make_stage("full")
    make_trainer(max_epochs=2).fit(through, loader(*batches), loader(batches[0]))
    first = make_stage("full")
    make_trainer(tmp_path).fit(first, loader(*batches), loader(batches[0]))
    resumed = make_stage("full")
    trainer = make_trainer(tmp_path, max_epochs=2)
    trainer.fit(resumed, loader(*batches), loader(batches[0]), ckpt_path=tmp_path / "last.ckpt", weights_only=True)
    for (key, a), b in zip(through.state_dict().items(), resumed.state_dict().values(), strict=True):
        assert torch.equal(a, b), key


@pytest.mark.parametrize("name", ["encoder", "gan"])
def test_the_same_seed_gives_bit_equal_metrics_whatever_was_drawn_before(name: str) -> None:
    batches, found = [make_batch(2, seed=s) for s in range(2)], []
    for disturbance in (1, 2):
        torch.manual_seed(disturbance)
        trainer = make_trainer()
        trainer.fit(make_stage(name), loader(*batches), loader(batches[1]))
        found.append({key: float(value) for key, value in trainer.callback_metrics.items()})
    assert found[0] == found[1]


def test_wrong_losses_are_refused() -> None:
    with pytest.raises(InputError, match="did you mean 'chamfer'"):
        make_stage("gan", loss={"chamfr": 1.0})
    with pytest.raises(InputError, match="nothing to minimise"):
        make_stage("encoder", loss={"chamfer": 1.0})


def test_the_encoder_needs_two_frames() -> None:
    with pytest.raises(InputError, match="frames=3"):
        make_trainer().fit(make_stage("encoder"), loader(make_batch(1, frames=1)))
