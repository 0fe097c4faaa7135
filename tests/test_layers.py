"""The straight flow of the house: imports point only to the left."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import overfly

PACKAGE = Path(overfly.__file__).parent
ORDER = [
    ["__init__", "errors", "tables"],
    ["geometry", "geodesy"],
    ["ply", "files", "cloud", "mesh"],
    ["losses", "image_losses", "mesh_losses", "metrics"],
    ["scenes"],
    ["rendering"],
    ["flights"],
    ["data"],
    ["networks"],
    ["stages"],
    ["callbacks"],
    ["mapping"],
    ["preflight"],
    ["refinement"],
    ["evaluation"],
    ["checks", "keys", "configuration", "summary", "run_folder", "run", "evaluate", "shipped", "refine"],
    ["cli"],
]
RANK = {name: rank for rank, names in enumerate(ORDER) for name in names}
OPTIONAL = {"wandb", "tensorboard", "embreex", "hydra_plugins"}


def modules() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def place(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module


def test_every_module_has_its_place() -> None:
    assert {place(path) for path in modules()} <= set(RANK)


def test_imports_point_only_to_the_left() -> None:
    wrong = []
    for path in modules():
        for name in imported(path):
            parts = name.split(".")
            if parts[0] == "overfly" and len(parts) > 1 and RANK[parts[1]] > RANK[place(path)]:
                wrong.append(f"{path.relative_to(PACKAGE)} imports {name}")
    assert not wrong


def test_optional_packages_are_not_imported_at_the_top_of_a_module() -> None:
    wrong = []
    for path in modules():
        for node in ast.parse(path.read_text()).body:
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            wrong += [f"{path.name}: {name}" for name in names if name.split(".")[0] in OPTIONAL]
    assert not wrong


def test_only_run_and_the_summary_of_sweeps_know_hydra() -> None:
    knows = {place(path) for path in modules() if any(name.split(".")[0] == "hydra" for name in imported(path))}
    assert knows <= {"configuration", "run", "summary"}
