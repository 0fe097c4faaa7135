"""The pictures of a map's report, and the surface that its numbers are counted on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from overfly.cloud import Cloud
from overfly.data.footprints import footprint, sees
from overfly.geometry import Array, Camera
from overfly.mapping import pictures
from overfly.mapping.block_marks import Marks
from overfly.mapping.culling import Groups
from overfly.mapping.raster import Surface
from overfly.mapping.report import Picture

SHOWN = 1_000_000
"""Points kept for the oblique picture: more would not be seen in it."""


def upright(poses: Array) -> Array:
    """The rotation [4, 4] that puts up on the z axis, guessed from the cameras alone.

    Level cameras have their x axes in the horizontal plane, so up is the direction that is square to all of them; where
    all fly in one direction, the one of these directions that is nearest to the way back along the line of sight.
    """
    right, backward = poses[:, :3, 0], -poses[:, :3, 2].mean(0)
    values, vectors = np.linalg.eigh(right.T @ right / len(right))  # ascending
    z = vectors[:, 0]
    if values[1] < 0.05:
        free = vectors[:, :2]
        z = free @ (free.T @ backward)
    z = z * np.sign(z @ (backward - poses[:, :3, 1].mean(0))) / np.linalg.norm(z)
    x = np.array([1.0, 0, 0]) if abs(z[0]) < 0.9 else np.array([0, 1.0, 0])
    x = x - z * (x @ z)
    x /= np.linalg.norm(x)
    turn = np.eye(4)
    turn[:3, :3] = np.stack([x, np.cross(z, x), z])
    return turn


def gallery(
    cloud: Cloud,
    cameras: Sequence[Camera],
    poses: Array,
    names: Sequence[str],
    *,
    gsd: float,
    unit: str,
    height_offset: float = 0.0,
    missing: Sequence[tuple[str, NDArray]] = (),
    marks: Marks | None = None,
    photo: NDArray[np.uint8] | None = None,
) -> tuple[list[Picture], Surface]:
    """All pictures of a report.

    The surface has in ``views``, for every cell, how many frames have it inside them.

    Args:
        cloud: the map, in the same z-up frame as the poses (metres or units).
        cameras, poses, names: registered frames, poses [n, 4, 4], in the order of the flight.
        gsd: ground sampling distance.
        unit: of lengths, for the scale bars.
        height_offset: height of the product minus z here.
        missing: name and position [>=2] of frames that were not registered.
        marks: what holds the block, in the same frame.
        photo: the orthophoto [rows, columns, 3], white where it is empty; None shows the colours of the points.
    """
    seen = pictures.overview(cloud, min_cell=2 * gsd)
    ground = float(np.nanmedian(seen.heights))
    outlines = [footprint(camera, pose, ground) for camera, pose in zip(cameras, poses, strict=True)]
    views = views_per_cell(seen, cameras, poses)
    shown_points = cloud
    if len(cloud) > SHOWN:
        shown_points = cloud[np.random.default_rng(0).choice(len(cloud), SHOWN, replace=False)]
    taken = "Where the registered images were taken"
    if marks is not None and marks.links:
        taken += (
            " and what they cover. Lines join images with common points, the darker the more; residuals and sigma are "
            "drawn longer by the factor stated."
        )
    else:
        taken += " (dots, joined in the order of the flight) and what they cover."
    up = "north is up" if unit == "m" else "the frame's y axis is up, where north is nobody knows"
    of_what = "Colours of the cloud" if photo is None else "The orthophoto"
    shown = [
        Picture(
            "The map",
            "From above",
            f"{of_what}, straight from above; {up}. White: nothing known.",
            pictures.jpeg(enlarged(pictures.top_view(seen) if photo is None else photo)),
        ),
        Picture(
            "The map",
            "Heights",
            "Heights of the cloud over a hillshade (light from the upper left); dsm.tif closes holes left open here.",
            pictures.png(pictures.height_map(seen, offset=height_offset, unit=unit)),
        ),
        Picture(
            "In perspective",
            "The cloud",
            "Every point with its own colour, as stored in cloud.laz.",
            pictures.jpeg(pictures.oblique_view(shown_points)),
        ),
        Picture(
            "The flight",
            "Images",
            taken,
            pictures.png(
                pictures.block_map(
                    seen, poses[:, :3, 3], outlines, missing=missing, names=names, marks=marks, unit=unit
                )
            ),
        ),
        Picture(
            "The flight",
            "Overlap",
            "How many images have a place inside their frame. Two are needed to measure, three make it reliable.",
            pictures.png(pictures.views_map(seen.grid, np.where(seen.filled, views, np.nan), unit=unit)),
        ),
    ]
    if cloud.predicted is not None and cloud.predicted.any():
        picture = pictures.origin_map(seen, unit=unit)
        assert picture is not None
        caption = (
            "Where the cloud was measured, and where it is only predicted: do not measure there. White: no points; "
            "dsm_source.tif tells which of these places dsm.tif interpolates."
        )
        shown.append(Picture("Measured and predicted", "Measured and predicted ground", caption, pictures.png(picture)))
    return shown, replace(seen, views=views)


def photo_overview(path: Path, *, longest: int = 1400) -> NDArray[np.uint8]:
    """An orthophoto made small [rows, columns, 3], white where it is empty."""
    import rasterio

    with rasterio.open(path) as source:
        factor = min(1.0, longest / max(source.width, source.height))
        shape = max(1, round(source.height * factor)), max(1, round(source.width * factor))
        *colors, alpha = source.read(out_shape=(4, *shape), resampling=rasterio.enums.Resampling.average)
    return np.where(alpha[..., None] > 0, np.stack(colors, axis=-1), np.uint8(255))


def enlarged(image: NDArray[np.uint8], pixels: int = 700) -> NDArray[np.uint8]:
    """Cells as squares of whole pixels, until the longer side has at least ``pixels``."""
    factor = -(-pixels // max(image.shape[:2]))
    return image.repeat(factor, axis=0).repeat(factor, axis=1)


def views_per_cell(seen: Surface, cameras: Sequence[Camera], poses: Array) -> NDArray[np.float64]:
    """Number of frames that have each cell of the surface inside them [rows, columns].

    Empty cells are taken as high as the nearest one that is not.
    """
    from scipy.ndimage import distance_transform_edt

    nearest = distance_transform_edt(~seen.filled, return_distances=False, return_indices=True)
    heights = seen.heights[tuple(nearest)]
    points = np.concatenate([seen.grid.centres(), heights[..., None]], axis=-1).reshape(-1, 3)
    total, groups = np.zeros(len(points)), Groups(points)
    for camera, pose in zip(cameras, poses, strict=True):
        # The lens bends what it sees: look for it as far as twice the image.
        wide = replace(
            camera.undistorted(),
            width=2 * camera.width,
            height=2 * camera.height,
            cx=camera.cx + camera.width / 2,
            cy=camera.cy + camera.height / 2,
        )
        near = groups.near(wide, pose)
        total[near] += sees(points[near], camera, pose)
    return total.reshape(seen.heights.shape)
