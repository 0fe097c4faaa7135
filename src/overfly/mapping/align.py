"""Cameras estimated from the images: SIFT, two-view geometry, global mapping, bundle adjustment held by GPS."""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from overfly.errors import InputError
from overfly.flights import Flight, Frame, find_preset
from overfly.geometry import Array, Camera, Origin, enu_from_geodetic, pose, transform
from overfly.mapping.block import Block
from overfly.mapping.features import FEWEST_MATCHES, features, image_pairs, match
from overfly.mapping.georeference import by_gps, by_ground

log = logging.getLogger("overfly")

Bar = Callable[[str, str], AbstractContextManager[Callable[..., Any]]]
DIAGONAL_MM = 43.267
GPS_SIGMA_M = (2.0, 2.0, 3.0)


def align(flight: Flight, *, workdir: Path, seed: int, bar: Bar) -> Block:
    """Estimate the cameras of a flight.

    Args:
        flight: frames with GPS and focal lengths where their files tell them; cameras they may have are not used.
        workdir: features, matches and the sparse model are kept here.
        seed: of every random choice; the same seed gives the same cameras.
        bar: (step, unit) -> context manager of a function that takes (done, total).

    Returns:
        The block of the registered frames: in local ENU metres where the images have GPS, else in a levelled frame
        whose cameras stand 100 units above the ground and ``metric`` is False.

    Raises:
        InputError: fewer than two images could be placed.
    """
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value if hasattr(pycolmap.logging, "ERROR") else 2
    frames = flight.frames
    warnings: list[str] = []
    origin, told = gps_frame(flight)
    pixels, pairs = _matched(frames, told, workdir, bar)
    database = workdir / "database.db"
    database.unlink(missing_ok=True)
    guessed = _fill(database, frames, pixels, pairs)
    if guessed:
        warnings.append(
            "The focal length of some images is not known and was estimated from the images alone: calibrate the "
            "camera or keep the photos' EXIF."
        )
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed
    pycolmap.geometric_verification(database, two_view_geometry_options=options)
    model = _mapped(database, flight.root, workdir, seed)
    if model is None or model.num_reg_images() < 2:
        strongest = max((len(m) for m in pairs.values()), default=0)
        raise InputError(
            f"No two of the {len(frames)} images could be placed together (best pair: {strongest} matches): give images "
            "that overlap by 30 % or more, are sharp, and show texture."
        )
    ids = sorted(model.reg_image_ids())
    index = {frame.name: i for i, frame in enumerate(frames)}
    order = [index[model.images[i].name] for i in ids]
    if told is not None and np.isfinite(told[order, :2]).all(1).sum() >= 3:
        model = _held(model, ids, told[order], [frames[i].gimbal for i in order], seed)
    return _block(flight, model, ids, order, origin, told, warnings, seed)


def gps_frame(flight: Flight) -> tuple[Origin | None, Array | None]:
    """The local frame of a flight's GPS and the positions in it [n, 3], NaN where unknown; None without GPS."""
    fixes = [frame.gps for frame in flight.frames]
    known = [fix for fix in fixes if fix is not None]
    if len(known) < 2:
        return None, None
    heights = [fix.altitude for fix in known if fix.altitude is not None]
    origin = flight.origin or Origin(
        float(np.mean([fix.latitude for fix in known])),
        float(np.mean([fix.longitude for fix in known])),
        float(np.median(heights)) if heights else 0.0,
    )
    told = np.full((len(fixes), 3), np.nan)
    for i, fix in enumerate(fixes):
        if fix is not None:
            height = origin.height if fix.altitude is None else fix.altitude
            told[i] = enu_from_geodetic([[fix.latitude, fix.longitude, height]], origin)[0]
            told[i, 2] = np.nan if fix.altitude is None else told[i, 2]
    return origin, told


def focal_px(frame: Frame) -> float | None:
    """Focal length in pixels by the camera's data sheet, the EXIF focal-plane tags or the 35 mm equivalent."""
    longest = max(frame.width, frame.height)
    if frame.model and frame.focal_mm:
        try:
            preset = find_preset(frame.model)
            return float(frame.focal_mm / preset.sensor_mm[0] * longest)
        except InputError:
            pass  # a camera without a data sheet here
    if frame.focal_px:
        return float(frame.focal_px)
    if frame.focal35_mm:
        return float(frame.focal35_mm / DIAGONAL_MM * np.hypot(frame.width, frame.height))
    return None


