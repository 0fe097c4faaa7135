"""Synthetic flights: procedural landscapes, flown over and rendered once, and kept in the cache."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from overfly.data.flight_job import FlightJob, record_flight, scene_version
from overfly.data.record import cached
from overfly.errors import InputError, unknown
from overfly.flights import CAMERAS, PATHS
from overfly.flights.plan import ALTITUDE_RANGE, OVERLAP_RANGE
from overfly.scenes import STYLES

log = logging.getLogger("overfly")

SPLITS = ("train", "val", "test", "unseen")

PATH_OPTIONS = ("tilt_deg", "heading_deg", "terrain_follow")
"""What a flight path may say beside its name; see :func:`overfly.flights.plan_flight`."""


class SyntheticFlights:
    """Records of flights over procedural scenes; every value comes from conf/data/synthetic.yaml.

    ``train``, ``val`` and ``test`` fly over different scenes of the same styles, ``unseen`` over other styles. Flights
    take turns over styles and cells (altitude, overlap, path); each holds ``images_per_flight`` frames, the last of a
    cell what is left. Instead of a style a list may name a file that :func:`overfly.scenes.load_scene` reads, such as
    a coloured lidar cloud: its landscape is flown over again and again, each time from elsewhere.

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
            if style not in STYLES and not Path(style).expanduser().is_file():
                raise unknown("The style", style, [*STYLES, "a file of a scene (.laz, .ply, .tif, ...)"])
        flight_paths = [flight_paths] if isinstance(flight_paths, str) else flight_paths
        paths = [{"name": name} for name in flight_paths] if flight_paths else [dict(flight_path)]
        for path in paths:
            _check_path(path)
        if camera not in CAMERAS:
            raise unknown("The camera", camera, CAMERAS)
        if images_per_flight < 2:
            raise InputError(f"images_per_flight={images_per_flight} is too few: give 2 or more.")
        if not isinstance(images, dict):
            raise InputError(
                f"data.source.images={images} is not possible: give a number for each of {', '.join(SPLITS)}."
            )
        if unsplit := set(images) - set(SPLITS):
            raise InputError(f"images names {sorted(unsplit)}, but the splits are {', '.join(SPLITS)}.")
        for split, count in images.items():
            if type(count) is not int or count < 0:
                raise InputError(
                    f"data.source.images.{split}={count} is not possible: give a whole number, 0 or more, for instance "
                    f"data.source.images.{split}=120."
                )
        if cells is not None:
            _check_cells(cells)
        else:
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
                # Shifted by one every turn, or a cell would see one style only.
                style = self.styles[split][(number + turn) % len(self.styles[split])]
                file = None if style in STYLES else scene_version(Path(style).expanduser())
                jobs.append(
                    FlightJob(
                        style=style,
                        file=file,
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


def _check_path(path: dict[str, Any]) -> None:
    if path["name"] not in PATHS:
        raise unknown("The flight path", path["name"], PATHS)
    if strange := set(path) - {"name", *PATH_OPTIONS}:
        raise unknown("The key", f"flight_path.{min(strange)}", [f"flight_path.{key}" for key in PATH_OPTIONS])


def _check_cells(cells: Sequence[dict[str, Any]]) -> None:
    bounds = {"altitude": ALTITUDE_RANGE, "overlap": OVERLAP_RANGE, "share": (1e-6, 1e9)}
    if not isinstance(cells, Sequence) or not cells:
        raise InputError("data.source.cells has no cell: give a list of at least one, or data.source.cells=null.")
    for cell in cells:
        possible = isinstance(cell, dict) and set(bounds) <= set(cell) <= {*bounds, "flight_path"}
        if not possible or not all(
            isinstance(cell[key], int | float) and low <= cell[key] <= high for key, (low, high) in bounds.items()
        ):
            raise InputError(
                f"{cell} is not possible as one of data.source.cells: give altitude (20 to 500 m), overlap (0 to 95 "
                "percent), share (above 0) and, where it has one of its own, flight_path={name: grid}, for instance "
                "[{altitude: 100, overlap: 60, share: 1}]."
            )
        if "flight_path" in cell:
            _check_path(cell["flight_path"])


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
