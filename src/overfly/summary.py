"""The summary of a sweep: every job in one table and one plot, failed ones with their error."""

from __future__ import annotations

import json
import logging
import math
import sys
import traceback
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from overfly.tables import markdown, write_rows

log = logging.getLogger("overfly")

Job = dict[str, Any]


class SweepSummary(Callback):
    """Collects what the jobs of a multirun returned into ``summary.csv``, ``summary.md`` and ``summary.png``.

    Each job writes ``job.json`` into its own folder (also when a launcher runs it elsewhere). A job that fails is
    recorded with its error and its traceback stays in its own log, the other jobs run, and the whole command ends
    with exit code 1.
    """

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        if OmegaConf.is_missing(HydraConfig.get().job, "num"):  # a single run
            return
        failed = job_return.status is JobStatus.FAILED
        error = job_return._return_value if failed else None
        value = None if failed else job_return.return_value
        folder = Path(HydraConfig.get().runtime.output_dir)
        job: Job = {
            "number": int(HydraConfig.get().job.num),
            "folder": folder.name,
            "overrides": list(HydraConfig.get().overrides.task),
            "monitor": config.get("monitor"),
            "value": value,
            "status": "failed" if failed else "completed",
            "error": _sentence(error) if isinstance(error, BaseException) else None,
        }
        if isinstance(error, BaseException):
            log.error("Job %s failed.\n%s", job["number"], "".join(traceback.format_exception(error)))
            # The sweeper would stop the whole sweep at the first failed job; a NaN says the same and lets it go on.
            job_return.status = JobStatus.COMPLETED
            job_return.return_value = math.nan
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "job.json").write_text(json.dumps(job))

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        folder = Path(config.hydra.sweep.dir)
        jobs = read_jobs(folder)
        if not jobs:
            return
        table = write_summary(jobs, folder)
        print(table)
        print(f"The summary is in {folder}/summary.csv, summary.md and summary.png.", file=sys.stderr)
        failed = [job for job in jobs if job["status"] == "failed"]
        if failed:
            for job in failed:
                print(f"Error in {folder / job['folder']}: {job['error']}", file=sys.stderr)
            raise SystemExit(1)


def _sentence(error: BaseException) -> str:
    """The innermost cause: what Hydra wraps around it says nothing more."""
    while error.__cause__ is not None:
        error = error.__cause__
    return f"{type(error).__name__}: {error}"


def read_jobs(folder: Path) -> list[Job]:
    """The jobs of a sweep folder in order of their numbers."""
    jobs = [json.loads(path.read_text()) for path in folder.glob("*/job.json")]
    return sorted(jobs, key=lambda job: int(job["number"]))


def swept(jobs: list[Job]) -> list[str]:
    """The keys whose values differ between jobs, in the order in which they were given."""
    values: dict[str, set[str]] = {}
    for job in jobs:
        for key, value in _values(job).items():
            values.setdefault(key, set()).add(value)
    return [key for key, found in values.items() if len(found) > 1] or list(values)[:1]


def _values(job: Job) -> dict[str, str]:
    return dict(item.lstrip("+~").split("=", 1) for item in job["overrides"] if "=" in item)


def write_summary(jobs: list[Job], folder: Path) -> str:
    """Write the table and the plot and return the table as markdown."""
    keys = swept(jobs)
    monitor = next((job["monitor"] for job in jobs if job["monitor"]), "value")
    rows = []
    for job in jobs:
        values = _values(job)
        row: dict[str, Any] = {key: values.get(key, "") for key in keys}
        row |= {monitor: job["value"], "status": job["status"], "folder": job["folder"], "error": job["error"] or ""}
        metrics = folder / job["folder"] / "metrics.json"
        if metrics.is_file():
            content = json.loads(metrics.read_text())
            phases = content.get("phases", {content["stage"]: content})
            for result in phases.values():
                row |= {name: value for name, value in result["metrics"].items() if name.startswith(("test", "unseen"))}
        rows.append(row)
    write_rows(folder / "summary.csv", rows)
    shown = [*keys, monitor, "status", "folder"]
    table = markdown(rows, shown)
    table += "".join(f"\nFailed: `{row['folder']}`: {row['error']}\n" for row in rows if row["status"] == "failed")
    (folder / "summary.md").write_text(table)
    if keys:
        plot_summary(rows, keys, monitor, folder / "summary.png")
    return table


def plot_summary(rows: list[dict[str, Any]], keys: list[str], monitor: str, path: Path) -> None:
    """The metric against the first swept key; one line for every value of the others."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4), layout="constrained")
    axis = figure.subplots()
    groups: dict[str, list[tuple[str, float]]] = {}
    for row in rows:
        value = row[monitor]
        if isinstance(value, int | float) and math.isfinite(value):
            name = ", ".join(f"{key}={row[key]}" for key in keys[1:])
            groups.setdefault(name, []).append((row[keys[0]], float(value)))
    numeric = all(_is_number(row[keys[0]]) for row in rows)
    for name, points in groups.items():
        if numeric:
            ordered = sorted((float(x), y) for x, y in points)
            axis.plot(*zip(*ordered), marker="o", label=name or None)
        else:
            axis.plot([x for x, _ in points], [y for _, y in points], "o", label=name or None)
    if any(groups):
        axis.legend(frameon=False)
    failed = sum(row["status"] == "failed" for row in rows)
    axis.set(xlabel=keys[0], ylabel=monitor, title=f"{len(rows)} jobs" + (f", {failed} failed" if failed else ""))
    axis.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def _is_number(text: Any) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