def _matched(
    frames: list[Frame], told: Array | None, workdir: Path, bar: Bar
) -> tuple[list[Any], dict[tuple[int, int], Any]]:
    """Key points of every frame and the matches of every pair, kept in ``workdir``."""
    folder = workdir / "features"
    folder.mkdir(parents=True, exist_ok=True)
    found = []
    with bar("features", "images") as update:
        for i, frame in enumerate(frames):
            found.append(features(frame, folder))
            update(i + 1, len(frames))
    pairs: dict[tuple[int, int], Any] = {}
    wanted = image_pairs(frames, told)
    with bar("matches", "pairs") as update:
        for number, (i, j) in enumerate(wanted):
            kept = folder / f"match-{i}-{j}.npy"
            if kept.is_file():
                pairs[i, j] = np.load(kept)
            else:
                pairs[i, j] = match(found[i][1], found[j][1])
                part = kept.with_suffix(".part")
                with part.open("wb") as file:
                    np.save(file, pairs[i, j])
                part.replace(kept)
            update(number + 1, len(wanted))
    return [pixels for pixels, _ in found], pairs


def _fill(database: Path, frames: list[Frame], pixels: list[Any], pairs: dict[tuple[int, int], Any]) -> bool:
    """Write cameras, key points and matches; returns whether a focal length had to be guessed."""
    import pycolmap

    cameras: dict[Hashable, Any] = {}
    guessed = False
    with pycolmap.Database.open(database) as db:
        ids = []
        for frame, points in zip(frames, pixels, strict=True):
            key = frame.camera_key
            if key not in cameras:
                prior = focal_px(frame)
                guessed |= prior is None
                focal = prior or 1.2 * max(frame.width, frame.height)
                camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", focal, frame.width, frame.height)
                camera.has_prior_focal_length = prior is not None
                camera.camera_id = db.write_camera(camera)
                rig = pycolmap.Rig()
                rig.add_ref_sensor(camera.sensor_id)
                cameras[key] = (camera.camera_id, db.write_rig(rig))
            camera_id, rig_id = cameras[key]
            image = pycolmap.Image(name=frame.name, camera_id=camera_id)
            image.image_id = db.write_image(image)
            unit = pycolmap.Frame()
            unit.rig_id = rig_id
            unit.add_data_id(image.data_id)
            db.write_frame(unit)
            db.write_keypoints(image.image_id, points.astype(np.float32))
            ids.append(image.image_id)
        for (i, j), matches in pairs.items():
            if len(matches) >= FEWEST_MATCHES:
                db.write_matches(ids[i], ids[j], matches)
    return guessed


def _mapped(database: Path, images: Path, workdir: Path, seed: int) -> Any:
    """The largest model of global mapping; where it leaves images out, incremental mapping may do better."""
    import pycolmap

    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = seed
    # At 30 % overlap most ground is seen twice only: two-view tracks are all there is.
    options.mapper.track_min_num_views_per_track = 2
    options.mapper.retriangulation.ignore_two_view_tracks = False
    options.mapper.global_positioning.min_num_view_per_track = 2
    options.mapper.bundle_adjustment.min_track_length = 2
    best = _largest(_quiet(lambda: pycolmap.global_mapping(database, images, _folder(workdir / "global"), options)))
    with pycolmap.Database.open(database) as db:
        wanted = db.num_images()
    if best is None or best.num_reg_images() < wanted:
        pipeline = pycolmap.IncrementalPipelineOptions()
        pipeline.random_seed = seed
        pipeline.ba_refine_focal_length = True
        pipeline.min_num_matches = FEWEST_MATCHES
        pipeline.triangulation.ignore_two_view_tracks = False
        grown = _largest(
            _quiet(lambda: pycolmap.incremental_mapping(database, images, _folder(workdir / "incremental"), pipeline))
        )
        if grown is not None and (best is None or grown.num_reg_images() > best.num_reg_images()):
            best = grown
    return best


