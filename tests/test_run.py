"""Whole runs through the real command: folders, resuming, warm start, sweeps, determinism."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from overfly.errors import InputError
from overfly.run import load_run, main
from overfly.shipped import export
from overfly.tables import read_rows

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*isinstance.treespec, LeafSpec:FutureWarning"),
    pytest.mark.filterwarnings("ignore:.*isinstance.treespec, LeafSpec:DeprecationWarning"),
    pytest.mark.filterwarnings("ignore:.*does not have many workers"),
    pytest.mark.filterwarnings("ignore:.*module.s. in eval mode at the start of training"),
]

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@dataclass
class Result:
    stdout: str
    stderr: str


@pytest.fixture
def train(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]):  # type: ignore[no-untyped-def]
    """Run train.py's entry in an empty folder (in this process: a new one takes seconds to import everything)."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setattr(sys, "argv", ["train.py"])

    def run(*overrides: str, code: int = 0) -> Result:
        capfd.readouterr()
        try:
            ended = main([*overrides, f"cache_dir={cache}", "trainer.accelerator=cpu"])
        except SystemExit as stop:
            ended = int(stop.code or 0)
        out, err = capfd.readouterr()
        assert ended == code, err[-3000:]
        return Result(out, err)

    return run


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory, cache: Path) -> Path:
    """A finished run of the three phases."""
    folder = tmp_path_factory.mktemp("all") / "run"
    overrides = ["experiment=smoke", f"cache_dir={cache}", f"hydra.run.dir={folder}", "trainer.accelerator=cpu"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    subprocess.run(
        [sys.executable, str(ROOT / "train.py"), *overrides], check=True, env=environment, timeout=300,
        capture_output=True, cwd=folder.parent,
    )  # fmt: skip
    return folder


def only(folder: Path, pattern: str) -> Path:
    found = list(folder.glob(pattern))
    assert len(found) == 1, found
    return found[0]


def test_a_run_of_all_phases_leaves_everything_that_the_readme_promises(finished: Path) -> None:
    for folder in (finished, finished / "encoder", finished / "gan", finished / "full"):
        for name in ("config.yaml", "overrides.txt", "metrics.csv", "metrics.json", "curves.png"):
            assert (folder / name).stat().st_size > 0, folder / name
        assert (folder / "checkpoints" / "best.ckpt").is_file()
    assert (finished / "train.log").stat().st_size > 0
    assert list((finished / "clouds").glob("*.ply"))
    assert list((finished / "clouds").glob("*.png"))
    results = json.loads((finished / "metrics.json").read_text())
    assert list(results["phases"]) == ["encoder", "gan", "full"]
    full = results["phases"]["full"]["metrics"]
    assert {"val/chamfer_m2", "val/accuracy", "val/emd_sum_1024"} <= set(full)
    assert any(key.startswith("test/chamfer_m2") for key in full)


def test_a_stopped_run_goes_on_from_its_last_epoch_better_or_not(train, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    train("experiment=smoke", "stage=encoder", "monitor_mode=max", "trainer.max_epochs=3", "hydra.run.dir=run")
    rows = [row["val/loss"] for row in read_rows(tmp_path / "run" / "metrics.csv") if "val/loss" in row]
    assert rows[-1] < max(rows)  # so the last epoch is not the best one by this measure
    epochs = {
        name: torch.load(tmp_path / "run" / "checkpoints" / f"{name}.ckpt", weights_only=True)["epoch"]
        for name in ("best", "last")
    }
    assert epochs["best"] < epochs["last"] == 2


def test_each_phase_says_where_its_weights_came_from(finished: Path) -> None:
    text = (finished / "train.log").read_text()
    assert "encoder: every weight starts at random" in text
    assert "encoder/checkpoints/best.ckpt" in text
    assert "gan/checkpoints/best.ckpt" in text


def test_the_weights_of_a_phase_are_those_that_the_last_one_left(finished: Path) -> None:
    before, after = (
        torch.load(finished / name / "checkpoints" / "best.ckpt", weights_only=True)["state_dict"]
        for name in ("encoder", "gan")
    )
    kept = [key for key in before if "encoder" in key and key.endswith("conv1.weight")] or [
        key for key in before if ".encoder." in key and before[key].ndim == 4
    ]
    assert kept
    for key in kept:  # the gan stage leaves the encoder frozen
        torch.testing.assert_close(before[key], after[key], rtol=0, atol=0)


def test_a_moved_run_is_reopened_with_equal_outputs(finished: Path, tmp_path: Path) -> None:
    moved = tmp_path / "elsewhere"
    shutil.copytree(finished, moved)
    one, two = load_run(finished), load_run(moved)
    assert one.stage == two.stage == "full"
    assert not two.network.training
    for a, b in zip(one.network.state_dict().values(), two.network.state_dict().values(), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)
    assert str(finished) not in (moved / "config.yaml").read_text()


def test_a_folder_without_weights_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"best\.ckpt"):
        load_run(tmp_path)
    with pytest.raises(InputError, match="no run folder"):
        load_run(tmp_path / "nowhere")


def test_fast_dev_run_passes_through_every_phase(train, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    train("experiment=smoke", "trainer.fast_dev_run=true")
    run = only(tmp_path, "outputs/all/*")
    assert json.loads((run / "full" / "metrics.json").read_text())["stage"] == "full"


def test_from_run_starts_from_the_given_weights_and_says_so(train, finished: Path, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    train("experiment=smoke", "stage=gan", "trainer.max_epochs=1", f"from_run={finished / 'encoder'}")
    run = only(tmp_path, "outputs/gan/*")
    assert "encoder/checkpoints/best.ckpt" in (run / "train.log").read_text()


def test_a_stopped_run_goes_on_counting_in_its_own_folder(train, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    train("experiment=smoke", "stage=encoder", "trainer.max_epochs=2", "test=false")
    run = only(tmp_path, "outputs/encoder/*")
    first = read_rows(run / "metrics.csv")
    train(f"resume={run.relative_to(tmp_path)}", "trainer.max_epochs=4")
    rows = read_rows(run / "metrics.csv")
    assert [row["epoch"] for row in rows] == [0, 1, 2, 3]
    assert rows[:2] == first
    assert only(tmp_path, "outputs/encoder/*") == run


def test_resuming_a_finished_run_of_all_phases_computes_nothing_again(train, finished: Path) -> None:  # type: ignore[no-untyped-def]
    times = {path: path.stat().st_mtime_ns for path in finished.glob("*/checkpoints/best.ckpt")}
    result = train(f"resume={finished}")
    assert "finished before" in result.stdout + result.stderr + (finished / "train.log").read_text()
    assert times == {path: path.stat().st_mtime_ns for path in finished.glob("*/checkpoints/best.ckpt")}


def test_a_finished_run_of_all_phases_is_trained_on_with_more_epochs(train, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    run, phases = tmp_path / "run", ("encoder", "gan", "full")
    train("experiment=smoke", "trainer.max_epochs=1", "test=false", f"hydra.run.dir={run}")
    before = {phase: read_rows(run / phase / "metrics.csv") for phase in phases}
    train(f"resume={run}", "trainer.max_epochs=2")
    for phase in phases:
        now = read_rows(run / phase / "metrics.csv")
        assert now[:1] == before[phase]
        assert [row["epoch"] for row in now] == [0, 1]


def test_going_on_with_another_stage_or_in_a_phase_touches_nothing(train, finished: Path, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    kinds = ("*.yaml", "*.txt", "*.json", "*.ckpt")
    before = {path: path.read_bytes() for kind in kinds for path in run.rglob(kind)}
    phase = train(f"resume={run / 'full'}", "trainer.max_epochs=3", code=2)
    assert f"is a phase of a run of stage=all: give resume={run}" in phase.stderr
    other = train(f"resume={run}", "stage=gan", code=2)
    assert "is a run of stage=all, not of stage=gan: leave stage out" in other.stderr
    wrong = train(f"resume={run}", "trainer.max_epochs=4", "data.source.camera=mavic9", code=2)
    assert "mavic9" in wrong.stderr
    network = train(f"resume={run}", "trainer.max_epochs=4", "model=local_decoder", code=2)
    assert "holds the weights of another network" in network.stderr
    for path, content in before.items():
        assert path.read_bytes() == content, path
    train(f"resume={run}")


def test_weights_that_are_asked_for_and_not_there_are_missed(train, finished: Path, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "empty").mkdir()
    for stage in ("gan", "full"):
        result = train("experiment=smoke", f"stage={stage}", "from_run=empty", code=2)
        assert "from_run=empty holds no checkpoints/best.ckpt and no exported weights" in result.stderr
    export(finished, tmp_path / "exported", "mine")
    result = train("experiment=smoke", "stage=gan", "from_run=exported", "trainer.fast_dev_run=true")
    assert "from exported/mine.safetensors" in result.stdout + result.stderr


def test_parts_of_ones_own_are_found_in_the_working_folder(train, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    """As the example of docs/networks.md."""
    text = (ROOT / "docs" / "networks.md").read_text()
    (code,) = re.findall(r"```python\n# mine.py\n(.*?)```", text, re.DOTALL)
    (tmp_path / "mine.py").write_text(code)
    (command,) = re.findall(r"python train.py (stage=gan stage._target_=mine.*)\n", text)
    train("experiment=smoke", *command.split(), "trainer.max_epochs=1", "hydra.run.dir=run")
    assert read_rows(tmp_path / "run" / "metrics.csv")[0]["train/loss_smooth"] > 0


def test_an_evaluation_is_one_table_and_one_picture_and_goes_on_where_it_was_stopped(  # type: ignore[no-untyped-def]
    train, finished: Path, tmp_path: Path
) -> None:
    small = ["experiment=smoke", "stage=evaluate", "emd_windows=1", "draws=10", "data.batch_size=3"]
    train(*small, f"from_run={finished}", f"networks={{encoder only: {finished / 'encoder'}}}")
    run = only(tmp_path, "outputs/evaluate/*")
    rows = list(csv.DictReader((run / "evaluation.csv").read_text().splitlines()))
    clouds = ["flat ground", "correlation sweep", "semi-global stereo", "floor: exact heights", "gan decoder"]
    assert {*clouds, "encoder only", "mean training cloud", "nearest training window"} < {row["cloud"] for row in rows}
    assert {row["styles"] for row in rows} == {"all", "seen", "unseen"}
    assert all(float(row["match_top1"]) >= 0 for row in rows if row["cloud"] == "encoder only")
    assert (run / "evaluation.png").stat().st_size > 0
    kept, table = (run / "windows.jsonl").read_text().splitlines(), (run / "evaluation.csv").read_text()
    assert len(kept) == 12
    (run / "windows.jsonl").write_text("\n".join(kept[:9]) + "\n" + kept[9][:40])  # as a kill leaves it
    result = train(f"resume={run.relative_to(tmp_path)}")
    assert "9 of 12 windows were measured before" in (run / "train.log").read_text() + result.stderr
    assert (run / "evaluation.csv").read_text() == table
    assert len([json.loads(line) for line in (run / "windows.jsonl").read_text().splitlines()]) == 12
    for change in ("seed=99", f"from_run={finished / 'encoder'}"):
        other = train(f"resume={run.relative_to(tmp_path)}", change, code=2)
        assert "was measured with other values of" in other.stderr
    refused = train(*small, f"from_run={finished}", f"networks={{gan decoder: {finished}}}", code=2)
    assert "choose another name" in refused.stderr


@pytest.mark.parametrize("stage", ["gan"])
def test_the_same_seed_gives_bit_equal_metrics_with_any_number_of_workers(train, tmp_path: Path, stage: str) -> None:  # type: ignore[no-untyped-def]
    for name, workers in (("zero", 0), ("two", 2), ("again", 0)):
        train("experiment=smoke", f"stage={stage}", f"data.workers={workers}", f"hydra.run.dir={tmp_path / name}")
    files = [(tmp_path / name / "metrics.csv").read_text() for name in ("zero", "two", "again")]
    assert files[0] == files[1] == files[2]
    train("experiment=smoke", f"stage={stage}", "seed=8", f"hydra.run.dir={tmp_path / 'other'}")
    assert (tmp_path / "other" / "metrics.csv").read_text() != files[0]


def test_a_sweep_goes_on_after_a_failed_job_and_hides_nothing(train, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    result = train(
        "-m", "experiment=smoke", "stage=encoder", "altitude=100,10,150", "trainer.fast_dev_run=true", code=1
    )
    sweep = only(tmp_path, "outputs/sweeps/*")
    rows = list(csv.DictReader((sweep / "summary.csv").read_text().splitlines()))
    assert [(row["altitude"], row["status"]) for row in rows] == [
        ("100", "completed"), ("10", "failed"), ("150", "completed"),
    ]  # fmt: skip
    assert "20 to 500" in rows[1]["error"]
    assert float(rows[0]["val/loss"]) > 0
    assert "altitude=10 is not possible" in result.stderr
    assert "Traceback" in (sweep / rows[1]["folder"] / "train.log").read_text()
    assert (sweep / "summary.md").is_file()
    assert (sweep / "summary.png").is_file()
    assert len({row["folder"] for row in rows}) == 3
    assert not any(character in row["folder"] for row in rows for character in ":=,")


def test_wandb_works_offline_and_is_closed(train, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    train("experiment=smoke", "stage=encoder", "logger=wandb", "trainer.max_epochs=1", "test=false")
    run = only(tmp_path, "outputs/encoder/*")
    assert list(run.glob("wandb/offline-run-*/*.wandb"))
    assert read_rows(run / "metrics.csv")


def test_tensorboard_writes_its_events(train, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    train("experiment=smoke", "stage=encoder", "logger=tensorboard", "trainer.max_epochs=1", "test=false")
    assert list(tmp_path.glob("outputs/encoder/*/tensorboard/events*"))
