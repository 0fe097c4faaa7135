"""Experiments: from a configuration to a run folder. With :mod:`overfly.configuration` the only place that knows Hydra.

A run folder is movable and holds ``config.yaml``, ``overrides.txt``, ``train.log``, ``metrics.csv``, ``metrics.json``,
``checkpoints/best.ckpt``, ``curves.png`` and ``clouds/``. A run of ``stage=all`` holds one such folder for each phase
and, at its top, the results of the last one.
"""

from __future__ import annotations

import json
import logging
import math
import os
import sys
import warnings
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from omegaconf import DictConfig, OmegaConf

from overfly.configuration import build, check, conf_dir, explain, register_resolvers, save
from overfly.errors import InputError
from overfly.run_folder import as_it_was, checkpoint, collect, read_weights, resumed, same_stage, write_json

if TYPE_CHECKING:
    import torch

log = logging.getLogger("overfly")


def train(cfg: DictConfig) -> float | None:
    """Train what ``stage`` says and return the best value of the monitored metric (None if none was measured)."""
    check(cfg)
    _check_processes(cfg)
    run_dir = Path(cfg.run_dir)
    if cfg.resume:
        same_stage(run_dir, cfg.stage_name)
    with as_it_was(run_dir) if cfg.resume and _leads() else nullcontext():
        _open_folder(cfg, run_dir)
        log.info("The run folder is %s", run_dir)
        if cfg.stage_name == "evaluate":
            from overfly.evaluate import evaluate_run

            _quieten()
            return evaluate_run(cfg, run_dir)
        return _train_stage(cfg) if cfg.stage_name != "all" else _train_phases(cfg, run_dir)


def _train_phases(cfg: DictConfig, run_dir: Path) -> float | None:
    """The phases one after the other, each from the weights of the one before it."""
    value, before, changed = None, cfg.from_run, ""
    for name, phase in cfg.phases.items():
        part = OmegaConf.merge(cfg, phase, {"run_dir": str(run_dir / name), "from_run": before})
        assert isinstance(part, DictConfig)
        done = run_dir / name / "metrics.json"
        goes_on = cfg.resume and done.is_file() and _goes_on(run_dir / name, part)
        if goes_on:
            done.unlink()  # it is not finished any more, should this be stopped
        if cfg.resume and done.is_file():
            if changed:
                log.warning("%s: kept as it was, though %s was trained on: give it more epochs, too", name, changed)
            log.info("%s: finished before, its results in %s are kept", name, done.parent)
            value = json.loads(done.read_text()).get("monitored")
        else:
            _open_folder(part, Path(part.run_dir))
            value = _train_stage(part)
            changed = name
        before = part.run_dir
        if _leads():
            collect(run_dir, list(cfg.phases))
    return value


def _goes_on(folder: Path, part: DictConfig) -> bool:
    """Whether a finished phase is asked for more epochs than it was made with."""
    made = OmegaConf.load(folder / "config.yaml")
    assert isinstance(made, DictConfig)
    return bool(part.trainer.max_epochs > made.trainer.max_epochs)


def _open_folder(cfg: DictConfig, run_dir: Path) -> None:
    """Make a run folder and write its configuration; of several processes only the first writes and speaks."""
    if _leads():
        run_dir.mkdir(parents=True, exist_ok=True)
        save(cfg, run_dir)
    else:
        log.setLevel(logging.WARNING)


def _leads() -> bool:
    """Whether this is the first process of a training, which it is without ``trainer=ddp``."""
    from lightning.pytorch.utilities import rank_zero_only

    return not getattr(rank_zero_only, "rank", 0)


def _check_processes(cfg: DictConfig) -> None:
    """Each process of ``trainer=ddp`` is started by the whole command, which in a sweep stands for many jobs."""
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode

    sweep = HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN
    if sweep and "ddp" in str(cfg.trainer.strategy):
        raise InputError(
            "A sweep and trainer=ddp do not go together: give every job of the sweep a command of its own, or one "
            "process each, side by side: hydra/launcher=joblib hydra.launcher.n_jobs=2."
        )


