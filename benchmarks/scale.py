"""How time and memory grow with the flight: rendered suburbs of several sizes, mapped with given cameras.

    python benchmarks/scale.py --frames 125 500 2000                       # 816 x 612, 0.5 megapixels
    python benchmarks/scale.py --frames 100 --width 1156 --max-memory 4    # 1 megapixel

Each flight is a square grid at 100 m with 75 % overlap along and 60 % between the lines, rendered once and kept in
--work. It is mapped with every product in a process that the system stops at --max-memory GiB of its own memory
(``RLIMIT_DATA``). Core-seconds are of the whole command with all threads, its parts are wall-clock seconds. A
flight that was mapped is not mapped again. Writes scale.csv, scale.md and scale.png.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import shutil
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from truth.cost import run_measured

from overfly.flights import find_preset, fly
from overfly.flights.plan import plan_flight
from overfly.geometry import Camera
from overfly.scenes import make_scene
from overfly.tables import markdown, write_rows

ALTITUDE, OVERLAP, SIDE, SEED = 100.0, 75.0, 60.0, 901
GIB = 2**30


def side_of(frames: int, camera: Camera) -> float:
    """Side in metres of the smallest square on which the flight has so many frames."""
    side = 10.0
    while True:
        plan = plan_flight(
            "grid", (0, 0, side, side), altitude=ALTITUDE, overlap=OVERLAP, side_overlap=SIDE, camera=camera,
            ground=lambda xy: np.zeros(len(xy)), rng=np.random.default_rng(0),
        )  # fmt: skip
        if len(plan.world_from_camera) >= frames:
            return side
        side *= 1.02


def flight_of(frames: int, width: int, work: Path, processes: int) -> Path:
    """The flight folder of so many frames, rendered if it is not there or not whole."""
    folder = work / f"flight-{frames}-{width}"
    if not (folder / "transforms.json").is_file():
        side = side_of(frames, find_preset("p4p").camera(width, width * 3 // 4))
        fly(make_scene("suburb", SEED, size_m=math.ceil(side + 2 * ALTITUDE)), out=folder, altitude=ALTITUDE,
            overlap=OVERLAP, side_overlap=SIDE, width=width, height=width * 3 // 4, frames=frames, area_m=side,
            seed=SEED, supersample=1, processes=processes)  # fmt: skip
    return folder


def mapped(flight: Path, out: Path, dense: str, limit: float) -> dict[str, Any]:
    """The figures of a flight's map: kept, or made.

    Raises:
        RuntimeError: the map failed, as it does beyond its memory.
    """
    if not (out / "cost.json").is_file():
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir(parents=True)
        command = [sys.executable, "-m", "overfly.cli", "map", str(flight), "--out", str(out), "--cameras", "given"]
        command += ["--dense", dense, "--max-memory", f"{limit * GIB / 1e9:g}"]
        most = int(limit * GIB)
        hard = partial(resource.setrlimit, resource.RLIMIT_DATA, (most, most))
        cost = run_measured(command, out.with_suffix(".log"), before=hard)
        (out / "cost.json").write_text(json.dumps(cost))
    facts = json.loads((out / "map.json").read_text())
    steps = {f"{name}_s": seconds for name, seconds in facts["seconds"].items()}
    told = {"frames": facts["registered"], "dense": dense, "points": facts["points"], "gsd_m": facts["gsd_m"]}
    return told | steps | json.loads((out / "cost.json").read_text())


def growth(rows: list[dict[str, Any]]) -> float | None:
    """The exponent p of core-seconds = c frames^p, least squares; 1 is linear. None of fewer than two sizes."""
    frames, spent = (np.log([row[key] for row in rows]) for key in ("frames", "core_seconds"))
    return float(np.polyfit(frames, spent, 1)[0]) if len(set(frames)) > 1 else None


def draw(rows: list[dict[str, Any]], path: Path, limit: float) -> None:
    """Core-seconds and memory by frames."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.5), layout="constrained")
    time, memory = figure.subplots(1, 2)
    for dense in dict.fromkeys(row["dense"] for row in rows):
        mine = sorted((row for row in rows if row["dense"] == dense), key=lambda row: row["frames"])
        frames = [row["frames"] for row in mine]
        time.plot(frames, [row["core_seconds"] / 60 for row in mine], "o-", label=dense)
        memory.plot(frames, [row["peak_mb"] / 1024 for row in mine], "o-", label=dense)
    time.set(xlabel="frames", ylabel="core-minutes", xlim=(0, None), ylim=(0, None))
    memory.set(xlabel="frames", ylabel="most memory, GiB", xlim=(0, None), ylim=(0, 1.1 * limit))
    memory.axhline(limit, color="gray", linestyle="--", label="limit")
    for axes in (time, memory):
        axes.legend()
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("outputs/scale"))
    parser.add_argument("--frames", nargs="+", type=int, default=[125, 500, 2000])
    parser.add_argument("--width", type=int, default=816, help="pixels")
    parser.add_argument("--dense", nargs="+", choices=("stereo", "sweep"), default=["stereo"])
    parser.add_argument("--max-memory", type=float, default=6.0, help="GiB")
    parser.add_argument("--processes", type=int, default=1, help="that render")
    parser.add_argument("--render", action="store_true", help="render the flights and stop")
    asked = parser.parse_args()
    flights = {n: flight_of(n, asked.width, asked.work, asked.processes) for n in sorted(asked.frames)}
    if asked.render:
        return
    rows: list[dict[str, Any]] = []
    for frames, flight in flights.items():
        for dense in asked.dense:
            out = asked.work / f"map-{frames}-{asked.width}-{dense}-{asked.max_memory:g}"
            rows.append({"width": asked.width, **mapped(flight, out, dense, asked.max_memory)})
            print(rows[-1], file=sys.stderr, flush=True)
    write_rows(asked.work / "scale.csv", rows)
    shown = ("frames", "dense", "points", "core_seconds", "seconds", "dense_s", "products_s", "peak_mb")
    text = markdown([{k: f"{row[k]:.0f}" if k != "dense" else row[k] for k in shown if k in row} for row in rows])
    for dense in asked.dense:
        exponent = growth([row for row in rows if row["dense"] == dense])
        text += "" if exponent is None else f"\n{dense}: core-seconds grow as frames to the power {exponent:.2f}.\n"
    (asked.work / "scale.md").write_text(text)
    draw(rows, asked.work / "scale.png", asked.max_memory)
    print(text)


if __name__ == "__main__":
    main()
