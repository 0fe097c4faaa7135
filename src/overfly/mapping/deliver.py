"""The products of a map: cloud, rasters, cameras, report and ``map.json``, each complete or absent."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from overfly import __version__
from overfly.cloud import Cloud, write_cloud
from overfly.errors import InputError
from overfly.files import replacing
from overfly.flights import Flight, write_transforms
from overfly.geometry import crs_from_enu
from overfly.mapping.block import Block
from overfly.mapping.cautions import cautions
from overfly.mapping.facts import cloud_facts, ground_sampling, heights_above_ground
from overfly.mapping.gallery import gallery
from overfly.mapping.products import raster_products
from overfly.mapping.report import duration, write_report
from overfly.mapping.settings import MapSettings
from overfly.mapping.steps import Steps, peak_memory_mb


def deliver(flight: Flight, block: Block, local: Cloud, out: Path, asked: MapSettings, steps: Steps) -> dict[str, Any]:
    """Write every product of a finished cloud into ``out`` and return the content of ``map.json``.

    Args:
        flight: as it was read.
        block: the cameras used.
        local: the cloud in the block's frame.
        out: folder of the results.
        asked: the settings.
        steps: timing and messages.

    Raises:
        InputError: the cloud is empty, or its extent fits no raster.
    """
    if len(local) == 0:
        raise InputError("No point could be measured: the images overlap too little or show too little texture.")
    gsd = ground_sampling(local, block.cameras, block.poses)
    epsg = None
    placed = local
    if block.origin is not None and block.metric:
        epsg = block.origin.crs_epsg
        placed = local.with_points(crs_from_enu(local.points, block.origin), epsg)
    with steps.timed("products"):
        written = ["cloud.laz", *(["cloud.ply"] if asked.ply else [])]
        for name in written:
            write_cloud(placed, out / name)
        facts = {} if block.metric else {"scale": "unknown"}
        write_transforms(out / "transforms.json", block.frames, block.origin, facts)
        raster_products(placed, out, gsd=gsd)
        written += ["dsm.tif", "orthophoto.tif", "transforms.json", "map.json"]
    steps.say("products", ", ".join(written[:-1]))
    with steps.timed("report"):
        lost = [f for f in flight.frames if f.name not in set(block.names)]
        told = block.gps_positions(lost)
        shown, seen = gallery(
            local,
            block.cameras,
            block.poses,
            block.names,
            gsd=gsd,
            unit="m" if block.metric else "units",
            height_offset=float(np.median(placed.points[:, 2] - local.points[:, 2])),
            missing=[(name, position) for name, position in told.items()],
        )
    counted = cloud_facts(placed, seen, gsd)
    summary: dict[str, Any] = {
        "images": len(flight) + len(flight.skipped),
        "registered": len(block.frames),
        "points": counted["points"],
        "measured": counted["measured"],
        "predicted": counted["predicted"],
        "gsd_m": round(gsd, 5) if block.metric else None,
        "crs": None if epsg is None else f"EPSG:{epsg}",
        "cameras_from": block.cameras_from,
        "seconds": steps.seconds,
        "peak_memory_mb": round(peak_memory_mb(), 1),
        "warnings": [],
        "metric": block.metric,
        "reprojection_px": block.reprojection_px,
        "gps_rms": block.gps_rms(),
        "unregistered": [f.name for f in lost],
        "skipped": dict(flight.skipped),
        **{k: counted[k] for k in ("area", "points_per_area", "height_range", "median_sigma", "seen_once_share")},
        "reused": steps.reused,
        "settings": asked.shown(),
        "version": __version__,
    }
    altitudes = {}
    if block.metric:
        above = heights_above_ground(seen, block.poses)
        altitudes = {f.name: (float(h), f.relative_altitude) for f, h in zip(block.frames, above, strict=True)}
    found = cautions(
        summary,
        altitudes=altitudes,
        has_gps=any(f.gps is not None for f in flight.frames),
        from_readers=[*flight.warnings, *block.warnings],
    )
    summary["warnings"] = [str(c).strip() for c in found]
    with steps.timed("report"):
        write_report(
            out / "report.html",
            title=flight.root.resolve().name,
            summary=summary,
            pictures=shown,
            cautions=found,
            settings=asked.shown(),
            written=written,
        )
    with replacing(out / "map.json") as temporary:
        temporary.write_text(json.dumps(summary, indent=2, allow_nan=False) + "\n")
    for line in summary["warnings"]:
        steps.say("warning", line)
    steps.say("done", f"{out / 'report.html'} after {duration(sum(steps.seconds.values()))}")
    return summary
