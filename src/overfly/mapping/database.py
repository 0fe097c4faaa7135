"""The COLMAP database of a flight: cameras, key points and verified matches, filled step by step and kept."""

from __future__ import annotations

import json
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from overfly.errors import InputError
from overfly.flights import Flight, Frame, find_preset

DIAGONAL_MM = 43.267
"""Diagonal of 36 x 24 mm film."""

CHUNK = 40
"""Pairs matched between two commits: what a kill may lose."""

MODEL = "RADIAL"
"""One focal length and two radial terms: the second halves the bending of nadir blocks and costs nothing."""


def focal_px(frame: Frame) -> float | None:
    """Focal length in pixels by a calibration, the camera's data sheet, the EXIF focal plane or the 35 mm equivalent.

    An image of another shape than the sensor is a part of it that fills it in one direction.
    """
    if frame.pinhole is not None:
        return frame.pinhole.fx
    if frame.model and frame.focal_mm:
        try:
            preset = find_preset(frame.model)
            usual = preset.camera(max(frame.width, frame.height), min(frame.width, frame.height))
            return float(usual.fx * frame.focal_mm / preset.focal_mm)
        except InputError:
            pass  # a camera without a data sheet here
    if frame.focal_px:
        return float(frame.focal_px)
    if frame.focal35_mm:
        return float(frame.focal35_mm / DIAGONAL_MM * np.hypot(frame.width, frame.height))
    return None


def open_database(path: Path, flight: Flight, found: Sequence[tuple[NDArray, NDArray]]) -> tuple[list[int], list[str]]:
    """Image ids of the frames, and the names of those whose focal length had to be guessed.

    The database is made anew unless it holds exactly these frames with these key points.
    """
    import pycolmap

    frames = flight.frames
    mark = path.with_suffix(".json")
    content = [[f.name, f.width, f.height, repr(f.camera_key), len(p)] for f, (p, _) in zip(frames, found, strict=True)]
    guessed = [f.name for f in frames if focal_px(f) is None]
    if path.is_file() and mark.is_file() and json.loads(mark.read_text()) == content:
        with pycolmap.Database.open(path) as db:
            return [db.read_image_with_name(frame.name).image_id for frame in frames], guessed
    for stale in (path, mark):
        stale.unlink(missing_ok=True)
    cameras: dict[Hashable, tuple[int, int]] = {}
    ids: list[int] = []
    with pycolmap.Database.open(path) as db, pycolmap.DatabaseTransaction(db):
        for frame, (pixels, descriptors) in zip(frames, found, strict=True):
            if frame.camera_key not in cameras:
                cameras[frame.camera_key] = _write_camera(db, frame)
            camera_id, rig_id = cameras[frame.camera_key]
            image = pycolmap.Image(name=frame.name, camera_id=camera_id)
            image.image_id = db.write_image(image)
            unit = pycolmap.Frame()
            unit.rig_id = rig_id
            unit.add_data_id(image.data_id)
            db.write_frame(unit)
            db.write_keypoints(image.image_id, np.asarray(pixels, np.float32).reshape(-1, 2))
            kind = pycolmap.FeatureExtractorType.SIFT
            db.write_descriptors(image.image_id, pycolmap.FeatureDescriptors(kind, descriptors))
            ids.append(image.image_id)
    mark.write_text(json.dumps(content))
    return ids, guessed


def _write_camera(db: Any, frame: Frame) -> tuple[int, int]:
    """Ids of a new camera and of its rig of one."""
    import pycolmap

    prior = focal_px(frame)
    focal = prior or 1.2 * max(frame.width, frame.height)
    camera = pycolmap.Camera.create_from_model_name(1, MODEL, focal, frame.width, frame.height)
    camera.has_prior_focal_length = prior is not None
    camera.camera_id = db.write_camera(camera)
    rig = pycolmap.Rig()
    rig.add_ref_sensor(camera.sensor_id)
    return camera.camera_id, db.write_rig(rig)


def match_pairs(
    path: Path,
    names: Sequence[str],
    pairs: Sequence[tuple[int, int]],
    *,
    seed: int,
    progress: Callable[[int, int], None],
) -> None:
    """Match and verify pairs of frames; those that the database holds already are not done again."""
    import pycolmap

    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    asked = path.with_suffix(".txt")
    for start in range(0, len(pairs), CHUNK):
        asked.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in pairs[start : start + CHUNK]))
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = str(asked)
        pycolmap.match_image_pairs(path, matching, pairing, verification, device=pycolmap.Device.cpu)
        progress(min(start + CHUNK, len(pairs)), len(pairs))


def read_matches(path: Path, names: Sequence[str]) -> dict[tuple[int, int], NDArray[np.uint32]]:
    """The matches before verification: for pairs of frames (i, j), i < j, rows of indices of key points [m, 2]."""
    import pycolmap

    with pycolmap.Database.open(path) as db:
        return _of_frames(db, names, zip(*db.read_all_matches(), strict=True))


