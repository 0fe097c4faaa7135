"""Window geometry: the local metric frame of K overlapping frames, and their images as a network sees them.

The window frame stands on the ground under the reference (first) frame: x to the right and y forward of its heading,
z up, origin in the middle of its footprint. In *window units* it is divided by ``scale`` (metres per unit), so that the
footprint spans [-1, 1] in x. Everything here is NumPy in float64; only :func:`window_sample` goes down to float32.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from overfly.data.footprints import footprint, ground_overlaps
from overfly.errors import InputError
from overfly.geometry import Array, Camera, invert, pixel_grid, transform
from overfly.geometry import distort as distort_lens


def window_frame(camera: Camera, world_from_camera: ArrayLike, ground_height: float) -> tuple[Array, float]:
    """The window frame of a reference frame.

    Args:
        camera: the reference camera *as the network sees it* (after :func:`window_camera`).
        world_from_camera: [4, 4].
        ground_height: metres, prior height of the ground in the world's z.

    Returns:
        ``world_from_window`` [4, 4], a rotation about z and a translation, in metres; and ``scale``, metres per window
        unit: half the footprint's extent in the window's x.

    Raises:
        InputError: the camera stands under the ground or sees nothing of it.
    """
    pose = np.asarray(world_from_camera, float)
    outline = footprint(camera, pose, ground_height)
    if not np.isfinite(outline).all():
        raise InputError(
            f"The camera at height {pose[2, 3]:.1f} m sees no ground at {ground_height:.1f} m: "
            "leave the frame out or correct the ground height."
        )
    right = pose[:2, 0]
    if np.linalg.norm(right) < 0.3:  # rolled on its side: go by the viewing direction
        right = np.array([pose[1, 2], -pose[0, 2]])
    right = right / np.linalg.norm(right)
    world_from_window = np.eye(4)
    world_from_window[:2, 0] = right
    world_from_window[:2, 1] = [-right[1], right[0]]
    along = outline @ world_from_window[:2, :2]  # window axes, world origin
    low, high = along.min(0), along.max(0)
    world_from_window[:2, 3] = world_from_window[:2, :2] @ ((low + high) / 2)
    world_from_window[2, 3] = ground_height
    return world_from_window, float((high[0] - low[0]) / 2)


def to_window(points: ArrayLike, world_from_window: ArrayLike, scale: float) -> Array:
    """World points [..., 3] in window units."""
    return transform(invert(world_from_window), points) / scale


def to_world(points: ArrayLike, world_from_window: ArrayLike, scale: float) -> Array:
    """Points in window units [..., 3] back to world metres, in float64: the inverse of :func:`to_window`."""
    return transform(world_from_window, np.asarray(points, np.float64) * scale)


def camera_from_window(world_from_camera: ArrayLike, world_from_window: ArrayLike, scale: float) -> Array:
    """Camera poses [..., 4, 4] in window units: maps window coordinates to camera axes, both divided by ``scale``."""
    matrices = np.linalg.inv(np.asarray(world_from_camera, float)) @ np.asarray(world_from_window, float)
    matrices[..., :3, 3] /= scale
    return matrices


def window_camera(camera: Camera, width: int, height: int) -> Camera:
    """The pinhole camera of ``width`` x ``height`` pixels that sees the middle of ``camera``'s image.

    The image is cut about its centre to the target's aspect and resampled; where the lens bends its border inwards
    (pincushion), the focal length grows just so much that no pixel falls outside the source.
    """
    factor = max(width / camera.width, height / camera.height)
    pinhole = Camera(
        width,
        height,
        camera.fx * factor,
        camera.fy * factor,
        (camera.cx - camera.width / 2) * factor + width / 2,
        (camera.cy - camera.height / 2) * factor + height / 2,
    )
    if not camera.is_distorted:
        return pinhole
    u, v = np.linspace(0, width, 33), np.linspace(0, height, 33)
    border = np.concatenate([np.stack([u, 0 * u], 1), np.stack([u, 0 * u + height], 1)])
    border = np.concatenate([border, np.stack([0 * v, v], 1), np.stack([0 * v + width, v], 1)])
    for zoom in np.linspace(1, 2, 201):
        zoomed = replace(pinhole, fx=pinhole.fx * zoom, fy=pinhole.fy * zoom)
        source = source_pixels(border, zoomed, camera)
        if ((source >= -1e-6) & (source <= np.array([camera.width, camera.height]) + 1e-6)).all():
            return zoomed
    raise InputError(
        f"The lens distortion k1={camera.k1:g}, k2={camera.k2:g}, k3={camera.k3:g} leaves no usable picture: "
        "correct the camera in transforms.json, or map with --cameras estimate."
    )


def source_pixels(pixels: ArrayLike, pinhole: Camera, camera: Camera) -> Array:
    """Where pixels [..., 2] of a pinhole lie in the image of the lens ``camera`` with the same pose [..., 2]."""
    ideal = (np.asarray(pixels, float) - [pinhole.cx, pinhole.cy]) / [pinhole.fx, pinhole.fy]
    bent = distort_lens(ideal, camera) if camera.is_distorted else ideal
    return bent * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def resample(image: NDArray, camera: Camera, pinhole: Camera) -> NDArray:
    """An image [H, W(, C)] of ``camera`` as ``pinhole`` sees it from the same place: undistorted, cut and resized.

    Downscaling averages over areas (no aliasing); pixels outside the source repeat its border.
    """
    import cv2

    if image.shape[:2] != (camera.height, camera.width):
        raise InputError(
            f"The image has {image.shape[1]} x {image.shape[0]} pixels, but its camera says "
            f"{camera.width} x {camera.height}: give each image its own camera."
        )
    factor = min(camera.fx / pinhole.fx, camera.fy / pinhole.fy)
    if factor > 1:
        width, height = max(1, round(camera.width / factor)), max(1, round(camera.height / factor))
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        camera = camera.resized(width, height)
    source = source_pixels(pixel_grid(pinhole.width, pinhole.height), pinhole, camera) - 0.5  # OpenCV: centres at 0
    mapped = source.astype(np.float32)
    return cv2.remap(image, mapped[..., 0], mapped[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def height_range(altitude: float) -> tuple[float, float]:
    """The heights over the prior ground that are looked at, metres: known from the altitude alone.

    Low flights see single buildings; from high up more relief fits into the picture.
    """
    return -(15 + 0.08 * altitude), 40 + 0.12 * altitude


def window_sample(
    images: Sequence[NDArray[np.uint8]],
    cameras: Sequence[Camera],
    world_from_camera: ArrayLike,
    ground_height: float,
    *,
    prior_world_from_camera: ArrayLike | None = None,
    heights: tuple[float, float] | None = None,
) -> tuple[dict[str, NDArray], Array]:
    """One window as the networks take it, without its reference.

    Args:
        images: K images [H, W, 3] of the network's size, the reference frame first (see :func:`resample`).
        cameras: their K pinhole cameras (see :func:`window_camera`).
        world_from_camera: [K, 4, 4], the cameras to go by.
        ground_height: metres, prior height of the ground.
        prior_world_from_camera: [K, 4, 4] poses from GPS and gimbal; None says that there are no others.
        heights: lowest and highest height over the prior ground, metres; None: :func:`height_range` of the altitude.

    Returns:
        The sample, float32: images [K, 3, H, W] in 0..1, intrinsics [K, 3, 3], camera_from_window and
        prior_from_window [K, 4, 4] (window units), overlaps [K, K], height_range [2] (window units), scale, gsd and
        altitude [] in metres;
        and ``world_from_window`` [4, 4] float64, which puts points back into the world (:func:`to_world`).
    """
    poses = np.asarray(world_from_camera, float)
    priors = poses if prior_world_from_camera is None else np.asarray(prior_world_from_camera, float)
    world_from_window, scale = window_frame(cameras[0], poses[0], ground_height)
    outlines = np.stack([footprint(c, p, ground_height) for c, p in zip(cameras, poses, strict=True)])
    middle = np.append(world_from_window[:2, 3], ground_height)
    altitude = poses[0, 2, 3] - ground_height
    sample = {
        "images": np.stack([np.moveaxis(image, -1, 0) for image in images]).astype(np.float32) / 255,
        "intrinsics": np.stack([c.matrix() for c in cameras]),
        "camera_from_window": camera_from_window(poses, world_from_window, scale),
        "prior_from_window": camera_from_window(priors, world_from_window, scale),
        "overlaps": ground_overlaps(outlines),
        "scale": np.array(scale),
        "gsd": np.array(np.linalg.norm(poses[0, :3, 3] - middle) / cameras[0].fx),
        "altitude": np.array(altitude),
        "height_range": np.array(height_range(altitude) if heights is None else heights) / scale,
    }
    return {name: value.astype(np.float32) for name, value in sample.items()}, world_from_window