def _quiet(run: Callable[[], dict[int, Any]]) -> dict[int, Any]:
    """No model at all is an answer, which pycolmap gives as an exception."""
    try:
        return run()
    except (RuntimeError, ValueError) as error:
        log.debug("mapping found no model: %s", error)
        return {}


def _folder(path: Path) -> Path:
    path.mkdir(parents=True, exist_ok=True)
    return path


def _largest(models: dict[int, Any]) -> Any:
    return max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None)


def _held(model: Any, ids: list[int], told: Array, gimbals: list[Any], seed: int) -> Any:
    """Bundle adjustment with GPS positions as priors: it holds scale and tilt, which images alone bend."""
    import pycolmap

    centres = np.array([model.images[i].projection_center() for i in ids])
    try:
        matrix = by_gps(centres, told, gimbals, _rotations(model, ids))
    except InputError:
        return model
    scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
    rows = np.column_stack([matrix[:3, :3] / scale, matrix[:3, 3]])
    model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(rows[:, :3]), rows[:, 3]))
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = 0.5
    options.ceres.solver_options.max_num_iterations = 150
    config = pycolmap.BundleAdjustmentConfig()
    priors = []
    for i, place in zip(ids, told, strict=True):
        config.add_image(i)
        if np.isfinite(place).all():
            prior = pycolmap.PosePrior()
            prior.corr_data_id = model.images[i].data_id
            prior.position = place
            prior.position_covariance = np.diag(np.square(GPS_SIGMA_M))
            prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
            priors.append(prior)
    if len(priors) < 3:
        return model
    held = pycolmap.PosePriorBundleAdjustmentOptions()
    held.alignment_ransac.random_seed = seed
    held.alignment_ransac.max_error = 10.0
    held.ceres.prior_position_loss_function_type = pycolmap.LossFunctionType.HUBER
    refined = pycolmap.Reconstruction(model)
    pycolmap.create_pose_prior_bundle_adjuster(options, held, config, priors, refined).solve()
    refined.update_point_3d_errors()
    model.update_point_3d_errors()
    # GPS may bend the block by half a pixel; more would mean that the positions are wrong.
    if refined.compute_mean_reprojection_error() > model.compute_mean_reprojection_error() + 0.5:
        return model
    return refined


def _rotations(model: Any, ids: list[int]) -> Array:
    """Model-from-camera rotations [n, 3, 3]."""
    return np.stack([model.images[i].cam_from_world().rotation.matrix().T for i in ids])


def _block(
    flight: Flight,
    model: Any,
    ids: list[int],
    order: list[int],
    origin: Origin | None,
    told: Array | None,
    warnings: list[str],
    seed: int,
) -> Block:
    centres = np.array([model.images[i].projection_center() for i in ids])
    rotations = _rotations(model, ids)
    tracked = [p for p in model.points3D.values() if p.error < 2]
    points = np.array([p.xyz for p in tracked]).reshape(-1, 3)
    metric = False
    matrix = None
    if told is not None:
        try:
            matrix = by_gps(centres, told[order], [flight.frames[i].gimbal for i in order], rotations)
            metric = True
        except InputError as error:
            warnings.append(f"{error} The map has no metric scale.")
    if matrix is None:
        matrix = by_ground(centres, points, rotations, seed)
    scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
    placed: dict[int, Frame] = {}
    for i, number, centre, rotation in zip(ids, order, centres, rotations, strict=True):
        frame = flight.frames[number]
        f, cx, cy, k1 = model.images[i].camera.params
        placed[number] = replace(
            frame,
            camera=Camera(frame.width, frame.height, f, f, cx, cy, k1=k1),
            world_from_camera=pose(matrix[:3, :3] / scale @ rotation, transform(matrix, centre)),
        )
    return Block(
        frames=[placed[number] for number in sorted(placed)],
        origin=origin if metric else None,
        cameras_from="estimated",
        metric=metric,
        reprojection_px=float(model.compute_mean_reprojection_error()),
        points=transform(matrix, points),
        warnings=warnings,
    )
