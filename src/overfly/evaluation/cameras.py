"""Cameras of recorded flights as a map would find them: estimated from images, GPS and gimbal, without the truth."""

from __future__ import annotations

import logging
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from overfly.data.dataset import WindowDataset, WindowSettings, disturbed
from overfly.data.footprints import footprint
from overfly.data.record import Record
from overfly.errors import InputError
from overfly.files import replacing
from overfly.flights import Flight, Frame, Gps
from overfly.flights.footprint import polygons
from overfly.geodesy import Origin, geodetic_from_enu
from overfly.geometry import Array, fit_similarity, gimbal_from_rotation, transform, unproject
from overfly.mapping.align import align
from overfly.networks.encoder import Encoder

log = logging.getLogger("overfly")

SOMEWHERE = Origin(47.0, 8.0, 500.0)
"""Place on the Earth of the scenes: GPS positions need one."""

ESTIMATED = "cameras"
"""Folder of the run with the poses of each flight, by which a stopped evaluation goes on."""

ROUNDS = 200
"""Of laying a block on the truth, at most."""

OUTLYING = 3.0
"""Times the median distance at which a point weighs half."""

LEAST_COMMON = 0.05
"""Share of a frame's true footprint that it must meet to count as placed."""

REPORT_EVERY_S = 30.0


def estimate_all(datasets: dict[str, WindowDataset], folder: Path, encoder: Callable[[], Encoder] | None) -> None:
    """Give every dataset the estimated cameras of its flights; those found before are read from ``folder``.

    Args:
        datasets: by split; gets ``estimated``.
        folder: one file for each flight.
        encoder: of a trained network, for flights of which SIFT finds too little.
    """
    folder.mkdir(parents=True, exist_ok=True)
    flights = [(split, number) for split, dataset in datasets.items() for number in range(len(dataset.records))]
    reported = time.monotonic()
    for done, (split, number) in enumerate(flights):
        dataset, kept = datasets[split], folder / f"{split}-{number}.npy"
        if not kept.is_file():
            rng = np.random.default_rng([dataset.seed, 1, number])
            poses = estimated_poses(dataset.records[number], dataset.settings, encoder, rng)
            with replacing(kept) as part, part.open("wb") as file:
                np.save(file, poses)
        dataset.estimated[number] = np.load(kept)
        if time.monotonic() - reported > REPORT_EVERY_S:
            reported = time.monotonic()
            log.info("Cameras of %d of %d flights estimated", done + 1, len(flights))
    placed = np.concatenate([np.isfinite(p[:, 0, 0]) for d in datasets.values() for p in d.estimated.values()])
    log.info("Cameras estimated: %d of %d frames placed, in %d flights", placed.sum(), len(placed), len(flights))


def estimated_poses(
    record: Record, settings: WindowSettings, encoder: Callable[[], Encoder] | None, rng: np.random.Generator
) -> Array:
    """Poses [n, 4, 4] of a flight's frames by :func:`overfly.mapping.align.align`, NaN where a frame is not placed.

    The lens is known; positions, directions and the height over the ground are as wrong as the settings say. The block
    is laid on the true one by the similarity of cameras and of the ground in their corners, as clouds are before they
    are compared: what is left are the errors of the cameras among each other.
    """
    told = disturbed(record.world_from_camera, settings.position_sigma_m, settings.rotation_sigma_deg, rng)
    level = record.ground_height + rng.normal(0, settings.ground_sigma_m)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        frames = [_frame(folder, i, record, told[i], level, settings.position_sigma_m) for i in range(len(record))]
        try:
            block = align(
                Flight(folder, frames),
                workdir=folder / "work",
                seed=0,
                bar=_silent,
                matcher="sift" if encoder is None else "auto",
                encoder=encoder,
            )
        except InputError as error:
            log.info("%s: no cameras (%s)", record.facts.get("style"), str(error).split(":")[0])
            return np.full((len(record), 4, 4), np.nan)
    found = dict(zip((frame.name for frame in block.frames), block.poses, strict=True))
    poses = np.stack([found.get(frame.name, np.full((4, 4), np.nan)) for frame in frames])
    return _laid_on(poses, record)


