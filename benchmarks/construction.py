"""The second paper's Table 2 in our form: from photographs of a construction site to cloud and rough mesh, in seconds.

    python benchmarks/construction.py --out outputs/construction
    python benchmarks/construction.py --images 10 --widths 1600 --dense sweep

Each cell flies one orbit over a building under construction (``truth/construction.py``), estimates the cameras from
the photographs (their GPS is off by metres, as usual), makes the cloud and a rough mesh of it in a process of its own
on all cores, and compares the cloud with the true surface after a rigid move. Finished cells are kept. Writes
construction.md and construction.csv into --out. The paper's mean is 61 s.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from truth.construction import construction_site

from overfly.flights import find_preset, fly
from overfly.flights.plan import plan_flight
from overfly.geometry import Camera
from overfly.tables import markdown, write_rows

ALTITUDE, TILT = 60.0, 30.0
FACES = 200_000
PAPER_S = 61.0


def orbit_overlap(count: int, camera: Camera, ground: Any) -> float:
    """The forward overlap, percent, with which one orbit has ``count`` frames."""
    for overlap in np.arange(50, 95, 0.5):
        plan = plan_flight(
            "circular", (-1, -1, 1, 1), altitude=ALTITUDE, overlap=float(overlap), side_overlap=50, camera=camera,
            ground=ground, rng=np.random.default_rng(0), tilt_deg=TILT, frames=count + 1,
        )  # fmt: skip
        if len(plan.world_from_camera) == count:
            return float(overlap)
    raise SystemExit(f"No overlap gives an orbit of {count} frames.")


def build(flight: Path, out: Path, dense: str, size: int) -> None:
    """Photographs to cloud and rough mesh; writes figures.json."""
    from overfly.mapping.deliver import georeferenced
    from overfly.mapping.map import measure_flight
    from overfly.mapping.rough_mesh import rough_mesh
    from overfly.mapping.steps import peak_memory_mb
    from overfly.mesh import write_mesh
    from overfly.metrics.evaluate import evaluate
    from overfly.shipped import load_network

    start = time.perf_counter()
    network = load_network(None) if dense == "sweep" else None
    _, block, tiles = measure_flight(
        flight, out=out, cameras="estimate", dense=dense, size=size, network=network, progress=False
    )
    cloud, meshed = tiles.whole(), time.perf_counter()
    write_mesh(rough_mesh(cloud, faces=FACES), out / "rough.ply")
    now, used = time.perf_counter(), os.times()
    figures: dict[str, Any] = {
        "placed": len(block.frames),
        "points": len(cloud),
        "cloud_s": meshed - start,
        "mesh_s": now - meshed,
        "core_seconds": used.user + used.system + used.children_user + used.children_system,
        "peak_mb": peak_memory_mb(),
    }
    judged = evaluate(georeferenced(cloud, block), flight / "reference.laz", align="rigid")
    figures |= {f"fscore_{t}m": judged["fscore"][t] for t in ("0.25", "0.5", "1.0")}
    figures["error_median_m"] = judged["accuracy_median_m"]
    (out / "figures.json").write_text(json.dumps(figures, indent=2) + "\n")


def cell(asked: argparse.Namespace, images: int, width: int) -> dict[str, Any]:
    """The figures of one number of images and one width: kept, or made."""
    flight, out = asked.out / f"flight-{images}-{width}", asked.out / f"map-{images}-{width}-{asked.dense}-{asked.size}"
    if not (out / "figures.json").is_file():
        preset = find_preset("p4p")
        scene = construction_site()
        if not (flight / "reference.laz").is_file():
            camera = preset.camera(width, width * 3 // 4)
            overlap = orbit_overlap(images, camera, scene.ground)
            fly(scene, out=flight, flight_path="circular", overlap=overlap, altitude=ALTITUDE, tilt_deg=TILT,
                width=width, height=width * 3 // 4, frames=images, area_m=2.0, noise="gps",
                reference_points=1_000_000)  # fmt: skip
        own = [sys.executable, __file__, "--build", str(flight), "--out", str(out), "--dense", asked.dense]
        out.mkdir(parents=True, exist_ok=True)
        subprocess.run([*own, "--size", str(asked.size)], check=True)
    figures = json.loads((out / "figures.json").read_text())
    return {"images": images, "width": width, "height": width * 3 // 4, **figures}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("outputs/construction"))
    parser.add_argument("--images", nargs="+", type=int, default=[10, 20, 30])
    parser.add_argument("--widths", nargs="+", type=int, default=[1600, 2400, 3200])
    parser.add_argument("--dense", choices=("stereo", "sweep"), default="stereo")
    parser.add_argument("--size", type=int, default=1600, help="longest side at which images are matched")
    parser.add_argument("--build", type=Path, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.build:
        build(asked.build, asked.out, asked.dense, asked.size)
        return
    rows: list[dict[str, Any]] = []
    for images in asked.images:
        for width in asked.widths:
            rows.append(cell(asked, images, width))
            print(rows[-1], file=sys.stderr, flush=True)
    write_rows(asked.out / "construction.csv", rows)
    lines = [
        {
            "images": row["images"],
            "size": f"{row['width']} x {row['height']}",
            "placed": row["placed"],
            "cloud + mesh, s": f"{row['cloud_s']:.0f} + {row['mesh_s']:.0f}",
            "core-seconds": f"{row['core_seconds']:.0f}",
            "peak MB": f"{row['peak_mb']:.0f}",
            "points": f"{row['points'] / 1e6:.2f} M",
            "F-score at 0.25 / 0.5 / 1 m": " / ".join(f"{row[f'fscore_{t}m']:.2f}" for t in ("0.25", "0.5", "1.0")),
            "median error, m": f"{row['error_median_m']:.3f}",
        }
        for row in rows
    ]
    mean = float(np.mean([row["cloud_s"] + row["mesh_s"] for row in rows]))
    text = f"{markdown(lines)}\n\nMean {mean:.0f} s (the paper: {PAPER_S:.0f} s)."
    (asked.out / "construction.md").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
