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
scene's triangles (:mod:`surface`); recall asks reference points, uniform by area, for the nearest point of the cloud.
The cloud is thinned to 0.1 m first. ``--dense exact`` measures the images' true depth, one point per ground pixel: the
most that a map of this resolution can reach.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from surface import Surface

from overfly.cloud import Cloud, read_cloud, voxel_thin
from overfly.flights import Flight, find_preset, fly, read_flight
from overfly.flights.launch import default_area
from overfly.flights.plan import DEFAULT_TILT_DEG
from overfly.geodesy import enu_from_crs
from overfly.geometry import Array, pixel_grid, unproject
from overfly.metrics.functional import THRESHOLDS_M, harmonic
from overfly.scenes import STYLES, Scene, load_scene, make_scene
from overfly.tables import markdown, write_rows

CELLS = {"grid-30": ("grid", 30), "grid-50": ("grid", 50), "grid-80": ("grid", 80), "circular-50": ("circular", 50)}
SEED = 900
"""Of every landscape here: no training uses seeds this high."""

CAMERA, FRAMES, VOXEL_M = "p4p", 25, 0.1
STEEP = 0.5
"""Surfaces whose normal rises less than this are walls, on which an error in height means nothing."""


@dataclass
class Case:
    """One flight: a style or scene file, flown on a path with an overlap at an altitude (metres)."""

    scene_name: str
    cell: str
    altitude: float
    work: Path

    @property
    def name(self) -> str:
        return f"{Path(self.scene_name).stem}_{self.cell}_{self.altitude:g}m"

    @property
    def folder(self) -> Path:
        return self.work / self.name

    @cached_property
    def scene(self) -> Scene:
        """The landscape; a style's reaches beyond the area flown."""
        if self.scene_name not in STYLES:
            return load_scene(self.scene_name)
        path, overlap = CELLS[self.cell]
        camera = find_preset(CAMERA).camera(800, 600)
        area = default_area(path, camera, self.altitude, overlap, overlap, DEFAULT_TILT_DEG[path])
        return make_scene(self.scene_name, SEED, size_m=float(np.ceil(max(area) + 1.2 * self.altitude)))

    @cached_property
    def flight(self) -> Flight:
        """The flight folder, written if it is not there."""
        folder = self.folder / "flight"
        if not (folder / "transforms.json").is_file():
            path, overlap = CELLS[self.cell]
            options: dict[str, Any] = {"width": 800, "height": 600, "frames": FRAMES, "seed": SEED}
            fly(self.scene, out=folder, flight_path=path, overlap=overlap, altitude=self.altitude, **options)
        return read_flight(folder)

    @cached_property
    def cameras(self) -> tuple[list, list[Array]]:
        return [f.camera for f in self.flight.frames], [np.asarray(f.world_from_camera) for f in self.flight.frames]

    @cached_property
    def surface(self) -> Surface:
        return Surface(self.scene)

    @cached_property
    def reference(self) -> tuple[Array, Array]:
        """Points [M, 3] of the surface that images see, uniform by area, and the number of images [M]."""
        assert self.flight.reference is not None
        points, kept = read_cloud(self.flight.reference).points, self.folder / "views.npy"
        if not kept.is_file():
            np.save(kept, self.surface.count_views(points, *self.cameras))
        views = np.load(kept)
        return points[views > 0], views[views > 0]

    def exact_cloud(self) -> Cloud:
        """What the images see, from their true depth: one point per ground pixel."""
        parts = []
        for camera, pose in zip(*self.cameras, strict=True):
            depth = self.surface.renderer.depth(camera, pose)
            parts.append(unproject(pixel_grid(camera.width, camera.height)[depth > 0], depth[depth > 0], camera, pose))
        points = np.concatenate(parts)
        return Cloud(points[voxel_thin(points, self.altitude / self.cameras[0][0].fx)])

    def map_cloud(self, folder: Path) -> Cloud:
        """The cloud of a map in the cameras' frame."""
        cloud = read_cloud(folder / "cloud.laz")
        if cloud.epsg is None:
            return cloud
        assert self.flight.origin is not None
        return cloud.with_points(enu_from_crs(cloud.points, self.flight.origin, cloud.epsg))


