"""From photographs to a cloud, beside the rivals: whole rendered flights with GPS that is wrong by 2 m.

    python benchmarks/rivals.py --work outputs/rivals [--scenes suburb vegetation FILE.laz] [--ppg ENV/bin/ppg]

    sweep, stereo    ``overfly map --cameras estimate`` with every product
    pycolmap         pycolmap's defaults, then OpenCV's semi-global matcher (``truth/stock.py``), cloud only
    pycolmap_held    the same, focal length held at EXIF's, no lens distortion
    ppg              pyarchinit-photogrammetry's command in an environment of its own, all defaults, cloud only

Every cloud is laid upon the true surface by the best similarity of its measured points, since GPS leaves the whole
block metres off (from where that of its cameras puts it, where they are known), and measured as in
``benchmarks/flights.py``. ``camera_px`` is how far the placed cameras see points of the ground from where the true ones
do, median, after the best similarity of all cameras at once. Core-seconds are of all threads.
Finished flights, clouds and figures in --work are kept. Writes rivals.csv, rivals.md and rivals.png.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from truth.case import CELLS, Case, measure, text
from truth.cost import run_measured
from truth.stock import cameras_of

from overfly.cloud import Cloud, read_cloud
from overfly.flights.noise import PoseNoise
from overfly.flights.transforms import read_transforms
from overfly.geodesy import enu_from_crs
from overfly.geometry import Array, Camera, fit_similarity, project, transform
from overfly.metrics.alignment import align
from overfly.tables import markdown, write_rows

GPS_2M = PoseNoise(horizontal_m=2.0, bias_horizontal_m=0.0, yaw_deg=1.0, tilt_deg=0.3, bias_yaw_deg=2.0)
METHODS = ("sweep", "stereo", "pycolmap", "pycolmap_held", "ppg")
SHOWN = {"fscore_1": "F-score at 1 m", "recall_1_interior": "recall at 1 m, interior", "core_seconds": "core-seconds"}
STOCK = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); from truth.stock import main; main()"
LOST_PX = 1000.0
"""Error of a point that comes to lie behind a camera."""

Cameras = dict[str, tuple[Camera, Array]]


def commands(method: str, case: Case, out: Path, ppg: str | None) -> list[list[str]]:
    """What a user of the method types, line by line."""
    flight = case.flight.root
    if method in ("sweep", "stereo"):
        own = [sys.executable, "-m", "overfly.cli", "map", str(flight), "--out", str(out)]
        return [[*own, "--cameras", "estimate", "--dense", method]]
    if method.startswith("pycolmap"):
        stock = [sys.executable, "-c", STOCK, str(flight), str(out), *(["held"] if method.endswith("held") else [])]
        return [stock]
    assert ppg is not None
    project = str(out / "flight.ppg")
    steps = [["new", project], ["add-photos", project, str(flight / "images")], ["align", project], ["dense", project]]
    return [[ppg, *step] for step in [*steps, ["export", project, "--cloud", str(out / "cloud.laz")]]]


def run(method: str, case: Case, out: Path, ppg: str | None) -> dict[str, Any]:
    """Make the cloud and return what it took.

    Raises:
        RuntimeError: a command failed.
    """
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    log, costs = case.folder / f"{method}.log", []
    log.unlink(missing_ok=True)
    for command in commands(method, case, out, ppg):
        costs.append(run_measured(command, log, append=True))
    return {
        "core_seconds": sum(c["core_seconds"] for c in costs),
        "seconds": sum(c["seconds"] for c in costs),
        "peak_mb": max(c["peak_mb"] for c in costs),
    }


def local_cloud(case: Case, path: Path) -> Cloud:
    """A cloud file in the flight's local frame, its strays beyond the surroundings left out."""
    cloud, origin = read_cloud(path), case.flight.origin
    assert origin is not None
    if cloud.epsg is not None:
        cloud = cloud.with_points(enu_from_crs(cloud.points, origin, cloud.epsg, cloud.vertical_epsg))
    # An alignment by heights lays a raster over all points: one that is 100 km away costs more than it tells.
    middle = np.median(cloud.points, axis=0)
    return cloud[np.linalg.norm(cloud.points - middle, axis=1) < 20 * case.altitude]


def found_cameras(method: str, out: Path) -> Cameras:
    """The cameras that a method found, by file name; none of a rival that keeps them in a format of its own."""
    if method in ("sweep", "stereo"):
        found = read_transforms(out / "transforms.json")
        return {Path(name).name: (found.cameras[name], found.poses[name]) for name in found.poses}
    if method.startswith("pycolmap"):
        return cameras_of(pycolmap.Reconstruction(str(out / "model")))
    return {}


