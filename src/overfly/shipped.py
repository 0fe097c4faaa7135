"""The networks that come with the package: their weights as safetensors, how they were trained, what they score.

They lie in ``overfly/weights`` as ``NAME.safetensors`` and ``NAME.json``; ``overfly export`` writes such a pair.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from overfly.configuration import build, register_resolvers
from overfly.errors import InputError
from overfly.files import replacing
from overfly.run import Run, load_run
from overfly.run_folder import WEIGHTS, checkpoint
from overfly.tables import read_rows

DEFAULT = "base"
"""The network that maps are made with if none is named."""


def names() -> list[str]:
    """The shipped networks."""
    return sorted(path.stem for path in WEIGHTS.glob("*.safetensors"))


def load_network(name: str | None = None) -> Run:
    """A shipped network by its name (None: the default one), or that of a run folder.

    Raises:
        InputError: there is neither such a network nor such a folder.
    """
    name = DEFAULT if name is None else name
    if name in names():
        return _load(WEIGHTS / f"{name}.safetensors")
    if not Path(name).exists():
        raise InputError(
            f"The network {name} is neither a shipped network ({', '.join(names()) or 'none'}) nor a run folder: "
            "give one of these, or a folder that train.py wrote."
        )
    return load_run(name)


def export(run_folder: Path | str, out: Path | str, name: str = DEFAULT) -> tuple[Path, Path]:
    """Write a run's best weights and what is known of them as ``name.safetensors`` and ``name.json``.

    Args:
        run_folder: of ``train.py``.
        out: folder to write into.
        name: by which the network will be asked for.

    Raises:
        InputError: the run holds no trained weights.
    """
    from omegaconf import OmegaConf
    from safetensors.torch import save_file

    run, out = load_run(run_folder), Path(out)
    register_resolvers()
    config = OmegaConf.load(run.folder / "config.yaml")
    found = checkpoint(Path(run_folder))
    assert found is not None
    top = Path(run_folder) if Path(run_folder).is_dir() else run.folder
    overrides = [line for line in _lines(top / "overrides.txt") if not line.startswith(("hydra.run", "resume"))]
    facts: dict[str, Any] = {
        "model": OmegaConf.to_container(config.model, resolve=True),
        "frames": config.frames,
        "image_size": OmegaConf.to_container(config.image_size),
        "seed": config.seed,
        "command": " ".join(["python train.py", *overrides]),
        "steps": {part: int(getattr(run.network, part).steps) for part in ("encoder", "generator", "discriminator")},
        "scores": _scores(found),
    }
    out.mkdir(parents=True, exist_ok=True)
    weights, described = out / f"{name}.safetensors", out / f"{name}.json"
    with replacing(weights) as temporary:
        save_file({key: value.contiguous() for key, value in run.network.state_dict().items()}, temporary)
    with replacing(described) as temporary:
        temporary.write_text(json.dumps(facts, indent=2) + "\n")
    return weights, described


def _load(path: Path) -> Run:
    from omegaconf import OmegaConf
    from safetensors.torch import load_file

    config = json.loads(path.with_suffix(".json").read_text())
    network = build(OmegaConf.create(config["model"]))
    network.load_state_dict(load_file(path))
    return Run(folder=path.parent, network=network.eval(), config=config, stage="full")


def _lines(path: Path) -> list[str]:
    return [line for line in path.read_text().splitlines() if line] if path.is_file() else []


def _scores(weights: Path) -> dict[str, float]:
    """The validation figures of the epoch after which a checkpoint was written, of the last phase that has it."""
    import torch

    epoch = torch.load(weights, map_location="cpu", weights_only=True).get("epoch")
    rows = [row for row in read_rows(weights.parent.parent / "metrics.csv") if row["epoch"] == epoch]
    return {key: round(value, 6) for key, value in (rows[-1] if rows else {}).items() if key.startswith("val/")}
