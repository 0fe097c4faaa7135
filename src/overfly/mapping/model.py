"""The sparse model: global mapping of the matches, then bundle adjustment, held by GPS where there is any."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from overfly.geometry import Array

log = logging.getLogger("overfly")

FEWEST_MATCHES = 15
FEWEST_TO_CALIBRATE = 4
"""Frames that a camera needs before its focal length is estimated from them."""

NOISE_PX = 0.25
"""Standard deviation of a key point, pixels: it weighs the images against GPS."""

WORST_PX = 3.0

THREADS = 1
"""Sums in the order of one thread: the same seed gives the same cameras to the last bit."""


def mapped(database: Path, images: Path, workdir: Path, *, total: int, seed: int) -> Any:
    """The model with most of the ``total`` frames, or None.

    Global mapping with tracks of three frames or more is tried first; at 30 % overlap most ground is seen twice only,
    so that frames left out ask for two-view tracks, and then for incremental mapping, which places them one by one.
    """
    import pycolmap

    best: Any = None
    for views in (3, 2):
        if views == 3 and total < 3:
            continue
        options = pycolmap.GlobalPipelineOptions()
        options.random_seed = seed
        options.num_threads = THREADS
        options.mapper.bundle_adjustment.ceres.solver_options.num_threads = THREADS
        options.min_model_size = 2
        options.mapper.track_min_num_views_per_track = views
        options.mapper.global_positioning.min_num_view_per_track = views
        options.mapper.bundle_adjustment.min_track_length = 2
        options.mapper.retriangulation.ignore_two_view_tracks = False
        if total < FEWEST_TO_CALIBRATE:
            options.mapper.bundle_adjustment.refine_focal_length = False
            options.mapper.bundle_adjustment.refine_extra_params = False
        folder = _folder(workdir / f"global{views}")
        best = _better(best, _attempt(partial(pycolmap.global_mapping, database, images, folder, options)))
        if best is not None and best.num_reg_images() == total:
            return best
    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.random_seed = seed
    pipeline.num_threads = THREADS
    pipeline.min_model_size = 2
    pipeline.min_num_matches = FEWEST_MATCHES
    pipeline.extract_colors = False
    pipeline.triangulation.ignore_two_view_tracks = False
    if total < FEWEST_TO_CALIBRATE:
        pipeline.ba_refine_focal_length = False
        pipeline.ba_refine_extra_params = False
        pipeline.mapper.init_min_num_inliers = 30
        pipeline.mapper.init_min_tri_angle = 4
    folder = _folder(workdir / "incremental")
    return _better(best, _attempt(partial(pycolmap.incremental_mapping, database, images, folder, pipeline)))


def _attempt(run: Callable[[], dict[int, Any]]) -> dict[int, Any]:
    """No model at all is an answer, which pycolmap gives as an exception."""
    try:
        return run()
    except (RuntimeError, ValueError) as error:
        log.debug("mapping found no model: %s", error)
        return {}


def _better(best: Any, models: dict[int, Any]) -> Any:
    candidates = [model for model in (best, *models.values()) if model is not None]
    return max(candidates, key=lambda model: model.num_reg_images(), default=None)


def _folder(path: Path) -> Path:
    path.mkdir(parents=True, exist_ok=True)
    return path


def adjust(model: Any, ids: Sequence[int], places: Array | None, sigmas: Array | None, *, seed: int) -> Any:
    """Bundle adjustment with a robust loss; returns a new model.

    Args:
        model: in metres near ``places`` where these are given.
        ids: its registered images.
        places: GPS positions [n, 3], NaN rows are free; None leaves the frame as it is.
        sigmas: their standard deviations [n, 3], metres. They keep nadir blocks from bowing: images alone hardly tell
            focal length and lens from a curved ground.
        seed: of the robust alignment.
    """
    import pycolmap

    refined = pycolmap.Reconstruction(model)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = 2 * NOISE_PX
    options.ceres.solver_options.num_threads = THREADS
    options.ceres.solver_options.max_num_iterations = 150
    options.ceres.solver_options.function_tolerance = 1e-7
    config = pycolmap.BundleAdjustmentConfig()
    shots: dict[int, int] = {}
    for i in ids:
        config.add_image(i)
        camera = refined.images[i].camera_id
        shots[camera] = shots.get(camera, 0) + 1
    for camera, count in shots.items():
        if count < FEWEST_TO_CALIBRATE:
            config.set_constant_cam_intrinsics(camera)
    known = [] if places is None else np.flatnonzero(np.isfinite(places).all(1)).tolist()
    if places is None or sigmas is None or len(known) < 3:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        pycolmap.create_default_bundle_adjuster(options, config, refined).solve()
    else:
        priors = [_prior(refined.images[ids[k]], places[k], sigmas[k] / NOISE_PX) for k in known]
        held = pycolmap.PosePriorBundleAdjustmentOptions()
        held.alignment_ransac.random_seed = seed
        held.alignment_ransac.max_error = 10.0
        held.ceres.prior_position_loss_function_type = pycolmap.LossFunctionType.HUBER
        pycolmap.create_pose_prior_bundle_adjuster(options, held, config, priors, refined).solve()
    refined.update_point_3d_errors()
    for point in [p for p, value in refined.points3D.items() if value.error > WORST_PX]:
        refined.delete_point3D(point)
    return refined


def _prior(image: Any, place: Array, sigma: Array) -> Any:
    import pycolmap

    prior = pycolmap.PosePrior()
    prior.corr_data_id = image.data_id
    prior.position = place
    prior.position_covariance = np.diag(np.square(sigma))
    prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
    return prior


def centres_and_rotations(model: Any, ids: Sequence[int]) -> tuple[Array, Array]:
    """Camera centres [n, 3] and model-from-camera rotations [n, 3, 3]."""
    centres = np.array([model.images[i].projection_center() for i in ids])
    return centres, np.stack([model.images[i].cam_from_world().rotation.matrix().T for i in ids])


def moved(model: Any, matrix: Array) -> Any:
    """The model in another frame: ``matrix`` is a similarity [4, 4]; a new model."""
    import pycolmap

    result = pycolmap.Reconstruction(model)
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    result.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(matrix[:3, :3] / scale), matrix[:3, 3]))
    return result
