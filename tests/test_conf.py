"""The tree of configurations holds together: proved before any network is trained."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.utils import get_class, get_method
from omegaconf import DictConfig, OmegaConf

from overfly.configuration import build, check, conf_dir, register_resolvers
from overfly.errors import InputError
from overfly.stages.ssgan3d import WEIGHTS as SSGAN3D_WEIGHTS

ROOT = Path(__file__).resolve().parents[1]
FILES = sorted(path.relative_to(conf_dir()).with_suffix("") for path in conf_dir().glob("*/*.yaml"))
OF_REFINEMENT = {"ssgan3d", "free_vertices", "mesh_generator"}


@pytest.fixture(autouse=True)
def _hydra() -> Iterator[None]:
    register_resolvers()
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        yield


def composed(*overrides: str, run_dir: str = "run") -> DictConfig:
    return compose("train", overrides=[f"run_dir={run_dir}", "cache_dir=cache", *overrides])


def targets(node: object) -> Iterator[str]:
    if isinstance(node, dict):
        if "_target_" in node:
            yield node["_target_"]
        for value in node.values():
            yield from targets(value)
    elif isinstance(node, list):
        for value in node:
            yield from targets(value)


def phase(cfg: DictConfig) -> DictConfig:
    """One stage's configuration: the whole one, or the last phase of stage=all."""
    if "phases" not in cfg:
        return cfg
    merged = OmegaConf.merge(cfg, cfg.phases.full)
    assert isinstance(merged, DictConfig)
    return merged


@pytest.mark.parametrize("file", FILES, ids=str)
def test_every_file_composes_resolves_and_names_real_classes(file: Path) -> None:
    group, name = file.parts
    cfg = composed(f"{group}={name}", *(["data.root=flight"] if name == "folder" else []))
    content = OmegaConf.to_container(phase(cfg), resolve=True)
    found = list(targets(content))
    assert found
    for target in found:
        try:
            get_class(target)
        except Exception:
            get_method(target)


@pytest.mark.parametrize("file", [f for f in FILES if f.parts[0] in ("stage", "model", "loss", "callbacks", "trainer")])
def test_every_stage_model_loss_and_callback_is_built(file: Path, tmp_path: Path) -> None:
    group, name = file.parts
    needs = ["stage=ssgan3d"] if group in ("model", "loss") and name in OF_REFINEMENT else []
    cfg = phase(composed(*needs, f"{group}={name}", "trainer.accelerator=cpu", run_dir=str(tmp_path)))
    if "_target_" in cfg.stage:
        build(cfg.stage)
    assert len(list(build(cfg.callbacks).values())) == len(cfg.callbacks)


@pytest.mark.parametrize("logger", ["none", "csv", "wandb", "tensorboard"])
def test_every_logger_is_built(logger: str, tmp_path: Path) -> None:
    cfg = composed(f"logger={logger}", run_dir=str(tmp_path))
    assert set(build(cfg.logger)) == set(cfg.logger)


@pytest.mark.parametrize("path", ["grid", "double_grid", "random", "circular"])
def test_data_is_built_for_every_flight_path(path: str) -> None:
    data = build(composed(f"flight_path={path}", "altitude=[100,150]", "overlap=[30,50]").data)
    cells = {(job.altitude, job.overlap) for job in data.source.jobs("train")}
    assert cells == {(100.0, 30.0), (100.0, 50.0), (150.0, 30.0), (150.0, 50.0)}
    assert {job.flight_path["name"] for job in data.source.jobs("train")} == {path}


def test_table_1_of_the_paper_is_exactly_reproduced() -> None:
    source = build(composed("experiment=paper_table1").data).source
    images: dict[tuple[float, float], int] = {}
    for split in ("train", "val"):
        jobs = source.jobs(split)
        assert sum(job.images for job in jobs) == {"train": 1500, "val": 500}[split]
        for job in jobs:
            cell = (job.altitude, job.overlap)
            images[cell] = images.get(cell, 0) + job.images
            assert job.flight_path == {"name": "circular"}
            assert job.image_size == (256, 192)
    assert images == {(100, 30): 300, (100, 50): 700, (150, 30): 300, (150, 50): 700}
    cfg = composed("experiment=paper_table1")
    assert cfg.data.batch_size == 20
    assert cfg.trainer.max_epochs == 50


def test_an_experiment_may_change_root_keys_and_the_command_line_has_the_last_word() -> None:
    assert composed("experiment=paper_table1").image_size == [256, 192]
    assert composed("experiment=paper_table1", "overlap=80").overlap == 80


