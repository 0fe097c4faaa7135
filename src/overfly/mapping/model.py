"""Sparse models by COLMAP: global mapping of the matches, incremental mapping of what it leaves."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from overfly.mapping.bundle import Bundle, bundle_of
from overfly.mapping.database import read_verified

log = logging.getLogger("overfly")

FEWEST_MATCHES = 15
FEWEST_TO_CALIBRATE = 4
"""Frames that a camera needs before its focal length is estimated from them."""

FEWEST_INLIERS = 10
"""Common points that place a frame against a model that is there already: GPS and the adjustment check it."""

KEPT = 0.5
"""Share of the verified matches of an image that a model must keep as common points, or it contradicts the image. In
right models of real and rendered flights all images keep 0.56 and more, most 0.95; misplaced ones kept 0 to 0.45."""

NO_BASE = 0.03
"""Of the distance to the ground: pairs taken from nearer to each other, such as copies, have no points to keep."""

CONTRADICTED = 0.02
"""Share of the images that may be contradicted before another way of mapping is tried."""

THREADS = 1
"""Sums in the order of one thread: the same seed gives the same cameras to the last bit."""


def mapped(
    database: Path, images: Path, workdir: Path, *, names: Sequence[str], seed: int, calibrate: bool = True
) -> list[Bundle]:
    """Bundles without common images, the largest first; empty where no two frames could be placed.

    Global mapping with tracks of three frames or more is tried first; at 30 % overlap most ground is seen twice only,
    so that frames left out ask for two-view tracks, and then for incremental mapping, which places them one by one. So
    do frames whose matches the model does not keep: it has put them elsewhere. What is still left is tried against the
    best model with few common points, then among itself. Unless told to ``calibrate``, cameras keep the focal lengths
    that the database has.
    """
    matches = {pair: len(rows) for pair, rows in read_verified(database, names).items()}
    numbers = {name: i for i, name in enumerate(names)}

    def bundled(models: dict[int, Any]) -> list[tuple[Any, Bundle]]:
        """The models with points enough: the others are what is left of wrong matches."""
        pairs = [(model, bundle_of(model, numbers)) for model in models.values()]
        return [(model, bundle) for model, bundle in pairs if len(bundle.points) >= FEWEST_MATCHES]

    def better(best: _Judged | None, models: dict[int, Any]) -> _Judged | None:
        judged = [_Judged(model, bundle, upheld(bundle, matches)) for model, bundle in bundled(models)]
        return max([m for m in (best, *judged) if m is not None], key=_Judged.worth, default=None)

    best = None
    for views in (3, 2):
        if views == 3 and len(names) < 3:
            continue
        more = _global(database, images, _folder(workdir / f"global{views}"), names, views, seed, calibrate)
        best = better(best, more)
        if best is not None and best.good(len(names)):
            return [best.bundle]
    best = better(best, _incremental(database, images, _folder(workdir / "incremental"), names, seed, calibrate))
    if best is None:
        return []
    if len(best.bundle) < len(names):
        best = better(best, _extended(best.model, database, images, workdir, seed)) or best
    bundles = [best.bundle]
    while len(left := _left(names, bundles)) >= 2:
        more = _incremental(database, images, _folder(workdir / f"part{len(bundles)}"), left, seed, calibrate)
        part = max((bundle for _, bundle in bundled(more)), key=len, default=None)
        if part is None or len(part) < 2:
            break
        bundles.append(part)
    return sorted(bundles, key=len, reverse=True)


class _Judged(NamedTuple):
    """A model, its bundle, and how many of its images keep their matches."""

    model: Any
    bundle: Bundle
    upheld: int

    def worth(self) -> tuple[int, int, int]:
        return self.upheld, len(self.bundle), len(self.bundle.points)

    def good(self, images: int) -> bool:
        return len(self.bundle) == images and self.upheld >= (1 - CONTRADICTED) * images


def upheld(bundle: Bundle, matches: Mapping[tuple[int, int], int]) -> int:
    """How many images of a bundle keep their matches with its other images.

    Args:
        bundle: its ``frames`` are what the pairs speak of.
        matches: of pairs i < j, how many.
    """
    row = {frame: k for k, frame in enumerate(bundle.frames.tolist())}
    links = bundle.links()
    away = float(np.median(np.linalg.norm(bundle.points[bundle.point] - bundle.centres[bundle.image], axis=1)))
    matched, had, kept = np.zeros((3, len(bundle)))
    for (i, j), count in matches.items():
        if i in row and j in row:
            pair = [row[i], row[j]]
            matched[pair] += count
            if np.linalg.norm(bundle.centres[pair[0]] - bundle.centres[pair[1]]) < NO_BASE * away:
                continue
            had[pair] += count
            kept[pair] += min(count, links.get((min(pair), max(pair)), 0))
    # An image all of whose partners stand where it does has nothing that speaks for it.
    return int(((matched == 0) | ((had > 0) & (kept >= KEPT * had))).sum())


def _left(names: Sequence[str], bundles: Sequence[Bundle]) -> list[str]:
    placed = {i for bundle in bundles for i in bundle.frames.tolist()}
    return [name for i, name in enumerate(names) if i not in placed]


def _global(
    database: Path, images: Path, folder: Path, names: Sequence[str], views: int, seed: int, calibrate: bool
) -> dict[int, Any]:
    import pycolmap

    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = seed
    options.num_threads = THREADS
    options.mapper.bundle_adjustment.ceres.solver_options.num_threads = THREADS
    options.min_model_size = 2
    options.mapper.track_min_num_views_per_track = views
    options.mapper.global_positioning.min_num_view_per_track = views
    options.mapper.bundle_adjustment.min_track_length = 2
    options.mapper.retriangulation.ignore_two_view_tracks = False
    if not calibrate or len(names) < FEWEST_TO_CALIBRATE:
        options.mapper.bundle_adjustment.refine_focal_length = False
        options.mapper.bundle_adjustment.refine_extra_params = False
    return _attempt(partial(pycolmap.global_mapping, database, images, folder, options))


def _pipeline(names: Sequence[str], seed: int, calibrate: bool) -> Any:
    import pycolmap

    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.random_seed = seed
    pipeline.num_threads = THREADS
    pipeline.min_model_size = 2
    pipeline.min_num_matches = FEWEST_MATCHES
    pipeline.extract_colors = False
    pipeline.triangulation.ignore_two_view_tracks = False
    pipeline.image_names = list(names)
    if not calibrate or len(names) < FEWEST_TO_CALIBRATE:
        pipeline.ba_refine_focal_length = False
        pipeline.ba_refine_extra_params = False
    if not calibrate:
        pipeline.mapper.abs_pose_refine_focal_length = False
        pipeline.mapper.abs_pose_refine_extra_params = False
    if len(names) < FEWEST_TO_CALIBRATE:
        pipeline.mapper.init_min_num_inliers = 30
        pipeline.mapper.init_min_tri_angle = 4
    return pipeline


def _incremental(
    database: Path, images: Path, folder: Path, names: Sequence[str], seed: int, calibrate: bool
) -> dict[int, Any]:
    import pycolmap

    pipeline = _pipeline(names, seed, calibrate)
    return _attempt(partial(pycolmap.incremental_mapping, database, images, folder, pipeline))


def _extended(model: Any, database: Path, images: Path, workdir: Path, seed: int) -> dict[int, Any]:
    """The model with frames that share a few points only; what it has stays as it is."""
    import pycolmap

    pipeline = _pipeline([], seed, calibrate=False)
    pipeline.multiple_models = False
    pipeline.fix_existing_frames = True
    pipeline.constant_cameras = set(model.cameras)
    pipeline.mapper.abs_pose_min_num_inliers = FEWEST_INLIERS
    start = _folder(workdir / "placed")
    model.write(start)
    folder = _folder(workdir / "extended")
    run = partial(pycolmap.incremental_mapping, database, images, folder, pipeline, input_path=start)
    return _attempt(run)


def _attempt(run: Callable[[], dict[int, Any]]) -> dict[int, Any]:
    """No model at all is an answer, which pycolmap gives as an exception."""
    try:
        return run()
    except (RuntimeError, ValueError) as error:
        log.debug("mapping found no model: %s", error)
        return {}


def _folder(path: Path) -> Path:
    path.mkdir(parents=True, exist_ok=True)
    return path
