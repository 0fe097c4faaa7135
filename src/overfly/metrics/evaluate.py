"""`overfly evaluate`: a cloud file against a reference file, in every convention at once.

What is done, in this order, and recorded in the result:

0. bring a cloud of a flight folder, which is in a local frame, to the CRS of the other (``warnings`` says so);
1. align, only if asked, with all points (``aligned``, ``transform``: reference-from-cloud);
2. thin both clouds to one point per voxel (``voxel_m``), so that dense spots do not count more than others;
3. clip the cloud to the neighbourhood of the reference in plan (``clip_m``), because where the reference has nothing it
   cannot judge; the reference is never clipped: what the cloud lacks counts as missing;
4. measure. The two metrics over 1024 points take random subsets that depend on ``seed`` alone; what two disjoint
   subsets of the reference itself are apart stands beside them (``emd_floor_m``, ``chamfer_sum_1024_floor``; None where
   it has too few points for two).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from overfly.cloud import Cloud, read_cloud, voxel_thin
from overfly.errors import InputError, unknown
from overfly.geodesy import Origin, crs_from_enu
from overfly.metrics import alignment
from overfly.metrics.functional import (
    GSD_MULTIPLES,
    PAPER_POINTS,
    PARALLEL_FROM,
    THRESHOLDS_M,
    Distances,
    chamfer_sum,
    distances,
    emd_sum,
    gsd_thresholds,
    subset,
)

if TYPE_CHECKING:
    from rich.table import Table

CLIP_M = 1.0
CLIP_SPACINGS = 3.0


def evaluate(
    cloud: Path | str | Cloud,
    reference: Path | str | Cloud,
    *,
    align: str = "none",
    thresholds_m: Sequence[float] = THRESHOLDS_M,
    gsd_m: float | None = None,
    voxel_m: float = 0.1,
    clip_m: float | None = None,
    seed: int = 0,
) -> dict[str, Any]:
    """Compare a cloud with a reference.

    Args:
        cloud, reference: files (.ply, .las, .laz) or clouds.
        align: "none", "shift", "rigid" or "similarity".
        thresholds_m: of F-score, precision and recall.
        gsd_m: ground sampling distance; adds F-scores at multiples of it (``fscore_gsd``).
        voxel_m: edge of the voxels of step 2; 0 keeps every point.
        clip_m: distance of step 3; None takes 1 m, or 3 times the median spacing of a sparser reference; inf clips
            nothing.
        seed: of the random subsets.

    Returns:
        Plain numbers, ready for JSON; lengths in metres. ``warnings`` lists what a reader should know.

    Raises:
        InputError: a file is missing, broken, empty or not finite; the clouds are in different CRS or nowhere near each
            other; an option is out of its range.
    """
    _check_options(align, thresholds_m, voxel_m, clip_m)
    if gsd_m is not None:
        gsd_thresholds(gsd_m)
    given = cloud if isinstance(cloud, Cloud) else read_cloud(cloud)
    wanted = reference if isinstance(reference, Cloud) else read_cloud(reference)
    given, wanted, placed = _placed(given, cloud, wanted, reference)
    warnings = placed + _check_frames(given, wanted, align)
    matrix, points = alignment.align(given.points, wanted.points, align)
    target = wanted.points
    if voxel_m:
        points, target = points[voxel_thin(points, voxel_m)], target[voxel_thin(target, voxel_m)]
    clip = _clip_distance(target) if clip_m is None else clip_m
    near = _near_in_plan(points, target, clip)
    if not near.any():
        raise InputError(
            f"No point of the cloud lies within {clip:g} m in plan of the reference: check that both are in the same "
            "frame, or add --align shift."
        )
    thinned = len(points)
    points = points[near]
    result = _measure(points, target, distances(points, target), thresholds_m, gsd_m, seed)
    apart = _spacing(wanted.points)
    if apart > min(thresholds_m):
        warnings.append(
            f"Points of the reference lie {apart:.2f} m apart (median): accuracy, and precision and F-scores at "
            "smaller distances, are those of its sampling. Give a denser reference."
        )
    return result | {
        "points": len(given),
        "reference_points": len(wanted),
        "compared_points": len(points),
        "compared_reference_points": len(target),
        "clipped_share": 1 - len(points) / thinned,
        "aligned": align,
        "transform": matrix.tolist(),
        "voxel_m": float(voxel_m),
        "clip_m": float(clip) if np.isfinite(clip) else None,
        "seed": seed,
        "epsg": wanted.epsg,
        "vertical_epsg": wanted.vertical_epsg,
        "warnings": warnings,
    }


def _measure(
    points: NDArray,
    target: NDArray,
    found: Distances,
    thresholds_m: Sequence[float],
    gsd_m: float | None,
    seed: int,
) -> dict[str, Any]:
    n = min(PAPER_POINTS, len(points), len(target))
    few, few_target = subset(points, n, seed, 0), subset(target, n, seed, 1)
    halves = np.random.default_rng([seed, 2]).permutation(len(target))[: 2 * n] if len(target) >= 2 * n else None
    emd = emd_sum(few, few_target) / n
    result = {
        "chamfer_m2": found.chamfer_m2,
        "chamfer_m": found.chamfer_m,
        # Sums of fewer points are scaled up, so that the numbers stay comparable.
        "chamfer_sum_1024": chamfer_sum(few, few_target) * PAPER_POINTS / n,
        "emd_sum_1024": emd * PAPER_POINTS,
        "emd_m": emd,
        "emd_floor_m": None if halves is None else emd_sum(target[halves[:n]], target[halves[n:]]) / n,
        "chamfer_sum_1024_floor": None
        if halves is None
        else chamfer_sum(target[halves[:n]], target[halves[n:]]) * PAPER_POINTS / n,
        "fscore": {str(float(t)): found.fscore(t) for t in thresholds_m},
        "precision": {str(float(t)): found.precision(t) for t in thresholds_m},
        "recall": {str(float(t)): found.recall(t) for t in thresholds_m},
        "accuracy_median_m": found.accuracy_m(0.5),
        "accuracy_p90_m": found.accuracy_m(0.9),
        "completeness_median_m": found.completeness_m(0.5),
        "completeness_p90_m": found.completeness_m(0.9),
        "completeness_1m": found.recall(1.0),
        "hausdorff_m": found.hausdorff_m,
        "subset_points": n,
    }
    if gsd_m is not None:
        limits = gsd_thresholds(gsd_m, GSD_MULTIPLES)
        result["gsd_m"] = gsd_m
        result["fscore_gsd"] = {str(multiple): found.fscore(limit) for multiple, limit in limits.items()}
    return result


def _check_options(mode: str, thresholds_m: Sequence[float], voxel_m: float, clip_m: float | None) -> None:
    if mode not in alignment.MODES:
        raise unknown("The alignment", mode, alignment.MODES)
    if not thresholds_m or not all(0 < t < np.inf for t in thresholds_m):
        raise InputError(f"The thresholds {list(thresholds_m)} are not all lengths: give metres above 0.")
    if not 0 <= voxel_m < np.inf:
        raise InputError(f"The voxel size {voxel_m} is not a length: give metres above 0, or 0 to keep every point.")
    if clip_m is not None and not clip_m > 0:
        raise InputError(f"The clip distance {clip_m} is not a length: give metres above 0.")


def _placed(
    cloud: Cloud, cloud_file: Path | str | Cloud, reference: Cloud, reference_file: Path | str | Cloud
) -> tuple[Cloud, Cloud, list[str]]:
    """A cloud of a flight folder (local ENU) in the other's CRS, by the origin that its transforms.json states."""
    said: list[str] = []
    if cloud.epsg and not reference.epsg and (origin := _origin_beside(reference_file, cloud)):
        reference = reference.with_points(crs_from_enu(reference.points, origin), cloud.epsg, cloud.vertical_epsg)
        said = [f"The reference was brought from its flight's local frame to {cloud.crs}."]
    elif reference.epsg and not cloud.epsg and (origin := _origin_beside(cloud_file, reference)):
        cloud = cloud.with_points(crs_from_enu(cloud.points, origin), reference.epsg, reference.vertical_epsg)
        said = [f"The cloud was brought from its flight's local frame to {reference.crs}."]
    return cloud, reference, said


