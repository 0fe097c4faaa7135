"""The tree of YAML files: where it lies, what it may say, how it becomes objects, and what is wrong with it.

Beside :mod:`overfly.run` and the summary of sweeps the only module that knows Hydra.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from overfly.checks import check_overrides, check_together, check_values
from overfly.errors import InputError, unknown
from overfly.keys import no_key, top_keys


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
    """Refuse what no run can mean.

    Raises:
        InputError: a value is not possible, a key is in no file of the tree, parts do not go together, or an override
            that was typed would be ignored.
    """
    from hydra.core.hydra_config import HydraConfig

    unknown_keys = sorted(set(map(str, cfg)) - top_keys(conf_dir()))
    if unknown_keys:
        raise InputError(no_key(unknown_keys[0], cfg, conf_dir()))
    check_together(cfg, conf_dir())
    if HydraConfig.initialized():
        check_overrides(cfg, HydraConfig.get().overrides.task, conf_dir())
    check_values(cfg)


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
    from hydra.errors import (
        ConfigCompositionException,
        InstantiationException,
        MissingConfigException,
        OverrideParseException,
    )
    from omegaconf.errors import OmegaConfBaseException

    chain: list[BaseException] = [error]
    while (cause := chain[-1].__cause__) is not None:
        chain.append(cause)
    for link in chain:
        if isinstance(link, InputError):
            return str(link)
    text = " ".join(" ".join(str(link).split()) for link in chain[:2])
    text = text.split(" Config search path:")[0]
    if isinstance(error, OverrideParseException):
        return (
            f"{error.override!r} cannot be read: type KEY=VALUE without spaces around the =, and lists, braces and "
            "spaces in quotes, for instance stage=gan 'overlap=[30,50]'."
        )
    if isinstance(error, ValueError) and text.startswith("Config group override must be"):  # Hydra's word for `=3`
        return (
            "An override has no key before its =, or a number where a name is meant: type KEY=VALUE, for instance "
            "stage=gan overlap=50."
        )
    if isinstance(error, MissingConfigException):
        return text
    if found := re.search(r"Could not override '([^'@]+)'", text):
        root = getattr(chain[-1], "parent_node", None)
        while root is not None and root._get_parent() is not None:
            root = root._get_parent()
        return no_key(found[1], root, conf_dir())
    if found := re.search(r"Missing mandatory value: (\S+)", text):
        return f"{found[1]} has no value: give {found[1]}=VALUE on the command line."
    if isinstance(error, InstantiationException):
        return _not_built(str(error), chain[-1])
    if (sentence := _not_measured(text)) is not None:
        return sentence
    if _misconfigured(error):
        return f"The trainer refuses this: {text}"
    if isinstance(error, ConfigCompositionException | OmegaConfBaseException):
        return f"The configuration refuses this: {text}. Type `python train.py --cfg job` to see every key."
    return None


def _not_built(message: str, cause: BaseException) -> str | None:
    """A sentence for a part that cannot be built; None for a bug in it."""
    if found := re.search(r"Error (?:locating|loading) (?:target )?'([^']+)'", message):
        if not isinstance(cause, ImportError | AttributeError):  # it was found, and fails by itself
            return None
        return (
            f"_target_={found[1]} was not found ({_one_line(cause)}): give MODULE.NAME of a module that can be "
            "imported, in the working folder or on PYTHONPATH."
        )
    found = re.search(r"call to target '(\w+)\.", message)
    arguments = "argument" in str(cause) and isinstance(cause, TypeError)
    of_ours = found is not None and found[1] in ("overfly", "lightning", "torch")
    if not arguments and not (of_ours and (isinstance(cause, TypeError | ValueError) or _misconfigured(cause))):
        return None
    key = re.search(r"full_key: (\S+)", message)
    part = key[1] if key else "trainer" if "trainer.Trainer'" in message else "A part"
    return f"{part} cannot be built as it is configured: {_one_line(cause)}."


def _misconfigured(error: BaseException) -> bool:
    """Whether Lightning refuses what it was given (its exception takes seconds to import)."""
    return type(error).__name__ == "MisconfigurationException"


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()).rstrip(".!")


def _not_measured(text: str) -> str | None:
    """A sentence for a monitored metric that no epoch has measured."""
    found = re.search(r"monitor='([^']+)'\)` could not find .* returned metrics: \[(.*?)\]", text)
    found = found or re.search(r"conditioned on metric `([^`]+)` which is not available.*following: `(.*?)`\s*$", text)
    if found is None:
        return None
    measured = re.findall(r"(?:val|train)/\w+", found[2])
    return str(unknown("The metric", found[1], measured, "Type monitor=NAME with one of them."))