def read_verified(path: Path, names: Sequence[str]) -> dict[tuple[int, int], NDArray[np.uint32]]:
    """The matches that verification left, in the form of :func:`read_matches`."""
    import pycolmap

    with pycolmap.Database.open(path) as db:
        pairs, geometries = db.read_two_view_geometries()
        return _of_frames(db, names, ((p, g.inlier_matches) for p, g in zip(pairs, geometries, strict=True)))


def _of_frames(
    db: Any, names: Sequence[str], found: Iterable[tuple[int, NDArray[np.uint32]]]
) -> dict[tuple[int, int], NDArray[np.uint32]]:
    """Rows of the database's pairs by the numbers of their frames, the lower one first."""
    import pycolmap

    index = {db.read_image_with_name(name).image_id: i for i, name in enumerate(names)}
    by_frames = {}
    for pair, rows in found:
        i, j = (index[image] for image in pycolmap.pair_id_to_image_pair(pair))
        by_frames[min(i, j), max(i, j)] = rows if i < j else rows[:, ::-1]
    return by_frames


def read_pixels(path: Path, names: Sequence[str]) -> list[NDArray]:
    """Of each frame the pixels [n, 2] of its key points."""
    import pycolmap

    with pycolmap.Database.open(path) as db:
        return [db.read_keypoints(db.read_image_with_name(name).image_id)[:, :2] for name in names]


def read_points(path: Path, names: Sequence[str]) -> tuple[list[tuple[NDArray, NDArray]], list[int]]:
    """Of each frame pixels [n, 2] and descriptors [n, d] of its key points, and what the database calls its camera."""
    import pycolmap

    with pycolmap.Database.open(path) as db:
        images = [db.read_image_with_name(name) for name in names]
        found = []
        for image in images:
            pixels = db.read_keypoints(image.image_id)[:, :2]
            found.append((pixels, db.read_descriptors(image.image_id).data[: len(pixels)]))
        return found, [image.camera_id for image in images]


def write_matches(
    path: Path,
    flight: Flight,
    found: Sequence[tuple[NDArray, NDArray]],
    matches: dict[tuple[int, int], NDArray[np.uint32]],
    *,
    seed: int,
) -> list[str]:
    """A new database with given matches, verified; returns the names of the frames whose focal length was guessed.

    Args:
        path: the database; one that is there is replaced.
        flight: its frames.
        found: pixels [n, 2] and descriptors of each frame; pixels may be more than descriptors.
        matches: for pairs of frames (i, j), i < j, rows of indices of key points [m, 2].
        seed: of the verification.
    """
    import pycolmap

    path.unlink(missing_ok=True)
    ids, guessed = open_database(path, flight, found)
    with pycolmap.Database.open(path) as db, pycolmap.DatabaseTransaction(db):
        for (i, j), rows in matches.items():
            db.write_matches(ids[i], ids[j], rows.astype(np.uint32))
    _verify(path, [(flight.frames[i].name, flight.frames[j].name) for i, j in matches], seed)
    return guessed


def rewrite_matches(
    path: Path, names: Sequence[str], matches: Mapping[tuple[int, int], NDArray[np.uint32] | None], *, seed: int
) -> None:
    """Put other matches of some pairs of frames into a database, verified; None or too few for that: the pair has none.

    Args:
        path: the database.
        names: of its frames.
        matches: for pairs (i, j), i < j, rows of indices of key points [m, 2].
        seed: of the verification.
    """
    import pycolmap

    kept = {pair: rows for pair, rows in matches.items() if rows is not None and len(rows)}
    with pycolmap.Database.open(path) as db, pycolmap.DatabaseTransaction(db):
        ids = [db.read_image_with_name(name).image_id for name in names]
        for i, j in matches:
            db.delete_two_view_geometry(ids[i], ids[j])
            db.delete_matches(ids[i], ids[j])
        for (i, j), rows in kept.items():
            db.write_matches(ids[i], ids[j], rows.astype(np.uint32))
    _verify(path, [(names[i], names[j]) for i, j in kept], seed)


def _verify(path: Path, pairs: Sequence[tuple[str, str]], seed: int) -> None:
    import pycolmap

    asked = path.with_suffix(".txt")
    asked.write_text("".join(f"{first} {second}\n" for first, second in pairs))
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    pycolmap.verify_matches(path, asked, verification)


def strongest_pair(path: Path) -> int:
    """The largest number of verified matches of a pair."""
    import pycolmap

    with pycolmap.Database.open(path) as db:
        _, geometries = db.read_two_view_geometries()
    return max((len(geometry.inlier_matches) for geometry in geometries), default=0)
