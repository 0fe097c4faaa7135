"""The folder of a run: its best weights, its results, and how it is gone on with."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from overfly.errors import InputError

if TYPE_CHECKING:
    import torch


WEIGHTS = Path(__file__).parent / "weights"
"""Where the shipped networks lie, as ``NAME.safetensors`` and ``NAME.json``."""


def checkpoint(folder: Path) -> Path | None:
    """The best checkpoint of a run folder, or the weights of a shipped network by its name; None if there are none.

    Raises:
        InputError: there is neither such a folder nor such a network.
    """
    if not folder.exists() and (shipped := WEIGHTS / f"{folder}.safetensors").is_file():
        return shipped
    if folder.is_file():
        return folder
    if not folder.is_dir():
        raise InputError(
            f"There is no run folder {folder}: give a folder that train.py wrote, such as outputs/all/..., "
            f"or a shipped network ({', '.join(sorted(path.stem for path in WEIGHTS.glob('*.safetensors')))})."
        )
    for part in (folder, folder / "full", folder / "gan", folder / "encoder"):
        if (part / "checkpoints" / "best.ckpt").is_file():
            return part / "checkpoints" / "best.ckpt"
    return None


def read_weights(path: Path) -> dict[str, torch.Tensor]:
    """The state dict of a checkpoint or of a shipped network (plain tensors only, nothing is unpickled)."""
    import torch

    if path.suffix == ".safetensors":
        from safetensors.torch import load_file

        return {f"network.{key}": value for key, value in load_file(path).items()}
    weights: dict[str, torch.Tensor] = torch.load(path, map_location="cpu", weights_only=True)["state_dict"]
    return weights


def collect(run_dir: Path, phases: list[str]) -> None:
    """Bring the phases' results to the top of a run of ``stage=all``: metrics, curves and the last best weights."""
    from overfly.callbacks.curves import plot_curves
    from overfly.tables import read_rows, write_rows

    finished = [name for name in phases if (run_dir / name / "metrics.json").is_file()]
    results = {name: json.loads((run_dir / name / "metrics.json").read_text()) for name in finished}
    if not results:
        return
    write_json(
        run_dir / "metrics.json",
        {
            "stage": "all",
            "monitored": results[finished[-1]]["monitored"],
            "monitor": results[finished[-1]]["monitor"],
            "phases": results,
        },
    )
    rows = {name: read_rows(run_dir / name / "metrics.csv") for name in finished}
    lines: list[dict[str, Any]] = [{"stage": name, **row} for name, part in rows.items() for row in part]
    if lines:
        write_rows(run_dir / "metrics.csv", lines)
        plot_curves({name: part for name, part in rows.items() if part}, run_dir / "curves.png")
    last = run_dir / finished[-1]
    shutil.copy(last / "config.yaml", run_dir / "config.yaml")
    for source in [*last.glob("checkpoints/best.ckpt"), *last.glob("clouds/*")]:
        target = run_dir / source.relative_to(last)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(source, target)


def write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=2) + "\n")


def resumed(argv: Sequence[str]) -> list[str]:
    """With ``resume=RUN``, put that run's own overrides first and go on in its folder."""
    folder = next((Path(item.removeprefix("resume=")) for item in argv if item.startswith("resume=")), None)
    if folder is None or str(folder) in ("null", ""):
        return list(argv)
    recorded = folder / "overrides.txt"
    if not recorded.is_file():
        raise InputError(
            f"resume={folder} is not a run folder (it has no overrides.txt): give one that train.py wrote, "
            "such as resume=outputs/all/2026-01-31_12-00-00-000000."
        )
    kept = [line for line in recorded.read_text().splitlines() if line and not line.startswith("resume=")]
    first = next((i for i, item in enumerate(argv) if "=" in item and not item.startswith("-")), len(argv))
    given = [f"resume={quoted(folder)}" if item.startswith("resume=") else item for item in argv]
    return [*given[:first], *kept, *given[first:], f"hydra.run.dir={quoted(folder)}"]  # flags before every override


def quoted(path: Path) -> str:
    """A path as a value of an override, whatever characters it has."""
    text = str(path).replace("\\", "\\\\").replace("'", "\\'")
    return f"'{text}'"
