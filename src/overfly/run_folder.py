"""The folder of a run: its best weights, its results, and how it is gone on with."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from overfly.errors import InputError

if TYPE_CHECKING:
    import torch


WEIGHTS = Path(__file__).parent / "weights"
"""Where the shipped networks lie, as ``NAME.safetensors`` and ``NAME.json``."""

PHASES = ("encoder", "gan", "full")
"""Of ``stage=all``: each has a run folder of its own in that of the whole."""


def checkpoint(folder: Path) -> Path | None:
    """The best checkpoint of a run folder, exported weights, or those of a shipped network by its name; None if there
    are none.

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
    for part in (folder, *(folder / name for name in reversed(PHASES))):
        if (part / "checkpoints" / "best.ckpt").is_file():
            return part / "checkpoints" / "best.ckpt"
    exported = list(folder.glob("*.safetensors"))
    return exported[0] if len(exported) == 1 else None


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


SAID = ("config.yaml", "overrides.txt", "metrics.json")
"""Files of a run folder that say what was asked and what came out; the last also tells that it is finished."""


def same_stage(folder: Path, stage: str) -> None:
    """Refuse to go on in a run folder with another stage, which would overwrite its results.

    Raises:
        InputError: it is of another stage, or a phase of a run of ``stage=all``.
    """
    from omegaconf import OmegaConf

    if not (folder / "config.yaml").is_file():
        return
    whole = any((folder / name / "config.yaml").is_file() for name in PHASES)
    made = "all" if whole else str(OmegaConf.load(folder / "config.yaml").stage_name)
    if made == stage:
        return
    if folder.name in PHASES and (folder.parent / "overrides.txt").is_file():
        raise InputError(
            f"resume={folder} is a phase of a run of stage=all: give resume={folder.parent}, or start a run of its own "
            f"from its weights with stage={made} from_run={folder}."
        )
    raise InputError(
        f"resume={folder} is a run of stage={made}, not of stage={stage}: leave stage out to go on with it, or start a "
        f"new run from its weights with from_run={folder}."
    )


@contextmanager
def as_it_was(folder: Path) -> Iterator[None]:
    """If going on fails, a run folder and its phases keep what they said: a bad override must not stay in them."""
    tops = (folder, *(folder / phase for phase in PHASES))
    before = {path: path.read_bytes() for top in tops for name in SAID if (path := top / name).is_file()}
    weights = {path: path.stat().st_mtime_ns for top in tops if (path := top / "checkpoints" / "last.ckpt").is_file()}
    try:
        yield
    except Exception:
        if any(path.stat().st_mtime_ns != time for path, time in weights.items()):
            raise  # it has trained as it was asked to
        for path, content in before.items():
            path.write_bytes(content)
        raise


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
