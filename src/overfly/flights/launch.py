"""Fly over a scene: plan, render and write a whole flight folder; the body of ``overfly fly``."""

from __future__ import annotations

import hashlib
import json
import math
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from overfly.errors import InputError
from overfly.files import replacing
from overfly.flights.cameras import find_preset
from overfly.flights.flight import Frame
from overfly.flights.footprint import footprints, polygons
from overfly.flights.noise import PoseNoise, noise_model
from overfly.flights.plan import ALTITUDE_RANGE, DEFAULT_TILT_DEG, OVERLAP_RANGE, PATHS, Plan, check_number, plan_flight
from overfly.flights.render import render_frames, stamps_of, write_reference
from overfly.flights.site import Area, Site
from overfly.flights.transforms import write_transforms
from overfly.flights.write import frame_name, stamped_frame
from overfly.geodesy import Origin
from overfly.geometry import Array, Camera

if TYPE_CHECKING:
    from overfly.scenes import Appearance, Scene

DEFAULT_ORIGIN = Origin(46.0, 8.0, 450.0)
DEFAULT_STRIPS = 5
SCENE_SIZE_M = (200.0, 4000.0)
RECORD = "fly.json"

REFERENCE = (500_000, 2_000_000)
"""Fewest and most points of reference.laz, where their number is not given."""


def default_area(
    flight_path: str, camera: Camera, altitude: float, overlap: float, side_overlap: float, tilt_deg: float
) -> tuple[float, float]:
    """Width and depth in metres of ground for about 5 x 5 frames, or for one orbit."""
    level = Site(camera, lambda xy: np.zeros(len(xy)), (-1, -1, 1, 1), altitude, tilt_deg, False)
    length, width, _ = level.frame_size(tilt_deg)
    if flight_path == "circular":
        side = altitude * math.tan(math.radians(tilt_deg)) + length / 2
        return side, side
    steps = DEFAULT_STRIPS - 1
    east, north = width * (1 + steps * (1 - side_overlap / 100)), length * (1 + steps * (1 - overlap / 100))
    return (max(east, north),) * 2 if flight_path == "double_grid" else (east, north)


def fly(
    scene: Scene | Path | str,
    *,
    out: Path | str,
    flight_path: str = "grid",
    overlap: float = 50.0,
    side_overlap: float | None = None,
    altitude: float = 150.0,
    camera: str | Camera = "p4p",
    width: int | None = None,
    height: int | None = None,
    area_m: float | None = None,
    frames: int | None = None,
    tilt_deg: float | None = None,
    heading_deg: float = 0.0,
    terrain_follow: bool = False,
    seed: int = 0,
    noise: str | PoseNoise = "none",
    appearance: Appearance | None = None,
    origin: Origin | None = None,
    supersample: int = 2,
    reference_points: int | None = None,
    processes: int = 1,
    quality: int = 95,
) -> tuple[Plan, list[Frame]]:
    """Render a flight folder. Frames that an earlier, interrupted call of the same flight finished are kept.

    Args:
        scene: a scene, a style's name (built large enough for the flight) or a scene file.
        out: the folder; it must not hold another flight.
        flight_path, overlap, altitude, frames, tilt_deg, heading_deg, terrain_follow: see :func:`plan_flight`.
        side_overlap: percent; None takes ``overlap``.
        camera: a preset's name (800 pixels wide unless ``width`` or ``height`` is given), or a camera.
        area_m: side of the square to cover, in the scene's middle; None takes about 5 x 5 frames, or one orbit.
        seed: of the scene's style, the random path, and all noise.
        noise: of the GPS and gimbal values in the images' metadata; transforms.json always holds the true cameras.
        origin: where the local frame stands; None takes the scene's own, else 46 N 8 E.
        reference_points: size of reference.laz, 0 for none; None: one for each ground pixel of the area that is seen,
            within :data:`REFERENCE`.
        processes: that render.

    Returns:
        The plan, whose ``summary()`` states the measured overlap, and the frames.

    Raises:
        InputError: a bad value, or ``out`` holds something else.
    """
    from overfly.scenes import open_scene

    out = Path(out)
    side = overlap if side_overlap is None else side_overlap
    preset = find_preset(camera) if isinstance(camera, str) else None
    if preset is None:
        pinhole = camera
    else:
        pinhole = preset.camera(800, None) if width is None and height is None else preset.camera(width, height)
    assert isinstance(pinhole, Camera)
    _check(flight_path, altitude, overlap, side, seed, processes)
    model = noise_model(noise)
    tilt = DEFAULT_TILT_DEG[flight_path] if tilt_deg is None else check_number("tilt_deg", tilt_deg, 0, 60, "degrees")
    if area_m is None:
        extent = default_area(flight_path, pinhole, altitude, overlap, side, tilt)
    else:
        extent = (check_number("area_m", area_m, 1, 100_000, "metres"),) * 2
    options: dict[str, Any] = {"altitude": altitude, "overlap": overlap, "side_overlap": side, "camera": pinhole}
    options |= {"tilt_deg": tilt_deg, "heading_deg": heading_deg, "frames": frames}
    if isinstance(scene, str | Path):
        scene = open_scene(scene, seed, size_m=_scene_size(flight_path, extent, seed, options))
    x0, y0, x1, y1 = scene.extent
    if area_m is None:
        extent = min(extent[0], x1 - x0), min(extent[1], y1 - y0)
    cx, cy = (x0 + x1) / 2, (y0 + y1) / 2
    area: Area = (cx - extent[0] / 2, cy - extent[1] / 2, cx + extent[0] / 2, cy + extent[1] / 2)
    rng = np.random.default_rng([seed, 1])
    plan = plan_flight(flight_path, area, ground=scene.ground, rng=rng, terrain_follow=terrain_follow, **options)
    origin = origin or scene.origin or DEFAULT_ORIGIN
    facts = {
        "altitude": plan.altitude,
        "overlap": plan.overlap,
        "side_overlap": plan.side_overlap,
        "flight_path": plan.flight_path,
        "measured_overlap": plan.measured_overlap,
        "measured_side_overlap": plan.measured_side_overlap,
        "scene": scene.name,
        "seed": seed,
        "camera": preset.name if preset is not None else "custom",
        "ground_height": plan.ground_height,
        "noise": asdict(model),
    }
    if reference_points is None:
        reference_points = int(np.clip(_ground_pixels(scene, plan), *REFERENCE))
    settings = [supersample, quality, reference_points, repr(appearance), asdict(origin)]
    for remark in remarks(scene, plan):
        sys.stderr.write(f"Note: {remark}\n")
    _claim(out, _key(scene, plan, facts, settings))
    stamps = stamps_of(plan, origin, model, preset, seed)
    render_frames(scene, plan, stamps, out, appearance, supersample, quality, seed, processes)
    written = [
        stamped_frame(out / "images" / frame_name(i), plan.camera, pose, stamp, i)
        for i, (pose, stamp) in enumerate(zip(plan.world_from_camera, stamps, strict=True))
    ]
    if reference_points and not (out / "reference.laz").is_file():
        write_reference(scene, plan, out, reference_points, seed)
    write_transforms(out / "transforms.json", written, origin, facts)
    return plan, written