def test_trainer_flags_that_people_use_need_no_plus() -> None:
    flags = "fast_dev_run=true max_epochs=3 limit_train_batches=2 precision=16-mixed devices=2 accelerator=cpu"
    flags += " strategy=ddp num_nodes=2 limit_val_batches=1 profiler=simple max_time=00:01:00:00 detect_anomaly=true"
    composed(*(f"trainer.{flag}" for flag in flags.split()))


@pytest.mark.parametrize(
    ("override", "allowed"),
    [
        ("overlap=120", "0 to 95"),
        ("altitude=-5", "20 to 500"),
        ("overlap=abc", "0 to 95"),
        ("overlap=[30,99]", "0 to 95"),
        ("side_overlap=-1", "0 to 95"),
        ("frames=0", "1 to 8"),
        ("altitude=true", "20 to 500"),
        ("image_size=[256]", "width and height"),
        ("image_size=[64,64,3]", "width and height"),
        ("+stge=gan", "Did you mean stage"),
    ],
)
def test_values_that_no_flight_can_have_are_refused(override: str, allowed: str) -> None:
    with pytest.raises(InputError, match=allowed):
        check(composed(override))


def test_unknown_style_is_named_with_the_nearest() -> None:
    from hydra.errors import InstantiationException

    with pytest.raises(InstantiationException) as error:
        build(composed("data.source.styles=[vilage]").data)
    assert isinstance(error.value.__cause__, InputError)
    assert "village" in str(error.value.__cause__)


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("overlap=120", "overlap=120 is not possible: give percent, a number from 0 to 95"),
        ("overlop=50", "There is no key 'overlop'. Did you mean overlap?"),
        ("data=folder", "data.root has no value: give data.root=VALUE"),
        ("stage=gam", "gan"),
        ("data.source.styles=[vilage]", "did you mean 'village'"),
        ("resume=nowhere", "resume=nowhere is not a run folder"),
        ("from_run=nowhere", "no run folder nowhere"),
        ("stage gan", "'stage' cannot be read: type KEY=VALUE"),
        ("experiment=paper_table1 altitude=100", "add data.source.cells=null"),
        ("model._target_=mine.Typo stage=gan", "_target_=mine.Typo was not found"),
        ("experiment=smoke stage=encoder monitor=val/chamfer trainer.accelerator=cpu", "Allowed: train/accuracy"),
    ],
)
def test_what_is_wrong_is_one_sentence_and_exit_code_2(override: str, says: str, tmp_path: Path) -> None:
    result = subprocess.run(
        [sys.executable, str(ROOT / "train.py"), *override.split(), f"output_root={tmp_path}", f"cache_dir={tmp_path}"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=False,
    )
    assert result.returncode == 2, result.stderr
    assert says in result.stderr
    assert "Traceback" not in result.stderr
    assert len([line for line in result.stderr.splitlines() if line.startswith("Error: ")]) == 1


def test_configurations_travel_with_the_installed_package() -> None:
    import tomllib

    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert wheel["force-include"] == {"conf": "overfly/conf"}


def test_the_sweep_of_the_refinements_weights_names_keys_that_exist() -> None:
    sweep = OmegaConf.load(conf_dir() / "sweep" / "ssgan3d_weights.yaml")
    names = list(sweep.hydra.sweeper.params)
    cfg = composed("sweep=ssgan3d_weights")
    for name in names:
        assert isinstance(OmegaConf.select(cfg, name), int | float), name
    assert {name.split(".")[1] for name in names if name.startswith("loss.")} <= set(SSGAN3D_WEIGHTS)
    assert set(cfg.loss) <= set(SSGAN3D_WEIGHTS)
    assert cfg.monitor == sweep.monitor == "val/chamfer_m"
    assert cfg.stage_name == "ssgan3d"


def test_the_papers_refinement_has_a_network_over_the_vertices_and_resnet_101_for_a_critic() -> None:
    from functools import partial

    from overfly.networks import Critic, MeshGenerator

    cfg = composed("experiment=ssgan3d")
    assert cfg.stage_name == "ssgan3d"
    assert cfg.data._target_ == "overfly.refinement.PhotographModule"
    assert cfg.data.synthetic.altitude == cfg.altitude
    assert cfg.model.critic.depth == 101
    small = composed("experiment=ssgan3d", "model.critic.width=2")  # the whole one takes seconds to build
    stage = build(small.stage)
    assert isinstance(stage.make_generator, partial)
    assert stage.make_generator.func is MeshGenerator
    assert isinstance(stage.critic, Critic)
    assert sum(type(module).__name__ == "Conv2d" for module in stage.critic.modules()) > 100
    assert composed("experiment=ssgan3d_small").model.generator._target_ == "overfly.networks.FreeVertices"