def run_map(case: Case, folder: Path, dense: str, network: str | None) -> dict[str, Any]:
    """Map a flight in a process of its own, on one thread, and return what it took.

    Raises:
        RuntimeError: the map failed.
    """
    command = [sys.executable, "-m", "overfly.cli", "map", str(case.flight.root), "--out", str(folder)]
    command += ["--cameras", "given", "--dense", dense]
    command += ["--network", network] if network and dense == "sweep" else []
    folder.mkdir(parents=True, exist_ok=True)
    start, peak_kb = time.perf_counter(), 0
    with (case.folder / f"{folder.name}.log").open("w") as log:
        child = subprocess.Popen(command, stdout=log, stderr=log, env=os.environ | {"OMP_NUM_THREADS": "1"})
        while not (ended := os.wait4(child.pid, os.WNOHANG))[0]:
            # The peak that wait4 tells includes this process's own size when it started the child.
            held = re.search(r"VmHWM:\s*(\d+)", Path(f"/proc/{child.pid}/status").read_text())
            peak_kb = int(held[1]) if held else peak_kb
            time.sleep(0.2)
    _, status, usage = ended
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        shutil.rmtree(folder)
        raise RuntimeError((case.folder / f"{folder.name}.log").read_text().strip().splitlines()[-1])
    facts = json.loads((folder / "map.json").read_text())
    return {
        "core_seconds": usage.ru_utime + usage.ru_stime,
        "seconds": time.perf_counter() - start,
        "dense_seconds": facts["seconds"]["dense"],
        "peak_mb": peak_kb / 1024,
        "network": facts["settings"]["network"],
    }


def measure(case: Case, cloud: Cloud) -> dict[str, Any]:
    """All figures of a cloud in the cameras' frame; lengths in metres, the rest shares."""
    thin = cloud[voxel_thin(cloud.points, VOXEL_M)]
    near = case.surface.nearest(thin.points)
    views = case.surface.count_views(near.place, *case.cameras)
    reference, seen_by = case.reference
    missing = cKDTree(thin.points).query(reference, distance_upper_bound=1.01 * max(THRESHOLDS_M))[0]
    found: dict[str, Any] = {"points": len(cloud)}
    for t in THRESHOLDS_M:
        precision, recall = float((near.distance < t).mean()), float((missing < t).mean())
        found |= {f"fscore_{t:g}": harmonic(precision, recall), f"precision_{t:g}": precision, f"recall_{t:g}": recall}
    for label, mask in (("1", seen_by == 1), ("2", seen_by == 2), ("3", seen_by >= 3)):
        found[f"seen_{label}"] = float(mask.mean())
        found[f"recall_1_seen_{label}"] = share(missing < 1, mask)
    for label, mask in (("", views >= 2), ("_seen_1", views == 1)):
        errors = near.distance[mask]
        found[f"error_median{label}"] = float(np.median(errors)) if len(errors) else None
        found[f"error_p90{label}"] = float(np.quantile(errors, 0.9)) if len(errors) else None
    if thin.predicted is not None and thin.sigma_m is not None:
        found["predicted"] = float(thin.predicted.mean())
        for label, mask in (("", ~thin.predicted), ("_predicted", thin.predicted)):
            level = mask & (near.upward > STEEP)
            for k in (1, 2):
                found[f"within_{k}_sigma{label}"] = share(near.rise < k * thin.sigma_m, level)
    return found


def share(true: np.ndarray, among: np.ndarray) -> float | None:
    """The part of ``among`` where ``true`` holds; None of nothing."""
    return float(true[among].mean()) if among.any() else None


def figures(case: Case, method: str, options: argparse.Namespace) -> dict[str, Any]:
    """The figures of one method on one flight: kept, or made."""
    labelled = f"{method}-{options.label}" if options.label and method == "sweep" else method
    folder, kept = case.folder / labelled, case.folder / f"{labelled}.json"
    if method in options.again:
        shutil.rmtree(folder, ignore_errors=True)
    cost, fresh = folder / "cost.json", method in options.again or options.measure
    if kept.is_file() and not fresh:
        return json.loads(kept.read_text())
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
                row[key] = float(np.mean(values))
        found.append(row)
    return found


def table(rows: list[dict[str, Any]]) -> str:
    """The main figures as markdown, a line for each flight and method."""

    def text(row: dict[str, Any], *keys: str, digits: int = 2) -> str:
        return " / ".join("-" if row.get(k) is None else f"{row[k]:.{digits}f}" for k in keys)

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
    parser.add_argument("--cells", nargs="+", choices=CELLS, default=list(CELLS), help="paths and overlaps")
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
