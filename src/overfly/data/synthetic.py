"""Synthetic flights: procedural landscapes, flown over and rendered once, and kept in the cache."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from overfly.data.record import Record, cached
from overfly.data.windows import window_camera
from overfly.errors import InputError, unknown
from overfly.flights import CAMERAS, PATHS, camera_preset, plan_flight
from overfly.scenes import STYLES, Appearance, Renderer, make_scene

log = logging.getLogger("overfly")

SPLITS = ("train", "val", "test", "unseen")


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


class SyntheticFlights:
    """Records of flights over procedural scenes; every value comes from conf/data/synthetic.yaml.

    ``train``, ``val`` and ``test`` fly over different scenes of the same styles, ``unseen`` over other styles. Flights
    take turns over styles and cells (altitude, overlap, path); each holds ``images_per_flight`` frames, the last of a
    cell what is left.

    Raises:
        InputError: a style, path or camera is unknown, or a count is not possible.
    """

    def __init__(
        self,
        *,
        styles: Sequence[str],
        unseen_styles: Sequence[str],
        images: dict[str, int],
        images_per_flight: int,
        cells: Sequence[dict[str, Any]] | None,
        altitude: float | Sequence[float],
        overlap: float | Sequence[float],
        side_overlap: float | None,
        flight_path: dict[str, Any],
        flight_paths: Sequence[str] | None,
        camera: str,
        image_size: Sequence[int],
        supersample: int,
        seed: int,
        cache_dir: str,
        processes: int,
    ) -> None:
        for style in [*styles, *unseen_styles]:
            if style not in STYLES:
                raise unknown("The style", style, STYLES)
        paths = [{"name": name} for name in flight_paths] if flight_paths else [dict(flight_path)]
        for path in paths:
            if path["name"] not in PATHS:
                raise unknown("The flight path", path["name"], PATHS)
        if camera not in CAMERAS:
            raise unknown("The camera", camera, CAMERAS)
        if images_per_flight < 2:
            raise InputError(f"images_per_flight={images_per_flight} is too few: give 2 or more.")
        if unsplit := set(images) - set(SPLITS):
            raise InputError(f"images names {sorted(unsplit)}, but the splits are {', '.join(SPLITS)}.")
        if cells is None:
            cells = [
                {"altitude": a, "overlap": o, "share": 1.0, "flight_path": path}
                for a, o, path in product(_listed(altitude), _listed(overlap), paths)
            ]
        self.styles = {split: list(unseen_styles if split == "unseen" else styles) for split in SPLITS}
        self.images = {split: int(images.get(split, 0)) for split in SPLITS}
        self.images_per_flight = images_per_flight
        self.cells = list(cells)
        self.side_overlap = side_overlap
        self.flight_path = paths[0]
        self.camera = camera
        self.image_size = (int(image_size[0]), int(image_size[1]))
        self.supersample = supersample
        self.seed = seed
        self.folder = Path(cache_dir).expanduser() / "flights"
        self.processes = processes

    def has(self, split: str) -> bool:
        return self.images[split] > 0 and bool(self.styles[split])

    def jobs(self, split: str) -> list[FlightJob]:
        """The flights of a split, in order."""
        shares = np.array([float(cell["share"]) for cell in self.cells])
        wanted = np.floor(np.cumsum(shares) / shares.sum() * self.images[split] + 1e-6).astype(int)
        left = np.diff(wanted, prepend=0)
        jobs: list[FlightJob] = []
        turn = -1
        while left.any():
            turn += 1
            for number, cell in enumerate(self.cells):
                if left[number] <= 0:
                    continue
                images = int(min(self.images_per_flight, left[number]))
                # A flight of one frame has no window: the frame joins the flight before it.
                images += 1 if left[number] - images == 1 else 0
                left[number] -= images
                scene = SPLITS.index(split) * 100_000 + len(jobs)
                side = cell["overlap"] if self.side_overlap is None else self.side_overlap
                jobs.append(
                    FlightJob(
                        # Shifted by one every turn, or a cell would see one style only.
                        style=self.styles[split][(number + turn) % len(self.styles[split])],
                        seed=self.seed * 1_000_003 + scene,
                        scene=scene,
                        altitude=float(cell["altitude"]),
                        overlap=float(cell["overlap"]),
                        side_overlap=float(side),
                        flight_path=cell.get("flight_path", self.flight_path),
                        camera=self.camera,
                        image_size=self.image_size,
                        images=images,
                        supersample=self.supersample,
                    )
                )
        return jobs

    def prepare(self, split: str, limit: int | None = None) -> list[Path]:
        """Render the flights of a split that are not in the cache, side by side, with a progress bar.

        Raises:
            InputError: the disk of the cache is full.
            KeyboardInterrupt: stopped; flights finished so far are kept.
        """
        jobs = self.jobs(split)[:limit]
        folders = [self.folder / job.key for job in jobs]
        missing = [
            (job, folder) for job, folder in zip(jobs, folders, strict=True) if not (folder / "record.json").is_file()
        ]
        if missing:
            self._render(split, missing)
        return folders

    def _render(self, split: str, missing: list[tuple[FlightJob, Path]]) -> None:
        images = sum(job.images for job, _ in missing)
        log.info("Rendering %d %s flights (%d images) into %s", len(missing), split, images, self.folder)
        done = 0
        try:
            for finished in _progress(self._made(missing), images, f"{split} flights"):
                done += finished
        except KeyboardInterrupt:
            log.warning("Stopped: %d of %d images are in the cache and will be reused.", done, images)
            raise

    def _made(self, missing: list[tuple[FlightJob, Path]]) -> Iterator[int]:
        """Make the records and yield the number of images of each as it is finished."""
        if self.processes <= 1 or len(missing) == 1:
            for job, folder in missing:
                cached(folder, lambda job=job: record_flight(job))  # type: ignore[misc]
                yield job.images
            return
        from multiprocessing import get_context

        # Fresh interpreters: this process may already run threads, which do not survive a fork.
        with ProcessPoolExecutor(self.processes, mp_context=get_context("spawn")) as pool:
            futures = {pool.submit(_make, job, folder): job for job, folder in missing}
            try:
                for future in as_completed(futures):
                    future.result()
                    yield futures[future].images
            except BaseException:
                pool.shutdown(cancel_futures=True, wait=True)
                raise


def _make(job: FlightJob, folder: Path) -> None:
    cached(folder, lambda: record_flight(job))


def _listed(value: float | Sequence[float]) -> list[float]:
    return [float(v) for v in value] if isinstance(value, Sequence) else [float(value)]


def _progress(steps: Iterator[int], total: int, title: str) -> Iterator[int]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=total)
        for step in steps:
            bar.advance(task, step)
            yield step


def record_flight(job: FlightJob) -> Record:
    """Make the scene, plan the flight, photograph it: one record, the same for the same job on every machine."""
    rng = np.random.default_rng(job.seed)
    camera = window_camera(camera_preset(job.camera), *job.image_size)
    width = 2 * job.altitude * np.tan(np.radians(camera.fov_deg[0] / 2))
    size_m = float(np.clip(3.0 * width, 200, 2000))
    scene = make_scene(job.style, job.seed, size_m=size_m)
    low, high = scene.bounds
    plans = []
    frames = 0
    for attempt in range(40):
        if frames >= job.images:
            break
        # Half the scene is flown over, so that no footprint reaches beyond it.
        half = (0.25, 0.2, 0.15)[attempt % 3] * size_m
        middle = (low[:2] + high[:2]) / 2 + rng.uniform(-0.05, 0.05, 2) * size_m
        plan = plan_flight(
            job.flight_path["name"],
            (middle[0] - half, middle[1] - half, middle[0] + half, middle[1] + half),
            altitude=job.altitude,
            overlap=job.overlap,
            side_overlap=job.side_overlap,
            camera=camera,
            ground=scene.ground,
            rng=rng,
            frames=max(2, job.images - frames),
            **{key: value for key, value in job.flight_path.items() if key != "name"},
        )
        plans.append(plan)
        frames += len(plan)
    if frames < job.images:
        raise InputError(
            f"A {job.flight_path['name']} flight at {job.altitude:g} m with {job.overlap:g} % overlap has only "
            f"{frames} frames in this scene: ask for at most {frames} images_per_flight."
        )
    poses = np.concatenate([plan.world_from_camera for plan in plans])[: job.images]
    strips = np.concatenate([1000 * i + plan.strip for i, plan in enumerate(plans)])[: job.images]
    renderer = Renderer(scene)
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