def _frame(folder: Path, i: int, record: Record, told: Array, level: float, sigma: float) -> Frame:
    from PIL import Image

    path = folder / f"{i:03d}.png"
    Image.fromarray(np.asarray(record.images[i])).save(path)
    latitude, longitude, height = geodetic_from_enu(told[:3, 3], SOMEWHERE)[0].tolist()
    camera = record.cameras[i]
    return Frame(
        name=path.name,
        path=path,
        width=camera.width,
        height=camera.height,
        calibration=camera,
        gps=Gps(latitude, longitude, height, max(sigma, 0.01), max(sigma, 0.01)),
        relative_altitude=float(told[2, 3] - level),
        gimbal=gimbal_from_rotation(told[:3, :3]),
    )


def _laid_on(poses: Array, record: Record) -> Array:
    """Poses [n, 4, 4] moved, turned and scaled so that their frusta lie on the true ones as well as they can.

    A frame whose ground is then not the one that it truly sees was placed wrongly, and is NaN.
    """
    placed = np.flatnonzero(np.isfinite(poses[:, 0, 0])).tolist()
    true = np.asarray(record.world_from_camera)
    heights = true[placed, 2, 3] - record.ground_height
    if not placed:
        return poses
    similarity = _most_agree(poses[placed], true[placed])
    scale = _scale(similarity)
    for _ in range(ROUNDS):  # how deep the ground lies under the block's own cameras is known by its scale alone
        own = _frusta(record, poses, placed, heights / scale)
        target = _frusta(record, true, placed, heights)
        away = np.linalg.norm(transform(similarity, own) - target, axis=1)
        weights = 1 / (1 + (away / max(OUTLYING * float(np.median(away)), 1e-6)) ** 2)  # few wrong frames move nothing
        similarity = fit_similarity(own, target, weights=weights)
        before, scale = scale, _scale(similarity)
        if abs(scale / before - 1) < 1e-9:
            break
    laid = similarity @ poses
    laid[:, :3, :3] /= scale
    for i in placed:
        outlines = [footprint(record.cameras[i], pose, record.ground_height) for pose in (laid[i], true[i])]
        here, there = polygons(np.stack(outlines)) if np.isfinite(outlines).all() else (None, None)
        if here is None or there is None or here.intersection(there).area < LEAST_COMMON * there.area:
            laid[i] = np.nan
    return np.asarray(laid)


def _most_agree(poses: Array, true: Array) -> Array:
    """The similarity [4, 4] by the rotation that most frames agree with and medians of scale and place."""
    turns = true[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1)
    unlike = np.linalg.norm(turns[:, None] - turns[None], axis=(2, 3))
    apart = [np.linalg.norm(p[:, None, :3, 3] - p[None, :, :3, 3], axis=2) for p in (true, poses)]
    pairs = np.triu(apart[1], 1) > 0
    scale = float(np.median(apart[0][pairs] / apart[1][pairs])) if pairs.any() else 1.0
    matrix = np.eye(4)
    matrix[:3, :3] = scale * turns[np.median(unlike, axis=1).argmin()]
    matrix[:3, 3] = np.median(true[:, :3, 3] - poses[:, :3, 3] @ matrix[:3, :3].T, axis=0)
    return matrix


def _scale(similarity: Array) -> float:
    return float(np.cbrt(np.linalg.det(similarity[:3, :3])))


def _frusta(record: Record, poses: Array, placed: list[int], depths: Array) -> Array:
    """Centre and corners at a depth of the placed cameras [5 n, 3]."""
    points = []
    for i, depth in zip(placed, depths.tolist(), strict=True):
        camera = record.cameras[i]
        corners = np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]], float)
        points += [poses[i, None, :3, 3], unproject(corners, np.full(4, depth), camera, poses[i])]
    return np.concatenate(points)


@contextmanager
def _silent(step: str, unit: str) -> Iterator[Callable[..., Any]]:
    yield lambda done, total: None