def _origin_beside(file: Path | str | Cloud, other: Cloud) -> Origin | None:
    """The origin in the transforms.json that lies beside a file, with the other's CRS to go to; None without one."""
    if isinstance(file, Cloud) or not (transforms := Path(file).parent / "transforms.json").is_file():
        return None
    stated = json.loads(transforms.read_text()).get("overfly", {}).get("origin")
    if not stated:
        return None
    return Origin(stated["latitude"], stated["longitude"], stated.get("height") or 0.0, other.epsg, other.vertical_epsg)


def _check_frames(cloud: Cloud, reference: Cloud, mode: str) -> list[str]:
    """Refuse clouds that cannot be in one frame; say what was taken for granted."""
    if cloud.crs == reference.crs:
        return []
    if cloud.epsg == reference.epsg and None in (cloud.vertical_epsg, reference.vertical_epsg) and mode == "none":
        return [
            f"The cloud is in {cloud.crs}, the reference in {reference.crs}: heights over ellipsoid and sea differ by "
            "up to 100 m; give both the same vertical CRS (overfly map --heights), or add --align shift."
        ]
    if cloud.epsg and reference.epsg and not (cloud.epsg == reference.epsg and mode != "none"):
        raise InputError(
            f"The cloud is in {cloud.crs}, the reference in {reference.crs}: reproject one of them, "
            "they can only be compared in the same CRS."
        )
    local, other, crs = ("cloud", "reference", reference.crs)
    if cloud.epsg and reference.epsg:
        return [f"The cloud is in {cloud.crs}, the reference in {crs}; they were laid upon each other by {mode}."]
    if cloud.epsg:
        local, other, crs = ("reference", "cloud", cloud.crs)
    if mode != "none":
        return [f"The {local} has no CRS, the {other} is in {crs}; they were laid upon each other by {mode}."]
    a, b = cloud.points[:, :2], reference.points[:, :2]
    if (a.min(0) <= b.max(0)).all() and (a.max(0) >= b.min(0)).all():
        return [f"The {local} names no CRS; it was taken to be in that of the {other}, {crs}, where it lies."]
    raise InputError(
        f"The {local} has no CRS and does not lie where the {other} does ({crs}): give both in one frame, "
        "or add --align shift, rigid or similarity."
    )


