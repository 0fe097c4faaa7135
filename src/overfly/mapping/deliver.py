"""The products of a map: cloud, rasters, cameras, report and ``map.json``, each complete or absent."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from overfly import __version__
from overfly.cloud import Cloud, write_clouds
from overfly.errors import InputError
from overfly.files import replacing
from overfly.flights import Flight, Frame, write_transforms
from overfly.geodesy import crs_from_enu
from overfly.geometry import transform
from overfly.mapping.block import Block
from overfly.mapping.block_marks import marks_of
from overfly.mapping.cautions import cautions
from overfly.mapping.facts import cloud_facts, ground_sampling, heights_above_ground
from overfly.mapping.gains import Gains
from overfly.mapping.gallery import gallery, photo_overview, upright
from overfly.mapping.heights import heights_of
from overfly.mapping.orthophoto import Orthophoto
from overfly.mapping.products import SAMPLE, WINDOW, raster_products
from overfly.mapping.raster import Grid, Surface
from overfly.mapping.report import Caution, count_text, duration, write_report
from overfly.mapping.rough_mesh import filled_share, rough_mesh, without_spikes
from overfly.mapping.settings import MESH_FACES, MapSettings
from overfly.mapping.steps import Steps, peak_memory_mb
from overfly.mapping.tiles import Tiles
from overfly.mapping.visibility import View

LEVEL = 0.5
"""Cosine of the largest angle between up, as the cameras tell it, and the frame's z axis."""


def deliver(
    flight: Flight,
    block: Block,
    local: Tiles,
    out: Path,
    asked: MapSettings,
    steps: Steps,
    *,
    window: int = WINDOW,
    sample: int = SAMPLE,
) -> dict[str, Any]:
    """Write every product of a finished cloud into ``out`` and return the content of ``map.json``.

    Args:
        flight: as it was read.
        block: the cameras used.
        local: the cloud in the block's frame.
        out: folder of the results.
        asked: the settings.
        steps: timing and messages.
        window: cells of the rasters that are computed at once, each way.
        sample: points that tell figures and make pictures; all of a small flight.

    Raises:
        InputError: the cloud is empty, or its extent fits no raster.
    """
    if len(local) == 0:
        raise InputError("No point could be measured: the images overlap too little or show too little texture.")
    few = local.sample(sample)
    gsd = ground_sampling(few, block.cameras, block.poses)
    placed, few_placed = local.moved(partial(georeferenced, block=block)), georeferenced(few, block)
    turn = upright(block.poses)
    level = bool(turn[2, 2] > LEVEL)
    turn = np.eye(4) if level else turn
    written = ["cloud.laz", *(["cloud.ply"] if asked.ply else [])]
    sources = None
    with steps.timed("products"):
        # What an earlier map left may have other heights, and is not written each time.
        for name in ("cloud.ply", "dsm.tif", "dsm_source.tif", "orthophoto.tif", "mesh.glb"):
            (out / name).unlink(missing_ok=True)
        for name in written:
            write_clouds(placed, out / name, count=len(placed), low=placed.bounds.min((0, 1)))
        facts = {} if block.metric else {"scale": "unknown"}
        write_transforms(out / "transforms.json", block.frames, block.origin, facts)
        if level:
            views, gains, sources = _rasters(placed, block, few_placed.epsg, out, gsd=gsd, window=window, sample=sample)
            written += ["dsm.tif", "dsm_source.tif", "orthophoto.tif"]
        written += ["transforms.json", "map.json"]
    steps.say("products", ", ".join(written[:-1]))
    mesh, unmade = None, list[Caution]()
    if asked.mesh and level:
        with steps.timed("mesh"):
            mesh, unmade = _mesh(few, block, views, gains, out / "mesh.glb", asked, steps)
        written += ["mesh.glb"] if mesh else []
    with steps.timed("report"):
        shown, seen = gallery(
            few.with_points(transform(turn, few.points)),
            block.cameras,
            turn @ block.poses,
            block.names,
            gsd=gsd,
            unit="m" if block.metric else "units",
            height_offset=float(np.median(few_placed.points[:, 2] - few.points[:, 2])),
            missing=list(block.gps_positions(lost_frames(flight, block)).items()),
            marks=marks_of(block) if level and block.cameras_from == "estimated" else None,
            photo=photo_overview(out / "orthophoto.tif") if level else None,
        )
    summary = summarise(flight, block, cloud_facts(placed, few_placed, seen, gsd), few_placed.crs, asked, steps)
    summary |= {"surface": sources, "mesh": mesh}
    found = [*_cautions(flight, block, seen, summary, level), *unmade]
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