def _train_stage(cfg: DictConfig) -> float | None:
    import lightning as L

    from overfly.callbacks import finish_loggers

    _quieten()
    run_dir = Path(cfg.run_dir)
    # The learning rate falls over the epochs that are trained, whoever set their number.
    cfg = OmegaConf.merge(cfg, {"stage": {"epochs": cfg.trainer.max_epochs}})  # type: ignore[assignment]
    L.seed_everything(cfg.seed, workers=True, verbose=False)
    stage = build(cfg.stage)
    for line in warm_start(stage, cfg.stage_name, cfg.from_run, tried=bool(cfg.trainer.fast_dev_run)):
        log.info(line)
    loggers = list(build(cfg.logger).values())
    try:
        data = build(cfg.data)
        callbacks = [part for name, part in cfg.callbacks.items() if name != "progress" or _shows_progress(cfg)]
        trainer = build(OmegaConf.merge(cfg.trainer, {"callbacks": callbacks}))
        trainer.loggers = [] if trainer.fast_dev_run else loggers
        last = run_dir / "checkpoints" / "last.ckpt"
        if cfg.resume and last.is_file():
            log.info("%s: goes on from %s", cfg.stage_name, last)
        resume_from = str(last) if cfg.resume and last.is_file() else None
        try:
            trainer.fit(stage, datamodule=data, ckpt_path=resume_from, weights_only=True)
        except RuntimeError as error:
            if resume_from is None or "state_dict" not in str(error):
                raise
            raise InputError(
                f"{last} holds the weights of another network than {cfg.model._target_} as it is asked for now: resume "
                "without other overrides for model, or start a new run."
            ) from error
        except SystemExit as stop:  # so Lightning answers Ctrl+C
            if trainer.interrupted:
                raise KeyboardInterrupt from stop
            raise
        metrics = {key: float(value) for key, value in trainer.callback_metrics.items()}
        done = run_dir / "metrics.json"
        if resume_from and not metrics and done.is_file():
            log.info("%s: finished before, its results in %s are kept", cfg.stage_name, run_dir)
            kept: float | None = json.loads(done.read_text()).get("monitored")
            return kept
        if resume_from and not metrics:  # it was killed between its last epoch and this
            metrics = _merged(trainer.validate(stage, datamodule=data, verbose=False))
        best, monitored = _best(trainer, cfg.monitor, metrics)
        if getattr(stage, "delivers_last", False):
            monitored = metrics.get(cfg.monitor, monitored)
        if cfg.test and data.has_test:
            results = trainer.test(stage, datamodule=data, ckpt_path=best, verbose=False, weights_only=True)
            metrics |= _merged(results)
        if trainer.is_global_zero:
            write_json(
                run_dir / "metrics.json",
                {
                    "stage": cfg.stage_name,
                    "monitor": cfg.monitor,
                    "monitored": monitored,
                    "epochs": trainer.current_epoch,
                    "metrics": metrics,
                },
            )
        shown = "was not measured" if monitored is None else f"is {monitored:.5g}"
        which = "last" if getattr(stage, "delivers_last", False) else "best"
        log.info("%s: the %s %s %s", cfg.stage_name, which, cfg.monitor, shown)
        return monitored
    finally:
        finish_loggers(loggers)


def _shows_progress(cfg: DictConfig) -> bool:
    """Whether there is a progress bar: Lightning refuses one that is configured and switched off."""
    return bool(cfg.trainer.enable_progress_bar)


