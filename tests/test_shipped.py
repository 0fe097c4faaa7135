"""Networks that come with the package, and how a run becomes one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from overfly.errors import InputError
from overfly.run import load_run
from overfly.run_folder import checkpoint, read_weights
from overfly.shipped import DEFAULT, WEIGHTS, export, load_network, names
from terrain import SWEEP_SIZES, make_batch, make_sweep_network

TINY = {"_target_": "overfly.networks.SweepDecoder", **SWEEP_SIZES}


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """The folder of a run, as far as its network is concerned."""
    folder = tmp_path / "run"
    (folder / "checkpoints").mkdir(parents=True)
    network = make_sweep_network()
    network.generator.steps += 30
    state = {f"network.{key}": value for key, value in network.state_dict().items()}
    torch.save({"state_dict": state, "epoch": 1}, folder / "checkpoints" / "best.ckpt")
    config = {"model": TINY, "frames": 3, "image_size": [64, 32], "seed": 7, "stage_name": "full"}
    OmegaConf.save(config, folder / "config.yaml")
    (folder / "overrides.txt").write_text("experiment=tiny\nhydra.run.dir=elsewhere\n")
    table = "stage,epoch,train/loss,val/loss,val/late\ngan,1,3,9.0,\nfull,0,2,4.0,\nfull,1,1,1.5,\nfull,2,0.5,2.5,7\n"
    (folder / "metrics.csv").write_text(table)
    return folder


def test_an_exported_network_answers_like_the_run(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    export(run, tmp_path / "weights", "tiny")
    monkeypatch.setattr("overfly.shipped.WEIGHTS", tmp_path / "weights")
    assert names() == ["tiny"]
    batch = make_batch(1, width=64, height=32)
    with torch.inference_mode():
        expected, found = (load_network(name).network(batch)["height"] for name in (str(run), "tiny"))
    assert torch.equal(expected, found)


def test_the_command_the_seed_and_the_scores_stand_beside_the_weights(run: Path, tmp_path: Path) -> None:
    _, described = export(run, tmp_path / "weights")
    facts = json.loads(described.read_text())
    assert facts["command"] == "python train.py experiment=tiny"
    assert facts["seed"] == 7
    assert facts["scores"] == {"val/loss": 1.5}  # of the best epoch, not of the last one
    assert facts["steps"]["generator"] == 30


def test_the_default_network_is_small_and_trained() -> None:
    assert (WEIGHTS / f"{DEFAULT}.safetensors").stat().st_size <= 10e6
    run = load_network()
    assert int(run.network.encoder.steps) > 0
    assert int(run.network.generator.steps) > 0
    with torch.inference_mode():
        answer = run.network(make_batch(1, width=128, height=96))
    assert torch.isfinite(answer["height"]).all()


def test_an_unknown_network_says_what_there_is(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"neither a shipped network \(.*\) nor a run folder"):
        load_network(str(tmp_path / "nowhere"))


def test_a_shipped_network_is_something_to_start_from() -> None:
    path = checkpoint(Path(DEFAULT))
    assert path == WEIGHTS / f"{DEFAULT}.safetensors"
    weights, network = read_weights(path), load_network().network
    assert set(weights) == {f"network.{key}" for key in network.state_dict()}
    assert torch.equal(weights["network.encoder.stem.0.weight"], network.state_dict()["encoder.stem.0.weight"])


def test_what_is_neither_a_run_nor_a_shipped_network_is_told() -> None:
    with pytest.raises(InputError, match=r"no run folder bass: .* a shipped network \(base\)"):
        checkpoint(Path("bass"))
    with pytest.raises(InputError, match="only the weights are here"):
        load_run(DEFAULT)