def _rasters(
    placed: Tiles, block: Block, epsg: int | None, out: Path, *, gsd: float, window: int, sample: int
) -> tuple[list[View], Gains, dict[str, float]]:
    """Write the rasters; the frames that stand above the surface, their gains, and where the surface comes from."""
    made: list[Orthophoto] = []

    def photographs(overview: Grid, heights: NDArray) -> Orthophoto:
        made.append(Orthophoto(block.frames, overview, heights, origin=block.origin if epsg else None))
        return made[0]

    _, sources = raster_products(placed, out, gsd=gsd, painter=photographs, window=window, sample=sample)
    return made[0].frames, made[0].gains, sources


def _mesh(
    few: Cloud, block: Block, views: Sequence[View], gains: Gains, path: Path, asked: MapSettings, steps: Steps
) -> tuple[dict[str, Any] | None, list[Caution]]:
    """Write the textured mesh: its facts, or None and why there is none; the map is worth having without."""
    from overfly.mapping.textured_mesh import write_textured_mesh

    faces, found = min(asked.mesh_faces or MESH_FACES, len(few)), list[Caution]()
    if asked.mesh_faces is not None and asked.mesh_faces > faces:
        what = f"--mesh-faces {asked.mesh_faces} asks for more triangles than the {faces} points that make the mesh."
        advice = "It has one for each; for more, match at a larger --size or allow more --max-memory."
        found.append(Caution(what, advice))
    placed = georeferenced(few[:0], block)
    try:
        mesh = without_spikes(rough_mesh(Cloud(few.points, few.colors), faces=faces))
        made = write_textured_mesh(
            path,
            mesh,
            views,
            gains,
            place=lambda points: georeferenced(Cloud(points), block).points,
            crs=placed.crs,
            bar=steps.bar,
        )
    except InputError as error:
        return None, [*found, Caution("There is no mesh.glb.", str(error))]
    made["filled_share"] = round(filled_share(mesh, few), 4)
    steps.say("mesh", f"{count_text(made['faces'])} triangles, {made['textured_share']:.0%} textured by photographs")
    return made, found


def georeferenced(local: Cloud, block: Block) -> Cloud:
    """The cloud in the block's projected CRS; unchanged where the block has no place on the Earth."""
    if block.origin is None or not block.metric:
        return local
    origin = block.origin
    return local.with_points(crs_from_enu(local.points, origin), origin.crs_epsg, origin.vertical_epsg)


def lost_frames(flight: Flight, block: Block) -> list[Frame]:
    """Frames that the block could not place."""
    names = set(block.names)
    return [frame for frame in flight.frames if frame.name not in names]


def summarise(
    flight: Flight, block: Block, counted: dict[str, Any], crs: str | None, asked: MapSettings, steps: Steps
) -> dict[str, Any]:
    """The content of ``map.json``, its warnings still empty; ``counted`` is of the cloud, ``crs`` its CRS."""
    return {
        "images": len(flight) + len(flight.skipped),
        "registered": len(block.frames),
        "points": counted["points"],
        "measured": counted["measured"],
        "predicted": counted["predicted"],
        "gsd_m": round(counted["gsd"], 5) if block.metric else None,
        "crs": crs,
        "heights": heights_of(block),
        "cameras_from": block.cameras_from,
        "seconds": steps.seconds,
        "peak_memory_mb": round(peak_memory_mb(), 1),
        "warnings": [],
        "metric": block.metric,
        "reprojection_px": block.reprojection_px,
        "gps_rms": block.gps_rms(),
        "gps_far_off": block.gps_far_off(),
        "gps_antenna_m": block.antenna,
        "ground_control": None if block.survey is None else block.survey.summary(),
        "precision": None if block.precision is None else block.precision.summary(),
        "held_by_gps": block.held_by_gps,
        "unregistered": [frame.name for frame in lost_frames(flight, block)],
        "skipped": dict(flight.skipped),
        **{k: counted[k] for k in ("area", "points_per_area", "height_range", "median_sigma")},
        **{k: counted[k] for k in ("seen_once_share", "unmatched_share")},
        "reused": steps.reused,
        "settings": asked.shown(),
        "version": __version__,
    }


def _cautions(flight: Flight, block: Block, seen: Surface, summary: dict[str, Any], level: bool) -> list[Caution]:
    altitudes = {}
    if block.metric and level:
        above = heights_above_ground(seen, block.poses)
        altitudes = {f.name: (float(h), f.relative_altitude) for f, h in zip(block.frames, above, strict=True)}
    found = cautions(
        summary,
        altitudes=altitudes,
        has_gps=any(f.gps is not None for f in flight.frames),
        from_readers=[*flight.warnings, *block.warnings],
    )
    if not level:
        found.insert(
            0,
            Caution(
                "The z axis of the cameras' frame does not point up, so there is no raster and no mesh.",
                "The pictures here are turned for reading, the cloud is not; give cameras in a frame with z up, "
                "or map with --cameras estimate.",
            ),
        )
    return found