def _ground_pixels(scene: Scene, plan: Plan) -> float:
    """Area that the frames see, in pixels on level ground."""
    import shapely

    site = Site(plan.camera, scene.ground, plan.area, plan.altitude, plan.tilt_deg, False)
    area = shapely.union_all(polygons(site.outlines(plan.world_from_camera))).area
    return float(area / (plan.altitude / plan.camera.fx) ** 2)


def _scene_size(flight_path: str, extent: tuple[float, float], seed: int, options: dict[str, Any]) -> float:
    """Side in metres of a scene that reaches a little beyond every footprint, planned as if the ground were level."""
    x, y = extent[0] / 2, extent[1] / 2

    def level(xy: Array) -> Array:
        return np.zeros(len(xy))

    plan = plan_flight(flight_path, (-x, -y, x, y), ground=level, rng=np.random.default_rng([seed, 1]), **options)
    outlines = footprints(plan.camera, plan.world_from_camera, level, (0.0, 0.0))
    needed = 2.1 * float(np.abs(outlines).max())
    return float(np.clip(math.ceil(needed / 50) * 50, *SCENE_SIZE_M))


def remarks(scene: Scene, plan: Plan) -> list[str]:
    """What is odd about flying this plan over this scene: frames beside the scene, cameras among its buildings."""
    import shapely

    sentences = []
    site = Site(plan.camera, scene.ground, plan.area, plan.altitude, plan.tilt_deg, False)
    seen = shapely.union_all(polygons(site.outlines(plan.world_from_camera)))
    beside = 100 * (1 - shapely.area(shapely.intersection(seen, shapely.box(*scene.extent))) / shapely.area(seen))
    if beside > 5:
        sentences.append(
            f"{beside:.0f} % of the ground that this flight sees lies beside the scene {scene.name}: fly lower or "
            "give a larger scene."
        )
    top, lowest = float(scene.bounds[1][2]), float(plan.world_from_camera[:, 2, 3].min())
    if lowest < top:
        sentences.append(
            f"The flight is {top - lowest:.0f} m below the top of the scene {scene.name}: cameras may stand inside "
            "buildings; fly higher."
        )
    return sentences


def _check(flight_path: str, altitude: float, overlap: float, side: float, seed: int, processes: int) -> None:
    """What the area and the scene are computed from; the plan checks the rest."""
    from overfly.errors import unknown

    if flight_path not in PATHS:
        raise unknown("The flight path", flight_path, PATHS)
    check_number("altitude", altitude, *ALTITUDE_RANGE, "metres over ground")
    check_number("overlap", overlap, *OVERLAP_RANGE, "percent")
    check_number("side_overlap", side, *OVERLAP_RANGE, "percent")
    for name, value, least in (("seed", seed, 0), ("processes", processes, 1)):
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise InputError(f"{name}={value!r} is not allowed: give a whole number, at least {least}.")


def _key(scene: Scene, plan: Plan, facts: dict[str, Any], settings: list[Any]) -> str:
    """A digest of everything that decides the folder's content."""
    digest = hashlib.sha256()
    for array in (scene.vertices, scene.faces, plan.world_from_camera):
        digest.update(np.ascontiguousarray(array).tobytes())
    digest.update(json.dumps([facts, settings, plan.camera.to_dict()], sort_keys=True, default=str).encode())
    return digest.hexdigest()


def _claim(out: Path, key: str) -> None:
    """Make ``out`` this flight's folder, or find that it already is.

    Raises:
        InputError: it holds something else.
    """
    record = out / RECORD
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file: give a folder for the flight.")
    if record.is_file():
        try:
            old = json.loads(record.read_text(encoding="utf-8")).get("key")
        except (ValueError, AttributeError):
            old = None
        if old == key:
            return
        raise InputError(f"{out} holds another flight: give another folder, or delete this one first.")
    if out.is_dir() and any(not p.name.startswith(".fly.json.") for p in out.iterdir()):
        raise InputError(f"{out} is not empty and holds no flight of this command: give another folder.")
    with replacing(record) as temporary:
        temporary.write_text(json.dumps({"key": key}) + "\n", encoding="utf-8")
