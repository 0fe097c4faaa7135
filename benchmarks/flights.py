"""Dense methods on whole flights with exact cameras, beside each other: accuracy, completeness, cost.

    python benchmarks/flights.py --dense stereo sweep --network outputs/all/RUN [--styles blocks village] [--work DIR]
    python benchmarks/flights.py --scene DATA/autzen_offices.laz --altitudes 100 150 300

Flights, maps and figures are kept in --work: a second call does only what is missing. ``--again sweep`` maps anew by
one method, ``--label`` keeps the maps of several networks beside each other. Each flight's folder holds:

    flight/            800 x 600 images, exact cameras, reference.laz
    views.npy          how many images see each reference point, by depth maps of the scene
    <method>/          the map (``overfly map``)
    <method>.json      its figures

All surface that at least one image sees counts, walls and borders too. Distances from the cloud are those to the
scene's triangles (``truth/surface.py``); recall asks reference points, uniform by area, for the nearest point of the
cloud. The cloud is thinned to 0.1 m first. ``--dense exact`` measures the images' true depth, one point per ground
pixel: the most that a map of this resolution can reach. Core-seconds and memory are those of the whole command.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from pathlib import Path
from typing import Any

from truth.case import CELLS, Case, measure, text
from truth.cost import run_measured

from overfly.metrics.functional import THRESHOLDS_M
from overfly.scenes import STYLES
from overfly.tables import markdown, write_rows

USUAL = ["grid-30", "grid-50", "circular-50", "circular-80"]


def run_map(case: Case, folder: Path, dense: str, network: str | None) -> dict[str, Any]:
    """Map a flight in a process of its own, on one thread, and return what it took.

    Raises:
        RuntimeError: the map failed.
    """
    command = [sys.executable, "-m", "overfly.cli", "map", str(case.flight.root), "--out", str(folder)]
    command += ["--cameras", "given", "--dense", dense]
    command += ["--network", network] if network and dense == "sweep" else []
    folder.mkdir(parents=True, exist_ok=True)
    try:
        cost = run_measured(command, case.folder / f"{folder.name}.log", env={"OMP_NUM_THREADS": "1"})
    except RuntimeError:
        shutil.rmtree(folder)
        raise
    facts = json.loads((folder / "map.json").read_text())
    return {
        **cost,
        "dense_seconds": facts["seconds"]["dense"],
        "network": network if dense == "sweep" else None,
    }


def figures(case: Case, method: str, options: argparse.Namespace) -> dict[str, Any]:
    """The figures of one method on one flight: kept, or made."""
    labelled = f"{method}-{options.label}" if options.label and method == "sweep" else method
    folder, kept = case.folder / labelled, case.folder / f"{labelled}.json"
    if method in options.again:
        shutil.rmtree(folder, ignore_errors=True)
    cost, fresh = folder / "cost.json", method in options.again or options.measure
    if kept.is_file() and not fresh:
        row = json.loads(kept.read_text())
        if method == "sweep" and row["network"] != options.network:
            note = f"{kept} is of the network {row['network']}: give --again sweep, or a --label for this one."
            raise RuntimeError(note)
        return row
    spent: dict[str, Any] = {}
    if method != "exact":
        if not cost.is_file():
            shutil.rmtree(folder, ignore_errors=True)
            spent = run_map(case, folder, method, options.network)
            cost.write_text(json.dumps(spent, indent=2) + "\n")
        spent = json.loads(cost.read_text())
    cloud = case.exact_cloud() if method == "exact" else case.map_cloud(folder)
    row = {"flight": case.name, "method": labelled, "images": len(case.flight), **measure(case, cloud), **spent}
    kept.write_text(json.dumps(row, indent=2) + "\n")
    return row


def means(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The mean over scenes of each path, overlap, altitude and method."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(("_".join(row["flight"].split("_")[-2:]), row["method"]), []).append(row)
    found = []
    for (cell, method), group in groups.items():
        row: dict[str, Any] = {"flight": f"mean {cell}", "method": method}
        for key in group[0]:
            values = [r[key] for r in group if isinstance(r.get(key), int | float)]
            if values and key not in row:
                row[key] = sum(values) / len(values)
        found.append(row)
    return found


def table(rows: list[dict[str, Any]]) -> str:
    """The main figures as markdown, a line for each flight and method."""

    lines = [
        {
            "flight": row["flight"],
            "method": row["method"],
            "F-score at 0.25 / 0.5 / 1 / 2 m": text(row, *(f"fscore_{t:g}" for t in THRESHOLDS_M)),
            "precision 0.5 / 1 m": text(row, "precision_0.5", "precision_1"),
            "recall 0.5 / 1 m": text(row, "recall_0.5", "recall_1"),
            "seen by 1 / 2 / 3+": text(row, "seen_1", "seen_2", "seen_3"),
            "recall at 1 m there": text(row, "recall_1_seen_1", "recall_1_seen_2", "recall_1_seen_3"),
            "error, median / p90, m, seen by 2+": text(row, "error_median", "error_p90", digits=3),
            "predicted": text(row, "predicted"),
            "within 1 / 2 sigma": text(row, "within_1_sigma", "within_2_sigma"),
            "core-seconds": text(row, "core_seconds", digits=0),
            "peak MB": text(row, "peak_mb", digits=0),
        }
        for row in rows
    ]
    return markdown(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--work", type=Path, default=Path("outputs/flights"))
    parser.add_argument("--styles", nargs="+", choices=STYLES, default=["blocks", "suburb", "village"])
    parser.add_argument("--scene", nargs="+", default=[], help="scene files, flown over instead of the styles")
    parser.add_argument(
        "--cells",
        nargs="+",
        choices=CELLS,
        default=["grid-30", "grid-50", "circular-50", "circular-80"],
        help="paths and overlaps",
    )
    parser.add_argument("--altitudes", nargs="+", type=float, default=[150.0], help="metres")
    parser.add_argument("--dense", nargs="+", choices=("stereo", "sweep", "exact"), default=["stereo"])
    parser.add_argument("--network", help="a run folder for sweep; without it the shipped network")
    parser.add_argument("--label", help="added to the name of sweep's results")
    parser.add_argument(
        "--again", nargs="+", default=[], choices=("stereo", "sweep", "exact"), help="map anew by these"
    )
    parser.add_argument("--measure", action="store_true", help="measure anew the maps that are there")
    options = parser.parse_args()
    rows, failed = [], []
    for scene in options.scene or options.styles:
        for altitude in options.altitudes:
            for cell in options.cells:
                case = Case(scene, cell, altitude, options.work)
                for method in options.dense:
                    try:
                        rows.append(figures(case, method, options))
                        print(table(rows[-1:]), file=sys.stderr, flush=True)
                    except RuntimeError as error:
                        failed.append(f"{case.name}, {method}: {error}")
                        print(failed[-1], file=sys.stderr, flush=True)
    both = rows + means(rows)
    write_rows(options.work / "flights.csv", both)
    (options.work / "flights.md").write_text(table(both))
    print(table(both))
    if failed:
        raise SystemExit("\n".join(failed))


if __name__ == "__main__":
    main()
