"""What no run can mean: values that are not possible, parts that do not go together, overrides that nobody reads."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from overfly.errors import InputError

BOUNDS = {"altitude": (20, 500), "overlap": (0, 95), "side_overlap": (0, 95)}
UNITS = {"altitude": "metres above ground", "overlap": "percent", "side_overlap": "percent"}

WHOLE: dict[str, tuple[int, int | None, int]] = {
    "seed": (0, 2**32 - 1, 7),
    "points": (1, None, 1024),
    "stage.epochs": (1, None, 8),
    "trainer.max_epochs": (1, None, 8),
    "data.batch_size": (1, None, 8),
    "data.workers": (0, None, 2),
    "data.source.images_per_flight": (2, None, 20),
    "data.source.supersample": (1, None, 2),
    "data.source.processes": (1, None, 2),
    "every": (1, None, 1),
    "draws": (1, None, 1000),
    "emd_windows": (0, None, 48),
}
"""Whole numbers: the least, the largest and an example."""

FLIGHT = ("altitude", "overlap", "side_overlap", "flight_path")
WINDOW = ("frames", "points", "image_size", "windows")


def parts(cfg: DictConfig) -> Iterator[DictConfig]:
    """The configuration as every phase of ``stage=all`` has it, or the one that there is."""
    for phase in cfg.phases.values() if cfg.stage_name == "all" else [{}]:
        part = OmegaConf.merge(cfg, phase)
        assert isinstance(part, DictConfig)
        yield part


def check_values(cfg: DictConfig) -> None:
    """Refuse numbers that no flight and no training can have.

    Raises:
        InputError: a value is of the wrong kind or out of its bounds.
    """
    for key, (low, high) in BOUNDS.items():
        for value in cfg[key] if OmegaConf.is_list(cfg[key]) else [cfg[key]]:
            if not (value is None and key == "side_overlap") and not (_number(value) and low <= value <= high):
                raise _refused(key, value, _flight_number(key))
        if OmegaConf.is_list(cfg[key]) and not cfg[key]:
            raise _refused(key, cfg[key], _flight_number(key))
    size = OmegaConf.to_container(cfg.image_size) if OmegaConf.is_list(cfg.image_size) else cfg.image_size
    if not (isinstance(size, list) and len(size) == 2 and all(type(x) is int and x > 0 for x in size)):
        raise _refused("image_size", size, "width and height in pixels, image_size=[128,96]")
    if type(cfg.frames) is not int or not 1 <= cfg.frames <= 8:
        raise InputError(f"frames={cfg.frames} is not possible: a window has 1 to 8 frames, for instance frames=3.")
    for part in parts(cfg):
        _check_part(part)


def _flight_number(key: str) -> str:
    low, high = BOUNDS[key]
    return f"{UNITS[key]}, a number from {low} to {high} (or a list of them), for instance {key}={(low + high) // 2}"


def _check_part(cfg: DictConfig) -> None:
    trained = cfg.stage_name != "evaluate"
    for key, (least, most, example) in WHOLE.items():
        value = OmegaConf.select(cfg, key, default=example)
        if not trained and key.endswith("epochs"):
            continue
        if type(value) is not int or value < least or (most is not None and value > most):
            allowed = f"{least} or more" if most is None else f"from {least} to {most}"
            raise _refused(key, value, f"a whole number, {allowed}, for instance {key}={example}")
    for name, weight in cfg.loss.items():
        if weight is not None and not (_number(weight) and 0 <= weight < math.inf):
            raise _refused(f"loss.{name}", weight, f"a number, 0 or more, for instance loss.{name}=1.0")
    for name in ("limit_train_batches", "limit_val_batches") if trained else ():
        if (share := cfg.trainer[name]) is not None and not (_number(share) and share > 0):
            raise _refused(f"trainer.{name}", share, f"a number of batches, trainer.{name}=10, or a share up to 1.0")
    own = not trained or not str(cfg.stage.get("_target_")).startswith("overfly.")  # which may measure what it likes
    if not own and not str(cfg.monitor).startswith(("train/", "val/")):
        raise _refused("monitor", cfg.monitor, "a metric of the validation or the training, such as monitor=val/loss")
    for key, rate in _rates(cfg.stage, "stage"):
        if not (_number(rate) and 0 < rate < math.inf):
            raise _refused(key, rate, f"a number above 0, for instance {key}=0.001")


def _rates(node: Any, name: str) -> Iterator[tuple[str, Any]]:
    """The learning rates in a stage, with their full keys."""
    if OmegaConf.is_dict(node):
        for key in node:
            if key == "lr":
                yield f"{name}.lr", node.lr
            elif "optimizer" in str(key):
                yield from _rates(node[key], f"{name}.{key}")


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _refused(key: str, value: Any, allowed: str) -> InputError:
    return InputError(f"{key}={value} is not possible: give {allowed}.")


def check_together(cfg: DictConfig, conf: Path) -> None:
    """Refuse a model or data of another stage, and keys of other data than are chosen.

    Raises:
        InputError: they do not go together.
    """
    refines = cfg.stage_name == "ssgan3d"
    if cfg.stage_name != "evaluate" and ("_target_" in cfg.model) == refines:
        files = {path.stem: "_target_" in OmegaConf.load(path) for path in sorted((conf / "model").glob("*.yaml"))}
        names = [name for name, network in files.items() if network != refines]
        made_for = "other stages" if refines else "stage=ssgan3d"
        raise InputError(
            f"stage={cfg.stage_name} cannot train the chosen model, which is made for {made_for}: choose "
            f"model={' or model='.join(names)}."
        )
    if ("synthetic" in cfg.data) != refines and ("synthetic" in cfg.data or "windows" in cfg.data):
        wants = "photographs" if refines else "synthetic or data=folder"
        raise InputError(f"stage={cfg.stage_name} learns from data={wants}: choose that, or leave data out.")
    for path in (conf / "data").glob("*.yaml"):
        known = OmegaConf.load(path)
        assert isinstance(known, DictConfig)
        if known._target_ == cfg.data._target_ and _source(known) == _source(cfg.data):
            foreign = [key for key in cfg.data if key not in list(known)]  # those without a value, too
            foreign += [f"source.{key}" for key in cfg.data.get("source", {}) if key not in known.source]
            if foreign:
                raise InputError(
                    f"data={path.stem} has no key data.{foreign[0]}: leave that out, or the experiment that sets it."
                )


def _source(data: DictConfig) -> str | None:
    return None if "source" not in data else data.source.get("_target_")


def check_overrides(cfg: DictConfig, typed: Iterable[str], conf: Path) -> None:
    """Refuse what was typed and would be ignored, because the configuration has something that goes before it.

    Args:
        cfg: the composed configuration.
        typed: overrides as they were typed, ``key=value``.
        conf: the folder of configurations.

    Raises:
        InputError: an override changes nothing.
    """
    given = dict(item.lstrip("+").partition("=")[::2] for item in typed if not item.startswith("~"))
    for key, reason, instead in _unread(cfg):
        for name, value in given.items():
            if name == key or name.startswith(f"{key}."):
                raise InputError(f"{name}={value} would be ignored, since {reason}: {instead}, or leave {name} out.")
    for name, value in given.items():
        if not (conf / name).is_dir():  # files of a group are merged with what a phase says
            _check_phases(cfg, name, value, given)
            _check_epochs(cfg, name, value, given)


def _unread(cfg: DictConfig) -> Iterator[tuple[str, str, str]]:
    """Keys that nobody reads, why, and what to type."""
    data = cfg.data
    source: Any = data.get("source") or {}
    if OmegaConf.is_list(source.get("cells")):
        cells, nulled = "data.source.cells says what is flown", "add data.source.cells=null"
        own_paths = all("flight_path" in cell for cell in source.cells if OmegaConf.is_dict(cell))
        for key in ("altitude", "overlap", *(["flight_path"] if own_paths else [])):
            yield key, cells, nulled
            yield f"data.source.{key}", cells, nulled
        if own_paths or len(source.get("flight_paths") or []) > 1:
            yield "data.source.flight_paths", cells, nulled
    if source.get("flight_paths"):
        for key in ("flight_path", "data.source.flight_path"):
            paths = ", ".join(map(str, source.flight_paths))
            yield key, f"data.source.flight_paths=[{paths}] takes its place", "add data.source.flight_paths=null"
    if "root" in list(data):  # without a value, too
        for key in FLIGHT:
            yield key, "data=folder takes flights as they were flown", "choose data=synthetic"
    if "synthetic" in data:
        for key in (*FLIGHT, "data.synthetic") if data.flight is not None else ():
            yield key, "the flight of data.flight is taken as it was flown", "add data.flight=null"
        for key in WINDOW:
            yield key, "photographs are refined on whole, without windows", "change data.width or data.synthetic"
    if cfg.stage_name == "evaluate":
        for key in ("model", "loss"):
            yield key, "stage=evaluate measures the networks of from_run and networks", "give another from_run"
    if cfg.stage_name != "all":
        yield "phases", f"stage={cfg.stage_name} has no phases", "type it without phases and the phase's name"


def _check_phases(cfg: DictConfig, name: str, value: str, given: dict[str, str]) -> None:
    """What a phase says goes before what is said for all; where both were typed, that is as it should be."""
    if cfg.stage_name != "all":
        return
    missing = object()
    asked, fixed = OmegaConf.select(cfg, name), []
    for phase, node in cfg.phases.items():
        own = OmegaConf.select(node, name, default=missing)
        goes_before = (own is not missing and own != asked) or name.startswith("stage.")
        if goes_before and f"phases.{phase}.{name}" not in given:
            fixed.append(f"phases.{phase}.{name}={value}")
    if fixed:
        all_phases = f", or trainer.max_epochs={value} for all" if name == "stage.epochs" else ""
        raise InputError(
            f"{name}={value} would be ignored, since phases of stage=all have a value of their own: type "
            f"{' '.join(fixed)}{all_phases}."
        )


def _check_epochs(cfg: DictConfig, name: str, value: str, given: dict[str, str]) -> None:
    """``trainer.max_epochs`` follows ``stage.epochs`` until an experiment gives it a number of its own."""
    if not name.endswith("stage.epochs") or "trainer.max_epochs" in given or cfg.stage_name == "evaluate":
        return
    for phase, part in zip(cfg.phases if cfg.stage_name == "all" else [None], parts(cfg), strict=True):
        here = "" if phase is None else f"phases.{phase}."
        if name == f"{here}stage.epochs" and part.trainer.max_epochs != part.stage.epochs:
            raise InputError(
                f"{name}={value} would be ignored, since trainer.max_epochs={part.trainer.max_epochs} goes before it: "
                f"type {'+' if here else ''}{here}trainer.max_epochs={value}."
            )
