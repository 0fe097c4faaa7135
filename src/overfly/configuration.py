"""The tree of YAML files: where it lies, what it may say, how it becomes objects, and what is wrong with it.

Beside :mod:`overfly.run` and the summary of sweeps the only module that knows Hydra.
"""

from __future__ import annotations

import os
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
        InputError: ``altitude``, ``overlap`` or ``side_overlap`` is no number or out of bounds.
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
    if not isinstance(cfg.frames, int) or not 1 <= cfg.frames <= 8:
        raise InputError(f"frames={cfg.frames} is not possible: a window has 1 to 8 frames, for instance frames=3.")


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
    if isinstance(error, MissingConfigException):
        return text
    if isinstance(error, ConfigCompositionException | OmegaConfBaseException):
        return f"The configuration refuses this: {text}. Type `python train.py --cfg job` to see every key."
    return None
