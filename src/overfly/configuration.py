"""The tree of YAML files: where it lies, what it may say, how it becomes objects, and what is wrong with it.

Beside :mod:`overfly.run` and the summary of sweeps the only module that knows Hydra.
"""

from __future__ import annotations

import os
import re
from functools import lru_cache
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from overfly.errors import InputError

BOUNDS = {"altitude": (20, 500), "overlap": (0, 95), "side_overlap": (0, 95)}
UNITS = {"altitude": "metres above ground", "overlap": "percent", "side_overlap": "percent"}


def conf_dir() -> Path:
    """The folder of configurations: inside the installed package, else beside the source tree."""
    here = Path(__file__).resolve().parent
    return next(folder for folder in (here / "conf", here.parents[1] / "conf") if folder.is_dir())


def register_resolvers() -> None:
    """``${overfly.slug:text}`` makes a folder name, ``${overfly.user_cache:}`` names the user's cache folder."""

    def slug(text: str) -> str:
        kept = "".join(c if c.isalnum() or c in ".-_" else "-" for c in str(text).replace("=", "-"))
        return kept[:80] or "run"

    def user_cache() -> str:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        return str(Path(base) / "overfly")

    OmegaConf.register_new_resolver("overfly.slug", slug, replace=True)
    OmegaConf.register_new_resolver("overfly.user_cache", user_cache, replace=True)


def check(cfg: DictConfig) -> None:
    """Refuse values that no flight can have.

    Raises:
        InputError: ``altitude``, ``overlap`` or ``side_overlap`` is no number or out of bounds; ``frames`` or
            ``image_size`` is not possible; a key that no file of the tree knows.
    """
    for key, (low, high) in BOUNDS.items():
        values = cfg[key] if OmegaConf.is_list(cfg[key]) else [cfg[key]]
        for value in values:
            if value is None and key == "side_overlap":
                continue
            number = isinstance(value, int | float) and not isinstance(value, bool)
            if not number or not (low <= value <= high):
                raise InputError(
                    f"{key}={value} is not possible: give {UNITS[key]}, a number from {low} to {high} "
                    f"(or a list of them), for instance {key}={(low + high) // 2}."
                )
    unknown_keys = sorted(set(map(str, cfg)) - _top_keys())
    if unknown_keys:
        raise InputError(_no_key(unknown_keys[0]))
    size = OmegaConf.to_container(cfg.image_size) if OmegaConf.is_list(cfg.image_size) else cfg.image_size
    if not (isinstance(size, list) and len(size) == 2 and all(type(x) is int and x > 0 for x in size)):
        raise InputError(f"image_size={size} is not possible: give width and height in pixels, image_size=[128,96].")
    if not isinstance(cfg.frames, int) or not 1 <= cfg.frames <= 8:
        raise InputError(f"frames={cfg.frames} is not possible: a window has 1 to 8 frames, for instance frames=3.")


@lru_cache(maxsize=1)
def _top_keys() -> frozenset[str]:
    """Every key that may stand at the top: of the primary file, of files that are laid over all, and the groups."""
    keys = {path.name for path in conf_dir().iterdir() if path.is_dir()}
    for path in conf_dir().rglob("*.yaml"):
        if path.parent == conf_dir() or path.read_text().startswith("# @package _global_"):
            keys |= {str(key) for key in OmegaConf.load(path)}
    return frozenset(keys - {"defaults"})


def _no_key(key: str) -> str:
    from difflib import get_close_matches

    if key in _top_keys():
        files = [p for p in conf_dir().glob("*/*.yaml") if re.search(rf"^{key}:", p.read_text(), re.MULTILINE)]
        groups = " or ".join(sorted(f"{p.parent.name}={p.stem}" for p in files))
        return f"The key {key!r} belongs to {groups}: add that, or leave {key} out."
    near = get_close_matches(key, _top_keys(), 1)
    meant = f" Did you mean {near[0]}?" if near else ""
    return f"There is no key {key!r}.{meant} Type `python train.py --cfg job` to see every key."


def build(cfg: Any) -> Any:
    """Instantiate a part of the configuration, nested parts included: the one call of Hydra's ``instantiate``."""
    from hydra.utils import instantiate

    return instantiate(cfg, _convert_="all")


def save(cfg: DictConfig, folder: Path) -> None:
    """The configuration with every value filled in, without this machine's folders, so that the run can be moved."""
    from hydra.core.hydra_config import HydraConfig

    resolved = OmegaConf.create(OmegaConf.to_container(cfg, resolve=False))
    assert isinstance(resolved, DictConfig)
    OmegaConf.set_struct(resolved, False)
    for key in ("phases", "sweep"):
        resolved.pop(key, None)
    resolved.run_dir = "."
    if cfg.from_run is not None and Path(cfg.from_run).parent == folder.parent:
        resolved.from_run = f"../{Path(cfg.from_run).name}"  # the phase before, which moves along
    OmegaConf.resolve(resolved) if cfg.stage is not None else None
    OmegaConf.save(resolved, folder / "config.yaml")
    if HydraConfig.initialized():
        overrides = HydraConfig.get().overrides.task
        (folder / "overrides.txt").write_text("".join(f"{item}\n" for item in overrides))


def explain(error: BaseException) -> str | None:
    """One sentence for what the user can mend: what was given, and what is allowed. None for a bug."""
    from hydra.errors import ConfigCompositionException, MissingConfigException
    from omegaconf.errors import OmegaConfBaseException

    chain: list[BaseException] = [error]
    while (cause := chain[-1].__cause__) is not None:
        chain.append(cause)
    for link in chain:
        if isinstance(link, InputError):
            return str(link)
    text = " ".join(" ".join(str(link).split()) for link in chain[:2])
    text = text.split(" Config search path:")[0]
    if isinstance(error, MissingConfigException):
        return text
    if (found := re.search(r"Could not override '([^']+)'", text)) and "." not in found[1]:
        return _no_key(found[1])
    if found := re.search(r"Missing mandatory value: (\S+)", text):
        return f"{found[1]} has no value: give {found[1]}=VALUE on the command line."
    if isinstance(error, ConfigCompositionException | OmegaConfBaseException):
        return f"The configuration refuses this: {text}. Type `python train.py --cfg job` to see every key."
    return None