def beside_true(case: Case, found: Cameras) -> tuple[float, Array] | None:
    """How far, in pixels, the found cameras see ground points from where the true ones do, median, and the similarity
    [4, 4] from the true ones' frame to theirs at which that is so; None of under three cameras."""
    true = {
        f.path.name: (f.camera, np.asarray(f.world_from_camera)) for f in case.flight.frames if f.path.name in found
    }
    if len(true) < 3:
        return None
    points, seen = case.reference[0][:: max(1, len(case.reference[0]) // 2000)], []
    for name, (camera, pose) in true.items():
        assert camera is not None
        pixels, depth = project(points, camera, pose)
        inside = (depth > 0) & ((pixels > 0) & (pixels < [camera.width, camera.height])).all(1)
        seen.append((name, points[inside][:60], pixels[inside][:60]))
    centres = [np.array([pose[:3, 3] for _, pose in (cameras[n] for n in true)]) for cameras in (true, found)]
    start = fit_similarity(*centres)

    def moved(x: Array) -> Array:
        step = np.eye(4)
        step[:3, :3] = np.exp(x[6]) * Rotation.from_rotvec(x[:3]).as_matrix()
        step[:3, 3] = x[3:6]
        return start @ step

    def misses(x: Array) -> Array:
        matrix = moved(x)
        misses = np.concatenate([project(transform(matrix, p), *found[n])[0] - pixels for n, p, pixels in seen])
        return np.nan_to_num(misses, nan=LOST_PX)

    best = least_squares(
        lambda x: misses(x).ravel(), np.zeros(7), x_scale=[1e-3] * 3 + [1.0] * 3 + [1e-3], loss="soft_l1"
    )
    return float(np.median(np.linalg.norm(misses(best.x), axis=1))), moved(best.x)


def figures(method: str, case: Case, ppg: str | None, *, anew: bool) -> dict[str, Any]:
    """A method's figures on one flight: kept, or made. A method that fails has its last words instead."""
    out, kept = case.folder / method, case.folder / f"{method}.json"
    if kept.is_file() and not anew:
        return dict(json.loads(kept.read_text()))
    row: dict[str, Any] = {"flight": case.name, "method": method, "images": len(case.flight)}
    try:
        if not (out / "cost.json").is_file():
            (out / "cost.json").write_text(json.dumps(run(method, case, out, ppg)))
        row |= json.loads((out / "cost.json").read_text())
        cloud, cameras = local_cloud(case, out / "cloud.laz"), found_cameras(method, out)
        beside = beside_true(case, cameras)
        if beside is not None:  # a block that GPS has tilted is too far off for points to find their places
            cloud = cloud.with_points(transform(np.linalg.inv(beside[1]), cloud.points))
        measured = cloud if cloud.predicted is None else cloud[~cloud.predicted]
        # Strays spread out: thinned by voxels, as the search does, a hundredth of them would be most of the points.
        low, high = (f(case.reference[0], axis=0) for f in (np.min, np.max))
        near = ((measured.points > low - case.altitude / 3) & (measured.points < high + case.altitude / 3)).all(1)
        matrix, _ = align(measured.points[near if near.any() else slice(None)], case.reference[0], "similarity")
        row |= measure(case, cloud.with_points(transform(matrix, cloud.points)))
        row |= {"placed": len(cameras) or None, "camera_px": None if beside is None else beside[0]}
    except RuntimeError as error:
        row["failed"] = str(error)
    kept.write_text(json.dumps(row, indent=2) + "\n")
    return row


def table(rows: list[dict[str, Any]]) -> str:
    """The main figures as markdown, a line for each flight and method."""

    lines = [
        {
            "flight": row["flight"],
            "method": row["method"],
            "placed": text(row, "placed", digits=0),
            "cameras, px": text(row, "camera_px"),
            "F-score at 0.25 / 0.5 / 1 / 2 m": row.get("failed")
            or text(row, *(f"fscore_{t}" for t in (0.25, 0.5, 1, 2))),
            "precision / recall at 1 m": text(row, "precision_1", "recall_1"),
            "interior, recall at 1 / 2 m": text(row, "recall_1_interior", "recall_2_interior"),
            "without walls": text(row, "recall_1_interior_level", "recall_2_interior_level"),
            "error, median / p90, m": text(row, "error_median", "error_p90"),
            "core-seconds": text(row, "core_seconds", digits=0),
            "peak MB": text(row, "peak_mb", digits=0),
        }
        for row in rows
    ]
    return markdown(lines)


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Bars of each method on each flight, a panel for each figure of ``SHOWN``."""
    from matplotlib.figure import Figure

    flights = list(dict.fromkeys(row["flight"] for row in rows))
    methods = [m for m in METHODS if any(row["method"] == m for row in rows)]
    figure = Figure(figsize=(11, 3 * len(SHOWN)), layout="constrained")
    for axes, (key, title) in zip(figure.subplots(len(SHOWN), 1, sharex=True), SHOWN.items(), strict=True):
        for k, method in enumerate(methods):
            value = {row["flight"]: row.get(key) or 0.0 for row in rows if row["method"] == method}
            places = np.arange(len(flights)) + (k - (len(methods) - 1) / 2) * 0.8 / len(methods)
            axes.bar(places, [value.get(f, 0.0) for f in flights], 0.8 / len(methods), label=method)
        axes.set_ylabel(title)
        axes.set_xticks(range(len(flights)), [f.replace("_", "\n") for f in flights], fontsize=7)
    figure.axes[0].legend(ncols=len(methods), fontsize=8)
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("outputs/rivals"))
    parser.add_argument("--scenes", nargs="+", default=["suburb", "vegetation"], help="styles or scene files")
    parser.add_argument("--cells", nargs="+", choices=CELLS, default=["grid-30", "grid-50", "grid-80"])
    parser.add_argument("--altitudes", nargs="+", type=float, default=[150.0], help="metres")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS[:-1])
    parser.add_argument("--ppg", help="the command of pyarchinit-photogrammetry, for the method ppg")
    parser.add_argument("--measure", action="store_true", help="measure anew what is there")
    options = parser.parse_args()
    if "ppg" in options.methods and not options.ppg:
        parser.error("the method ppg needs --ppg ENV/bin/ppg")
    rows = []
    for scene in options.scenes:
        for altitude in options.altitudes:
            for cell in options.cells:
                case = Case(scene, cell, altitude, options.work, GPS_2M)
                for method in options.methods:
                    rows.append(figures(method, case, options.ppg, anew=options.measure))
                    print(table(rows[-1:]), file=sys.stderr, flush=True)
    write_rows(options.work / "rivals.csv", rows)
    (options.work / "rivals.md").write_text(table(rows))
    draw(rows, options.work / "rivals.png")
    print(table(rows))


if __name__ == "__main__":
    main()
