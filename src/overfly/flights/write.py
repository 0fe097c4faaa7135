"""Writing a flight folder: images with the metadata of a real drone, cameras, reference cloud."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from overfly.cloud import Cloud, write_cloud
from overfly.files import replacing
from overfly.flights.cameras import focal35_mm
from overfly.flights.exif import exif_bytes, xmp_bytes
from overfly.flights.flight import Frame, Gps
from overfly.flights.transforms import write_transforms
from overfly.geodesy import Origin, geodetic_from_enu
from overfly.geometry import Array, Camera, gimbal_from_rotation

FIRST_FRAME_TIME = datetime(2026, 6, 21, 11, 0, 0)
"""Time stamps of synthetic frames start here and go on every second: the same flight is the same file."""


@dataclass(frozen=True)
class Stamp:
    """What is written into an image besides its pixels.

    Attributes:
        position: as the receiver reports it, local ENU metres [3].
        gimbal: yaw, pitch, roll in degrees as the gimbal reports them.
        ground_height: z of the place of take-off.
        origin: of the local frame; None writes no GPS.
    """

    position: Array
    gimbal: tuple[float, float, float]
    ground_height: float
    origin: Origin | None
    make: str = "Overfly"
    model: str = "synthetic"
    focal_mm: float | None = None


def true_stamp(pose: Array, ground_height: float, origin: Origin | None) -> Stamp:
    """The stamp of a camera without errors."""
    return Stamp(pose[:3, 3], gimbal_from_rotation(pose[:3, :3]), ground_height, origin)


def write_frame(
    path: Path, image: NDArray[np.uint8], camera: Camera, pose: Array, stamp: Stamp, index: int, *, quality: int = 95
) -> Frame:
    """Write one JPEG, atomically, with EXIF and DJI's XMP.

    Args:
        path: the file.
        image: [H, W, 3] RGB.
        camera, pose: the true ones, for the returned frame.
        stamp: what the metadata say.
        index: number of the frame; its time is so many seconds after the first.
    """
    from PIL import Image

    frame = stamped_frame(path, camera, pose, stamp, index)
    assert frame.time is not None
    assert frame.gimbal is not None
    exif = exif_bytes(
        make=frame.make or "",
        model=frame.model or "",
        time=frame.time,
        focal_mm=frame.focal_mm or focal35_mm(camera),
        focal35_mm=focal35_mm(camera),
        focal_px=camera.fx,
        size=(camera.width, camera.height),
        gps=frame.gps,
    )
    altitude = frame.gps.altitude if frame.gps is not None else None
    xmp = xmp_bytes(gimbal=frame.gimbal, relative_altitude=frame.relative_altitude or 0.0, absolute_altitude=altitude)
    with replacing(path) as temporary:
        # Full colour resolution: halved colour would blur exactly the edges that matching looks at.
        Image.fromarray(image).save(temporary, "JPEG", quality=quality, subsampling=0, exif=exif, xmp=xmp)
    return frame


def stamped_frame(path: Path, camera: Camera, pose: Array, stamp: Stamp, index: int) -> Frame:
    """The frame as :func:`write_frame` writes it, without writing."""
    gps = None
    if stamp.origin is not None:
        latitude, longitude, height = geodetic_from_enu(stamp.position, stamp.origin)[0].tolist()
        gps = Gps(latitude, longitude, height)
    return Frame(
        name=path.name,
        path=path,
        width=camera.width,
        height=camera.height,
        camera=camera,
        world_from_camera=pose,
        gps=gps,
        relative_altitude=float(stamp.position[2] - stamp.ground_height),
        gimbal=stamp.gimbal,
        time=FIRST_FRAME_TIME + timedelta(seconds=index),
        make=stamp.make,
        model=stamp.model,
        focal_mm=stamp.focal_mm if stamp.focal_mm is not None else focal35_mm(camera),
        focal35_mm=focal35_mm(camera),
        focal_px=camera.fx,
    )


def write_flight(
    root: Path | str,
    images: Iterable[NDArray[np.uint8]],
    cameras: Iterable[Camera],
    world_from_camera: Iterable[Array],
    *,
    origin: Origin | None = None,
    facts: Mapping[str, Any] | None = None,
    reference: Cloud | None = None,
    ground_height: float = 0.0,
) -> list[Frame]:
    """Write a whole flight folder from images [H, W, 3] and their true cameras, one after the other.

    Args:
        root: the folder, made if missing.
        origin: of the local ENU frame; with it, images get their GPS position.
        facts: entries of the ``overfly`` block.
        reference: written as reference.laz.
        ground_height: z above which RelativeAltitude counts.
    """
    root = Path(root)
    frames = []
    for i, (image, camera, pose) in enumerate(zip(images, cameras, world_from_camera, strict=True)):
        pose = np.asarray(pose, float)
        stamp = true_stamp(pose, ground_height, origin)
        frames.append(write_frame(root / "images" / frame_name(i), image, camera, pose, stamp, i))
    if reference is not None:
        write_cloud(reference, root / "reference.laz")
    write_transforms(root / "transforms.json", frames, origin, facts)
    return frames


def frame_name(index: int) -> str:
    """Frames are numbered from 1."""
    return f"frame_{index + 1:04d}.jpg"


def remove_leftovers(folder: Path) -> None:
    """Delete the temporary folders that a killed process left behind in a flight folder or its images."""
    for kind in ("frame_*.jpg", "reference.laz", "transforms.json", "fly.json"):
        for rest in folder.glob(f".{kind}.*"):
            if rest.is_dir():
                for file in rest.iterdir():
                    file.unlink()
                rest.rmdir()
