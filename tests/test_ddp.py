"""Training by two processes: the same steps as by one, and one run folder."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from overfly.data import FlightDataModule
from overfly.errors import InputError
from overfly.run import load_run, main
from overfly.tables import read_rows

ROOT = Path(__file__).resolve().parents[1]
DDP = ("trainer=ddp", "trainer.devices=2")


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


def trained(cache: Path, folder: Path, *overrides: str) -> Path:
    """Train the smallest experiment by the real command, in an empty folder; returns the run folder."""
    folder.mkdir()
    given = [
        "experiment=smoke", f"cache_dir={cache}", "output_root=outputs", "trainer.accelerator=cpu", "test=false",
        "data.source.images.train=8", "data.source.images_per_flight=4", "data.source.images.val=4",
        "~callbacks.pictures",
        "+callbacks.witness._target_=witness.Witness", f"+callbacks.witness.folder={folder}",
    ]  # fmt: skip
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT / "tests")}
    done = subprocess.run(
        [sys.executable, str(ROOT / "train.py"), *given, *overrides], cwd=folder, env=environment, timeout=400,
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    assert "Warning" not in done.stderr
    runs = list(folder.glob("outputs/*/*"))
    assert len(runs) == 1, runs  # the second process made no folder of its own
    return runs[0]


def witnessed(run: Path, stage: str, processes: int) -> list[list[dict[str, Any]]]:
    """What the witness of each process wrote down, step by step."""
    folder = run.parents[2]
    return [json.loads((folder / f"{stage}_{rank}_of_{processes}.json").read_text()) for rank in range(processes)]


def check_steps(run: Path, stages: tuple[str, ...]) -> None:
    """After every step of every stage both processes have the same weights, to the last bit, of different windows."""
    for stage in stages:
        steps = list(zip(*witnessed(run, stage, 2), strict=True))
        assert len(steps) == 4
        for a, b in steps:
            assert a["weights"] == b["weights"]
            assert a["windows"] != b["windows"]


PHASES = ("stage=all", "~phases.full")


@pytest.fixture(scope="module")
def by_one(cache: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trained(cache, tmp_path_factory.mktemp("one") / "here", *PHASES)


@pytest.fixture(scope="module")
def by_two(cache: Path, by_one: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trained(cache, tmp_path_factory.mktemp("two") / "here", *PHASES, *DDP)


def test_each_step_is_that_of_all_processes_together(by_one: Path, by_two: Path) -> None:
    check_steps(by_two, ("EncoderStage", "GanStage"))
    for stage in ("EncoderStage", "GanStage"):
        together = [sorted(a["windows"] + b["windows"]) for a, b in zip(*witnessed(by_two, stage, 2), strict=True)]
        assert together == [step["windows"] for step in witnessed(by_one, stage, 1)[0]]
    first, last = witnessed(by_two, "GanStage", 2)[0][:: len(together) - 1]
    moved = {name for name in first["weights"] if first["weights"][name] != last["weights"][name]}
    assert moved == {"generator", "discriminator"}  # both players step, the frozen encoder does not


def test_the_loss_curve_is_that_of_one_process(by_one: Path, by_two: Path) -> None:
    near = {"train/loss": 0.1, "val/loss": 0.1, "val/chamfer_m2": 0.1, "val/emd_sum_1024": 0.1}
    for name in ("encoder", "gan"):
        one, two = (read_rows(run / name / "metrics.csv") for run in (by_one, by_two))
        assert [row["epoch"] for row in two] == [0, 1]
        for a, b in zip(one, two, strict=True):
            assert set(a) == set(b)
            for key in near.keys() & a.keys():
                assert b[key] == pytest.approx(a[key], rel=near[key]), key


def test_one_process_writes_and_its_folder_is_a_run_like_any_other(by_one: Path, by_two: Path) -> None:
    files = [{p.relative_to(run) for p in run.rglob("*") if p.is_file()} for run in (by_one, by_two)]
    assert files[0] == files[1]
    assert (by_two / "train.log").read_text().count("epoch 1 of 2") == 2  # one line a phase
    assert load_run(by_two).stage == "gan"


@pytest.mark.slow
def test_the_sweep_decoder_with_parts_that_a_stage_does_not_use(cache: Path, tmp_path: Path) -> None:
    network = ("model=sweep_decoder", "loss=surface", "model.size=[64,64]")
    check_steps(trained(cache, tmp_path / "here", *DDP, *network), ("EncoderStage", "GanStage", "FullStage"))


def test_a_sweep_by_several_processes_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        main(["-m", "experiment=smoke", "altitude=100", f"cache_dir={tmp_path}", *DDP])
    assert "A sweep and trainer=ddp do not go together" in capfd.readouterr().err


def test_a_batch_that_does_not_split_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("is_initialized", True), ("get_rank", 0), ("get_world_size", 2)):
        monkeypatch.setattr(torch.distributed, name, lambda value=value: value)
    windows = {
        "frames": 3, "points": 1024, "choice": "overlap", "ground_sigma_m": 2.0, "position_sigma_m": 1.0,
        "rotation_sigma_deg": 1.0, "drop_share": 0.0, "light_sigma": 0.0, "colour_sigma": 0.0,
        "camera_sigma_px": 0.0, "shrink": 1,
    }  # fmt: skip
    data = FlightDataModule(source=None, windows=windows, batch_size=5, workers=0, seed=0)  # type: ignore[arg-type]
    data.datasets["train"] = [None] * 8  # type: ignore[assignment]
    with pytest.raises(InputError, match=r"data\.batch_size=4"):
        data.loader("train")
