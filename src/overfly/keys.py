"""Advice about a key that the configuration does not have: where it belongs, or which one was meant."""

from __future__ import annotations

from collections.abc import Iterator
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

GLOBAL = "# @package _global_"
"""First line of a file that is laid over the whole configuration."""


def top_keys(conf: Path) -> frozenset[str]:
    """Every key that may stand at the top: of the primary file, of files that are laid over all, and the groups."""
    keys = {path.name for path in conf.iterdir() if path.is_dir()}
    for path in conf.rglob("*.yaml"):
        if path.parent == conf or path.read_text().startswith(GLOBAL):
            keys |= {str(key) for key in OmegaConf.load(path)}
    return frozenset(keys - {"defaults"})


def no_key(key: str, cfg: Any, conf: Path) -> str:
    """A sentence for a dotted key that the composed configuration ``cfg`` does not have."""
    known = [name for name in dotted(cfg) if name != key and not name.startswith("hydra.")]
    in_phases = key.startswith("stage.") and "phases" in known  # every phase has a stage of its own
    owners = [] if in_phases else [choice for choice, names in _choices(conf) if key in names]
    parent, _, last = key.rpartition(".")
    same = [name for name in known if name.endswith(f".{key}")]
    if owners or same:
        if owners:
            either = " or ".join(owners)
            meant = f" Or did you mean {' or '.join(same)}?" if same else ""
            return f"The key {key!r} belongs to {either}: add that, or leave {key} out.{meant}"
        more = " (or trainer.max_epochs, for all phases)" if key == "stage.epochs" else ""
        return f"There is no key {key!r} here. Did you mean {' or '.join(same)}{more}?"
    beside = {name.rpartition(".")[2]: name for name in known if name.rpartition(".")[0] == parent}
    below = [name for name in known if name.startswith(f"{key.partition('.')[0]}.") and name.endswith(f".{last}")]
    near = below[:1] or [beside[name] for name in get_close_matches(last, beside, 1)]
    if not beside:
        near = near or get_close_matches(key, known, 1)
    meant = f" Did you mean {near[0]}?" if near else ""
    return f"There is no key {key!r}.{meant} Type `python train.py --cfg job` to see every key."


def dotted(node: Any, above: str = "") -> Iterator[str]:
    """Every key of a configuration with the keys above it, ``data.source.images``; nothing is resolved."""
    content = OmegaConf.to_container(node, resolve=False) if OmegaConf.is_config(node) else node
    for name, value in content.items() if isinstance(content, dict) else ():
        key = str(name)
        yield f"{above}{key}"
        yield from dotted(value, f"{above}{key}.")


def _choices(conf: Path) -> Iterator[tuple[str, set[str]]]:
    """The files of the groups by what is typed to choose them, ``data=folder``, and the keys that they bring."""
    for path in sorted(conf.glob("*/*.yaml")):
        if path.parent.name in ("experiment", "sweep"):  # they set keys of others
            continue
        above = "" if path.read_text().startswith(GLOBAL) else f"{path.parent.name}."
        yield f"{path.parent.name}={path.stem}", set(dotted(OmegaConf.load(path), above)) - {"defaults"}
