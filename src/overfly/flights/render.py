"""Rendering the frames and the reference cloud of a planned flight into its folder, with a progress bar on stderr."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from overfly.cloud import write_cloud
from overfly.flights.cameras import CameraPreset
from overfly.flights.images import defect
from overfly.flights.noise import PoseNoise
from overfly.flights.plan import Plan
from overfly.flights.reference import reference_cloud
from overfly.flights.site import Site
from overfly.flights.write import Stamp, frame_name, remove_leftovers, write_frame
from overfly.geodesy import Origin
from overfly.geometry import Array, Camera, gimbal_from_rotation

if TYPE_CHECKING:
    from overfly.scenes import Appearance, Scene


def stamps_of(plan: Plan, origin: Origin, model: PoseNoise, preset: CameraPreset | None, seed: int) -> list[Stamp]:
    """What GPS and gimbal report at each frame, errors included."""
    rng = np.random.default_rng([seed, 2])
    poses = plan.world_from_camera
    positions = model.positions(poses[:, :3, 3], rng)
    angles = model.angles([gimbal_from_rotation(p[:3, :3]) for p in poses], rng)
    names = {"make": preset.make, "model": preset.model} if preset is not None else {}
    focal = preset.focal_mm if preset is not None else None
    return [
        Stamp(position, (yaw, pitch, roll), plan.ground_height, origin, focal_mm=focal, **names)
        for position, (yaw, pitch, roll) in zip(positions, angles.tolist(), strict=True)
    ]


_WORKER: dict[str, Any] = {}


def _start_worker(scene: Scene) -> None:
    from overfly.scenes import Renderer

    _WORKER["renderer"] = Renderer(scene)


def _shoot(
    path: Path, camera: Camera, pose: Array, stamp: Stamp, index: int, look: Appearance | None, options: tuple
) -> int:
    supersample, quality, seed = options
    rng = np.random.default_rng([seed, 3, index])
    renderer = _WORKER["renderer"]
    rendered = renderer.render(camera, pose, supersample=supersample, appearance=look, rng=rng)
    write_frame(path, rendered.image, camera, pose, stamp, index, quality=quality)
    return index


def render_frames(
    scene: Scene,
    plan: Plan,
    stamps: list[Stamp],
    out: Path,
    look: Appearance | None,
    supersample: int,
    quality: int,
    seed: int,
    processes: int,
) -> None:
    """Render the frames that are not there yet."""
    folder = out / "images"
    folder.mkdir(exist_ok=True)
    for place in (out, folder):
        remove_leftovers(place)
    paths = [folder / frame_name(i) for i in range(len(plan))]
    todo = [i for i, path in enumerate(paths) if not path.is_file() or defect(path) is not None]
    options = (supersample, quality, seed)
    jobs = [(paths[i], plan.camera, plan.world_from_camera[i], stamps[i], i, look, options) for i in todo]
    with _progress("Rendering frames", len(plan), len(plan) - len(todo)) as advance:
        if processes == 1 or len(jobs) < 2:
            if jobs:
                _start_worker(scene)
            for job in jobs:
                _shoot(*job)
                advance()
            _WORKER.clear()
            return
        context = get_context("spawn")
        pool = ProcessPoolExecutor(processes, mp_context=context, initializer=_start_worker, initargs=(scene,))
        try:
            for _ in pool.map(_shoot, *zip(*jobs, strict=True), chunksize=1):
                advance()
        finally:
            pool.shutdown(cancel_futures=True)  # after Ctrl-C only the frames in work are finished


def write_reference(scene: Scene, plan: Plan, out: Path, n: int, seed: int) -> None:
    """Write reference.laz with at most ``n`` points of the surfaces that the flight sees."""
    from overfly.scenes import Renderer

    site = Site(plan.camera, scene.ground, plan.area, plan.altitude, plan.tilt_deg, False)
    outlines = site.outlines(plan.world_from_camera).reshape(-1, 2)
    (x0, y0), (x1, y1) = outlines.min(0).tolist(), outlines.max(0).tolist()
    renderer = Renderer(scene)
    with _progress("Reference cloud", len(plan), 0) as advance:

        def counted(poses: Iterable) -> Iterator:
            for pose in poses:
                yield pose
                advance()

        cloud = reference_cloud(
            scene,
            plan.camera,
            plan.world_from_camera,
            lambda pose: renderer.depth(plan.camera, pose),
            (x0, y0, x1, y1),
            n,
            np.random.default_rng([seed, 4]),
            counted,
        )
    write_cloud(cloud, out / "reference.laz")


@contextmanager
def _progress(what: str, total: int, done: int) -> Iterator[Any]:
    """A bar on stderr; the value is the function that advances it by one."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(file=sys.stderr), transient=False) as bar:
        task = bar.add_task(what, total=total, completed=done)
        yield lambda: bar.advance(task)
