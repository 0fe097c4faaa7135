"""Tell a check or a plan to people and programs: table, findings, files, exit code."""

from __future__ import annotations

import json as jsons
from pathlib import Path
from typing import TYPE_CHECKING, Any

from overfly.errors import InputError
from overfly.files import replacing
from overfly.preflight.check import Check, check_flight

if TYPE_CHECKING:
    from rich.console import Console

STYLES = {"stop": "bold red", "bad": "red", "warn": "yellow", "note": "dim"}


def check_and_tell(
    folder: Path, *, altitude: float | None, json: Path | None, picture: Path | None, processes: int
) -> int:
    """Check a flight, print and write what was found; 1 where it cannot give a map, else 0.

    Raises:
        InputError: a bad value. A ``picture`` that cannot be drawn, since the overlap is not known, is only a note.
    """
    from rich.console import Console
    from rich.progress import Progress
    from rich.text import Text

    if picture is not None and picture.suffix.lower() != ".png":
        raise InputError(f"--picture {picture} is not a PNG file: give a name that ends in .png.")
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("images", total=None)
        found = check_flight(
            folder,
            altitude=altitude,
            processes=processes,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )
    tell(found, Console())
    if json is not None:
        with replacing(json) as temporary:
            temporary.write_text(jsons.dumps(found.to_dict(), indent=2) + "\n", encoding="utf-8")
    if picture is not None:
        try:
            data = found.picture()
        except InputError as error:
            Console(stderr=True).print(Text(f"{picture} was not written: {error}"), soft_wrap=True)
        else:
            with replacing(picture) as temporary:
                temporary.write_bytes(data)
    return 0 if found.mappable else 1


def tell(found: Check, console: Console) -> None:
    """Print the table, the findings worst first, and the verdict."""
    from rich.text import Text

    console.print(found.table())
    for finding in found.findings:
        console.print(Text.assemble((f"{finding.level:<5}", STYLES[finding.level]), str(finding)), soft_wrap=True)
    console.print(Text(found.verdict, style="bold"), soft_wrap=True)


def plan_and_tell(area: str, *, kml: Path | None, litchi: Path | None, **asked: Any) -> None:
    """Plan a flight, write its files and print it; for ``asked`` see :func:`overfly.preflight.plan.plan_area`.

    Raises:
        InputError: a value that is not possible.
    """
    from rich.console import Console

    from overfly.preflight.plan import plan_area

    planned = plan_area(area, **asked)
    written = planned.write(kml, litchi)
    console = Console()
    console.print(planned.table())
    for text in planned.remarks():
        console.print(f"Note: {text}", soft_wrap=True, markup=False, highlight=False)
    for path in written:
        console.print(str(path), soft_wrap=True, markup=False, highlight=False)