def _merged(results: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Lightning's test results, one dict a loader; the stages name the splits: ``test/...`` and ``unseen/...``."""
    return {key.split("/dataloader_idx_")[0]: float(value) for result in results for key, value in result.items()}


def _quieten() -> None:
    """Leave out what Lightning says on every run; our own lines say what matters."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    for message in (
        r".*isinstance\(treespec, LeafSpec\).*",  # Lightning's own use of torch
        r".*does not have many workers.*",  # small data: loading is not what training waits for
        r"Checkpoint directory .* exists and is not empty.*",  # a resumed run goes on in its own folder
        r".*module\(s\) in eval mode at the start of training.*",  # the frozen encoder
    ):
        warnings.filterwarnings("ignore", message)


def _best(trainer: Any, monitor: str, metrics: dict[str, float]) -> tuple[str | None, float | None]:
    """The best checkpoint (None under fast_dev_run: the weights in memory) and its monitored value."""
    callback = trainer.checkpoint_callback
    scored = callback is not None and callback.best_model_path and callback.best_model_score is not None
    if trainer.fast_dev_run or not scored:
        value = metrics.get(monitor)
        return None, value if value is not None and math.isfinite(value) else None
    return callback.best_model_path, float(callback.best_model_score)


def warm_start(stage: Any, name: str, from_run: str | None, *, tried: bool = False) -> list[str]:
    """Start ``stage`` from another run's weights; one line for every part says where its weights came from.

    Raises:
        InputError: ``from_run`` holds no weights; if all is only ``tried`` (fast_dev_run, which saves none) it may be a
            run without.
    """
    if name == "ssgan3d":
        start = ["ssgan3d: the mesh starts as the rough one, the critic at random (seeded)"]
        return start if from_run is None else cast(list[str], stage.warm_start({}, from_run))
    if from_run is None:
        more = "" if name == "encoder" else f"; from_run=outputs/encoder/... starts {name} from a trained encoder"
        return [f"{name}: every weight starts at random (seeded){more}"]
    path = checkpoint(Path(from_run))
    if path is None and (name == "encoder" or not tried or not (Path(from_run) / "config.yaml").is_file()):
        raise InputError(
            f"from_run={from_run} holds no checkpoints/best.ckpt and no exported weights: give the folder of a "
            "finished run, or what overfly export wrote."
        )
    if path is None:
        return [f"{name}: {from_run} saved no checkpoint, so every weight starts at random (seeded)"]
    lines: list[str] = stage.warm_start(read_weights(path), str(path))
    return lines


@dataclass(frozen=True)
class Run:
    """A finished run: its network with the best weights in evaluation mode, and its resolved configuration."""

    folder: Path
    network: torch.nn.Module
    config: dict[str, Any]
    stage: str


def load_run(folder: Path | str) -> Run:
    """Open a run folder, wherever it was moved to.

    Raises:
        InputError: the folder is missing or holds no trained weights.
    """
    path = checkpoint(Path(folder))
    if path is None:
        raise InputError(
            f"{folder} holds no checkpoints/best.ckpt: train first (python train.py), then give its run folder."
        )
    if path.suffix == ".safetensors":
        raise InputError(
            f"{folder} is a shipped network, of which only the weights are here: give a run folder. "
            f"stage=full from_run={folder} trains it further, stage=evaluate from_run={folder} evaluates it."
        )
    register_resolvers()
    root = path.parent.parent
    cfg = OmegaConf.load(root / "config.yaml")
    assert isinstance(cfg, DictConfig)
    network = build(cfg.model)
    prefix = "network."
    weights = {key[len(prefix) :]: value for key, value in read_weights(path).items() if key.startswith(prefix)}
    network.load_state_dict(weights)
    config = OmegaConf.to_container(cfg, resolve=False)
    assert isinstance(config, dict)
    return Run(folder=root, network=network.eval(), config={str(k): v for k, v in config.items()}, stage=cfg.stage_name)


def main(argv: Sequence[str] | None = None) -> int:
    """``python train.py [overrides]`` and ``overfly train [overrides]``; returns the exit code (0, 1 or 2)."""
    import hydra

    os.environ["HYDRA_FULL_ERROR"] = "1"  # errors come to us, and we say them in one sentence
    register_resolvers()
    started = list(sys.argv)

    def job(cfg: DictConfig) -> float | None:
        sys.argv = started  # the command by which Lightning starts the other processes of trainer=ddp
        return train(cfg)

    sys.path.append(os.getcwd())  # parts of one's own, by their _target_
    try:
        sys.argv = ["train.py", *resumed(sys.argv[1:] if argv is None else argv)]
        hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name="train")(job)()
    except KeyboardInterrupt:
        print(
            "Stopped. What is finished is kept; resume=<the run folder> goes on from the last epoch.", file=sys.stderr
        )
        return 130
    except Exception as error:
        sentence = explain(error)
        if sentence is None:
            raise
        print(f"Error: {sentence}", file=sys.stderr)
        return 2
    return 0
