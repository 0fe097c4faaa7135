"""One synthetic flight: what it depends on, and how its scene is made, flown over and photographed."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from overfly.data.record import Record
from overfly.data.windows import window_camera
from overfly.errors import InputError
from overfly.flights import Plan, camera_preset, plan_flight
from overfly.geometry import Camera
from overfly.scenes import Appearance, Renderer, Scene, load_scene, make_scene


@dataclass(frozen=True, kw_only=True)
class FlightJob:
    """All that one rendered flight depends on; plain values, so that it can be a key and cross processes."""

    style: str
    seed: int
    scene: int
    altitude: float
    overlap: float
    side_overlap: float
    flight_path: dict[str, Any]
    camera: str
    image_size: tuple[int, int]
    images: int
    supersample: int
    file: tuple[tuple[int, int], ...] | None = None
    """Size and time of change of the file that ``style`` names, if it is one, and of what gives it its colours."""

    @property
    def key(self) -> str:
        """A hash of every value and of the code that renders: another value or another code is another flight."""
        content = json.dumps({**asdict(self), "code": _code()}, sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()[:20]


@lru_cache(maxsize=1)
def _code() -> str:
    """A hash of the modules that decide what a flight looks like."""
    package = Path(__file__).resolve().parents[1]
    files = [*sorted((package / "scenes").glob("*.py")), *sorted((package / "flights").glob("*.py"))]
    files += [package / "geometry.py", package / "data" / "windows.py", Path(__file__)]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


COVERED, MORE = 0.5, 4
"""Share of an image that must show the scene of a file, which ends somewhere; frames planned for each one wanted."""


def scene_version(path: Path) -> tuple[tuple[int, int], ...]:
    """Size and time of change of a scene's file and of the orthophotos beside it that may colour it."""
    beside = (path, path.with_name(f"{path.stem}_ortho.tif"), path.with_name("orthophoto.tif"))
    stats = [file.stat() for file in beside if file.is_file()]
    return tuple((stat.st_size, stat.st_mtime_ns) for stat in stats)


@lru_cache(maxsize=1)
def _loaded(path: Path, version: tuple[tuple[int, int], ...]) -> Scene:
    """The scene of a file, read once for flights over it that follow each other."""
    return load_scene(path)


def _over_scene(renderer: Renderer, camera: Camera, plan: Plan) -> list[bool]:
    """Which frames of a plan show the scene on at least :data:`COVERED` of their image."""
    small = camera.resized(32, 24)
    return [bool((renderer.depth(small, pose) > 0).mean() >= COVERED) for pose in plan.world_from_camera]


def record_flight(job: FlightJob) -> Record:
    """Make the scene, plan the flight, photograph it: one record, the same for the same job on every machine."""
    rng = np.random.default_rng(job.seed)
    camera = window_camera(camera_preset(job.camera), *job.image_size)
    width = 2 * job.altitude * np.tan(np.radians(camera.fov_deg[0] / 2))
    if job.file is None:
        size_m = float(np.clip(3.0 * width, 200, 2000))
        scene = make_scene(job.style, job.seed, size_m=size_m)
        # Half the scene is flown over, so that no footprint reaches beyond it.
        halves = [np.full(2, share * size_m) for share in (0.25, 0.2, 0.15)]
        wander = np.full(2, 0.05 * size_m)
    else:
        scene = _loaded(Path(job.style).expanduser(), job.file)
        x_min, y_min, x_max, y_max = scene.extent
        size = np.array([x_max - x_min, y_max - y_min])
        footprint = width * np.array([1, job.image_size[1] / job.image_size[0]])
        halves = [np.maximum(share * (size - footprint), 0.1 * size) for share in (0.5, 0.4, 0.3)]
        wander = 0.05 * size
    low, high = scene.bounds
    renderer = Renderer(scene)
    plans, chosen = [], []
    frames = 0
    for attempt in range(40):
        if frames >= job.images:
            break
        half = halves[attempt % 3]
        middle = (low[:2] + high[:2]) / 2 + rng.uniform(-1, 1, 2) * wander
        plan = plan_flight(
            job.flight_path["name"],
            (*(middle - half), *(middle + half)),
            altitude=job.altitude,
            overlap=job.overlap,
            side_overlap=job.side_overlap,
            camera=camera,
            ground=scene.ground,
            rng=rng,
            frames=max(2, (job.images - frames) * (1 if job.file is None else MORE)),
            **{key: value for key, value in job.flight_path.items() if key != "name"},
        )
        plans.append(plan)
        chosen.append([True] * len(plan) if job.file is None else _over_scene(renderer, camera, plan))
        frames += sum(chosen[-1])
    if frames < job.images:
        raise InputError(
            f"A {job.flight_path['name']} flight at {job.altitude:g} m with {job.overlap:g} % overlap has only "
            f"{frames} frames over this scene: ask for at most {frames} images_per_flight, fly lower or overlap more."
        )
    kept = np.concatenate(chosen)
    poses = np.concatenate([plan.world_from_camera for plan in plans])[kept][: job.images]
    strips = np.concatenate([1000 * i + plan.strip for i, plan in enumerate(plans)])[kept][: job.images]
    appearance = Appearance(
        sun_azimuth_deg=float(rng.uniform(0, 360)), sun_elevation_deg=float(rng.uniform(30, 70)), noise_std=2.0
    )
    shots = [
        renderer.render(camera, pose, supersample=job.supersample, appearance=appearance, rng=rng) for pose in poses
    ]
    cell = max(0.25, width / job.image_size[0] / 2)
    heights = renderer.height_map(float(low[0]), float(low[1]), float(high[0]), float(high[1]), cell)
    return Record(
        images=np.stack([shot.image for shot in shots]),
        depth=np.stack([shot.depth for shot in shots]),
        world_from_camera=poses,
        cameras=[camera] * job.images,
        strips=strips.astype(np.int64),
        heights=heights,
        corner=(float(low[0]), float(high[1]), cell),
        ground_height=float(np.mean([plan.ground_height for plan in plans])),
        facts={
            **asdict(job),
            "flight_path": job.flight_path["name"],
            "measured_overlap": [plan.measured_overlap for plan in plans],
        },
    )
