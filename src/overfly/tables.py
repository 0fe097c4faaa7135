"""Small tables as files: CSV with one column a metric, and markdown for people."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

Row = dict[str, float]


def write_rows(path: Path, rows: Iterable[dict[str, Any]]) -> None:
    """Write rows with the union of their columns, whole or not at all."""
    lines = list(rows)
    if not lines:
        return
    part = path.with_suffix(".part")
    with part.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(key for row in lines for key in row)))
        writer.writeheader()
        writer.writerows(lines)
    os.replace(part, path)


def read_rows(path: Path) -> list[Row]:
    """The numbers in the rows of a metrics file, empty cells and words left out; no rows if it does not exist."""
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return [{k: n for k, v in row.items() if (n := _number(v)) is not None} for row in csv.DictReader(file)]


def _number(text: str | None) -> float | None:
    try:
        return float(text or "")
    except ValueError:
        return None


def markdown(rows: Sequence[dict[str, Any]], columns: Sequence[str] | None = None) -> str:
    """Rows as a markdown table; numbers with four significant digits, missing values as a dash."""
    columns = list(dict.fromkeys(key for row in rows for key in row)) if columns is None else list(columns)
    lines = ["| " + " | ".join(columns) + " |", "| " + " | ".join("---" for _ in columns) + " |"]
    lines += ["| " + " | ".join(_text(row.get(column)) for column in columns) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else "-" if value is None else str(value)
