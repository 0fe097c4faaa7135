"""``stage=evaluate``: trained networks beside classical methods and trivial answers, from a configuration."""

from __future__ import annotations

import json
import logging
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from overfly.configuration import build
from overfly.errors import InputError, unknown
from overfly.evaluation import Baselines, Network, evaluate
from overfly.evaluation.cameras import ESTIMATED, estimate_all
from overfly.evaluation.evaluate import KEPT
from overfly.networks.blocks import weights_key
from overfly.run import Run
from overfly.run_folder import write_json
from overfly.shipped import load_network

log = logging.getLogger("overfly")

CAMERAS = ("exact", "estimated")

TRAINING_WINDOWS = 240
"""Training windows, spread over all flights, among which the mean and the nearest one are looked for."""

QUESTION = "question.json"
"""What an evaluation measures and of which weights, so that a resumed one does not mix two."""

NO_MATTER = ("workers", "batch_size", "processes", "cache_dir")
"""Keys of the data and their source that change no number."""


def evaluate_run(cfg: DictConfig, run_dir: Path) -> float | None:
    """Evaluate ``from_run`` and ``networks`` on the test and unseen flights of a configuration.

    Args:
        cfg: with ``from_run``, ``networks`` (run folders or shipped networks by the name in the table),
            ``emd_windows``, ``every``, ``cameras`` and ``draws``.
        run_dir: gets evaluation.md, evaluation.csv and evaluation.png; with ``resume`` it goes on where it stopped.

    Returns:
        Chamfer distance of ``from_run`` over all windows, m².

    Raises:
        InputError: there is no network or nothing to evaluate on.
    """
    if cfg.cameras not in CAMERAS:
        raise unknown("cameras", cfg.cameras, CAMERAS)
    if cfg.from_run is None:
        raise InputError(
            "stage=evaluate needs a trained network: give from_run=outputs/all/<a run folder>, or from_run=base for "
            "the shipped one."
        )
    run = load_network(str(cfg.from_run))
    own = _name(run)
    others = {str(name): load_network(str(folder)) for name, folder in (cfg.networks or {}).items()}
    if own in others:
        raise InputError(
            f"networks calls one {own!r}, which is the name of from_run in the table: choose another name."
        )
    networks = {name: Network(r.network, _width(r)) for name, r in {own: run, **others}.items()}
    data = build(cfg.data)
    if not data.has_test:
        raise InputError(
            "There are no flights to evaluate on: set data.source.images.test or .unseen, or experiment=atlas."
        )
    for split in data.test_splits:
        data.datasets[split] = data.dataset(split)
        data.datasets[split].twice = True
        data.datasets[split].windows = data.datasets[split].windows[:: cfg.every]
    _same_question(cfg, networks, run_dir)
    if not cfg.resume:
        (run_dir / KEPT).unlink(missing_ok=True)
        shutil.rmtree(run_dir / ESTIMATED, ignore_errors=True)
    if cfg.cameras == "estimated":
        encoder = getattr(run.network, "encoder", None)
        dense = encoder if hasattr(encoder, "dense") else None
        estimate_all(data.datasets, run_dir / ESTIMATED, None if dense is None else lambda: dense)

    def baselines() -> Baselines:
        if "data" not in run.config:
            log.info("Of %s only the weights are here: no mean and no nearest training window", cfg.from_run)
            return Baselines(None, networks[own], cfg.points)
        log.info("Looking at the training windows of %s, for the mean and the nearest one", cfg.from_run)
        trained = _training_data(run, cfg.cache_dir)
        looked_at = trained.datasets["train"] = trained.dataset("train")
        looked_at.windows = looked_at.windows[:: -(-len(looked_at) // TRAINING_WINDOWS)]
        return Baselines(trained.loader("train"), networks[own], cfg.points)

    rows = evaluate(
        networks,
        baselines,
        {split: data.loader(split) for split in data.test_splits},
        run_dir,
        emd_windows=cfg.emd_windows,
        draws=cfg.draws,
        seed=cfg.seed,
    )
    log.info("The table is %s, the picture %s", run_dir / "evaluation.md", run_dir / "evaluation.png")
    return next(float(row["chamfer_m2"]) for row in rows if row["cloud"] == own)


def _same_question(cfg: DictConfig, networks: Mapping[str, Network], run_dir: Path) -> None:
    """Keep what is asked; refuse to go on with windows that were measured with other data, settings or weights."""
    data = OmegaConf.to_container(cfg.data, resolve=True)
    assert isinstance(data, dict)
    source = data.get("source")
    if isinstance(source, dict):
        data["source"] = {key: value for key, value in source.items() if key not in NO_MATTER}
    asked: dict[str, Any] = {str(key): value for key, value in data.items() if key not in NO_MATTER}
    asked |= {key: cfg[key] for key in ("every", "emd_windows", "points", "seed", "cameras")}
    asked |= {f"the weights of {name}": weights_key(network.network) for name, network in networks.items()}
    path = run_dir / QUESTION
    if cfg.resume and (run_dir / KEPT).is_file():
        before = json.loads(path.read_text()) if path.is_file() else {}
        if other := sorted(key for key in before.keys() | asked.keys() if before.get(key) != asked.get(key)):
            raise InputError(
                f"{run_dir} was measured with other values of {', '.join(other)}: resume it without other overrides, "
                "or evaluate into a new folder."
            )
    write_json(path, asked)


def _name(run: Run) -> str:
    """The kind of network in words: ``sweep decoder``."""
    kind = run.config["model"]["_target_"].rsplit(".", 1)[-1]
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", kind).lower()


def _width(run: Run) -> int:
    """Width of the images that a network was trained with last, pixels."""
    return int(run.config["image_size"][0]) // int(run.config.get("windows", {"shrink": 1})["shrink"])


def _training_data(run: Run, cache_dir: str) -> Any:
    trained = OmegaConf.create(run.config)
    if "source" in trained.data and "cache_dir" in trained.data.source:
        trained.data.source.cache_dir = cache_dir
    return build(trained.data)