def _clip_distance(target: NDArray) -> float:
    """1 m, or 3 times the median spacing in plan of a sparser reference."""
    if len(target) < 2:
        return CLIP_M
    some = target[:: max(1, len(target) // 5000), :2]
    nearest = np.asarray(cKDTree(target[:, :2]).query(some, k=2)[0])[:, 1]
    return max(CLIP_M, CLIP_SPACINGS * float(np.median(nearest)))


def _spacing(target: NDArray) -> float:
    """Median distance of points [n, 3] to their nearest neighbours, metres; 0 of a single one."""
    if len(target) < 2:
        return 0.0
    some = target[:: max(1, len(target) // 5000)]
    return float(np.median(np.asarray(cKDTree(target).query(some, k=2)[0])[:, 1]))


def _near_in_plan(points: NDArray, target: NDArray, clip_m: float) -> NDArray[np.bool_]:
    if not np.isfinite(clip_m):
        return np.ones(len(points), bool)
    # Thinning the plan first changes the limit by at most 2 % and the search's time tenfold.
    plan = np.column_stack([target[:, :2], np.zeros(len(target))])
    plan = plan[voxel_thin(plan, clip_m / 100)]
    workers = -1 if len(points) > PARALLEL_FROM else 1
    return np.isfinite(cKDTree(plan[:, :2]).query(points[:, :2], distance_upper_bound=clip_m, workers=workers)[0])


def format_table(result: dict[str, Any]) -> Table:
    """The result for the terminal, to be printed by rich."""
    from rich.table import Table

    table = Table(title=f"cloud against reference, alignment: {result['aligned']}", title_justify="left")
    table.add_column("metric")
    table.add_column("value", justify="right")
    emd, total = result["emd_floor_m"], result["chamfer_sum_1024_floor"]
    two = "two samples of the reference"
    emd_text, total_text = ("", "") if emd is None else (f" ({two}: {emd:.3f})", f" ({two}: {total:.0f})")
    for label, key, unit in (
        ("Chamfer, mean squared, both ways", "chamfer_m2", "m²"),
        ("Chamfer, mean, both ways", "chamfer_m", "m"),
        (f"Chamfer, paper's sum over 1024{total_text}", "chamfer_sum_1024", "m²"),
        (f"EMD, mean over 1024{emd_text}", "emd_m", "m"),
        ("EMD, paper's sum over 1024", "emd_sum_1024", "m"),
        ("accuracy, median", "accuracy_median_m", "m"),
        ("accuracy, 90 %", "accuracy_p90_m", "m"),
        ("completeness, median", "completeness_median_m", "m"),
        ("Hausdorff", "hausdorff_m", "m"),
    ):
        table.add_row(label, f"{result[key]:.3f} {unit}")
    for threshold, value in result["fscore"].items():
        shares = f"(precision {result['precision'][threshold]:.3f}, recall {result['recall'][threshold]:.3f})"
        table.add_row(f"F-score at {threshold} m {shares}", f"{value:.3f}")
    for multiple, value in result.get("fscore_gsd", {}).items():
        table.add_row(f"F-score at {multiple} x GSD ({float(multiple) * result['gsd_m']:.3f} m)", f"{value:.3f}")
    shift = np.array(result["transform"])[:3, 3]
    if result["aligned"] == "shift":
        table.add_row("shift x, y, z", " ".join(f"{v:+.3f}" for v in shift) + " m")
    if result["aligned"] == "similarity":
        table.add_row("scale", f"{np.cbrt(np.linalg.det(np.array(result['transform'])[:3, :3])):.5f}")
    clip = "nothing clipped" if result["clip_m"] is None else f"clipped to {result['clip_m']:g} m in plan"
    table.caption = (
        f"{result['compared_points']} of {result['points']} points against {result['compared_reference_points']} of "
        f"{result['reference_points']}; voxels {result['voxel_m']:g} m, {clip}"
    )
    return table
