"""The stock way to a dense cloud: pycolmap with its defaults, then OpenCV's semi-global matcher on rectified pairs.

    python benchmarks/truth/stock.py FLIGHT OUT [held]

Key points, exhaustive matching and incremental mapping are pycolmap's own defaults with one camera for all images; the
model is moved to the GPS positions by pycolmap, too. ``held`` keeps the focal length that EXIF tells, and no lens
distortion: left to itself it runs away over flat ground. Each frame is matched at full size with four neighbours;
depths that a left-right check passes become points, one per ground pixel. OUT gets cloud.laz (the flight's local
frame, metres) and model/ (COLMAP's files).
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from overfly.cloud import Cloud, concatenate, voxel_thin, write_cloud
from overfly.flights import Flight, read_flight
from overfly.geodesy import enu_from_geodetic
from overfly.geometry import Array, Camera, pixel_grid, project, unproject
from overfly.mapping.depth_ranges import depth_ranges
from overfly.mapping.matcher import depth_in_frame, disparities, right_disparities
from overfly.mapping.neighbours import choose_partners
from overfly.mapping.rectify import ordered, rectify

GPS_M = 5.0
"""Largest distance from its GPS position at which a camera agrees with it."""

CANVAS_PX = 8_000
"""Wider canvases come from cameras that are wrong."""


def reconstruct(flight: Flight, out: Path, *, held: bool) -> pycolmap.Reconstruction:
    """The largest model of the flight's images, moved to their GPS positions.

    Raises:
        RuntimeError: no model, or none that the positions hold.
    """
    images, database = flight.root / "images", out / "stock.db"
    database.unlink(missing_ok=True)
    cpu = pycolmap.Device.cpu
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    pycolmap.extract_features(database, images, camera_mode=pycolmap.CameraMode.SINGLE, device=cpu)
    pycolmap.match_exhaustive(database, device=cpu)
    options = pycolmap.IncrementalPipelineOptions()
    options.ba_refine_focal_length = options.ba_refine_extra_params = not held
    (out / "models").mkdir(exist_ok=True)
    models = pycolmap.incremental_mapping(database, images, out / "models", options)
    if not models:
        raise RuntimeError("pycolmap found no model")
    model = max(models.values(), key=lambda found: found.num_reg_images())
    assert flight.origin is not None
    frames = [frame for frame in flight.frames if frame.gps is not None]
    told = [(g.latitude, g.longitude, g.altitude or 0.0) for g in (frame.gps for frame in frames) if g is not None]
    places = enu_from_geodetic(np.array(told), flight.origin)
    ransac = pycolmap.RANSACOptions(max_error=GPS_M)
    moved = pycolmap.align_reconstruction_to_locations(model, [f.path.name for f in frames], places, 3, ransac)
    if moved is None:
        raise RuntimeError("the GPS positions hold no model")
    model.transform(moved)
    (out / "model").mkdir(exist_ok=True)
    model.write(out / "model")
    return model


def cameras_of(model: pycolmap.Reconstruction) -> dict[str, tuple[Camera, Array]]:
    """Camera and world_from_camera [4, 4] of each placed image, by file name."""
    found = {}
    for image in model.images.values():
        lens = image.camera
        if lens.model_name != "SIMPLE_RADIAL":
            raise RuntimeError(f"a camera of the model {lens.model_name}, where the stock one is SIMPLE_RADIAL")
        focal, cx, cy, k1 = lens.params
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().inverse().matrix()
        found[image.name] = Camera(lens.width, lens.height, focal, focal, cx, cy, k1=k1), pose
    return found


def dense(images: Path, cameras: dict[str, tuple[Camera, Array]], surface: Array) -> Cloud:
    """Points of all pairs' consistent depths; ``surface`` [M, 3] are the model's points."""
    names = sorted(cameras)
    lenses, poses = [cameras[n][0] for n in names], [cameras[n][1] for n in names]
    ranges = depth_ranges(lenses, poses, surface)
    partners = choose_partners(lenses, poses, ranges, count=4, ratio=(0.04, 0.9))
    pairs = sorted({(min(i, j), max(i, j)) for i, chosen in enumerate(partners) for j in chosen})
    clouds = []
    for pair in pairs:
        i, j = pair if ordered((poses[pair[0]], poses[pair[1]])) else pair[::-1]
        both = (lenses[i], lenses[j]), (poses[i], poses[j])
        layout = rectify(*both, ((ranges[i][0], ranges[i][2]), (ranges[j][0], ranges[j][2])))
        if layout is None or max(layout.size) > CANVAS_PX:
            continue
        colours = [cv2.imread(str(images / names[k]))[..., ::-1] for k in (i, j)]
        left, right = (cv2.cvtColor(c, cv2.COLOR_RGB2GRAY) for c in colours)
        found = disparities((left, right), *both, layout)
        for k, match, colour in ((0, found, colours[0]), (1, right_disparities(found), colours[1])):
            lens, pose = both[0][k], both[1][k]
            ideal = Camera(lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy)
            depth = depth_in_frame(match, ideal, pose, layout, right=bool(k))
            known = np.isfinite(depth)
            points = unproject(pixel_grid(lens.width, lens.height)[known], depth[known], ideal, pose)
            places, _ = project(points, lens, pose)
            columns, rows = np.clip(places.astype(int), 0, [lens.width - 1, lens.height - 1]).T
            clouds.append(Cloud(points, np.ascontiguousarray(colour[rows, columns])))
    if not clouds:
        raise RuntimeError("no pair could be rectified")
    whole = concatenate(clouds)
    ground = float(np.median([r[1] for r in ranges])) / lenses[0].fx
    return whole[voxel_thin(whole.points, ground)]


def main() -> None:
    flight, out = read_flight(sys.argv[1]), Path(sys.argv[2])
    out.mkdir(parents=True, exist_ok=True)
    model = reconstruct(flight, out, held="held" in sys.argv[3:])
    surface = np.array([p.xyz for p in model.points3D.values()])
    low, high = np.quantile(surface[:, 2], [0.02, 0.98])  # single points far below would ask for depths without end
    surface = surface[(surface[:, 2] >= low) & (surface[:, 2] <= high)]
    write_cloud(dense(flight.root / "images", cameras_of(model), surface), out / "cloud.laz")
    print(f"{model.num_reg_images()} images placed")


if __name__ == "__main__":
    main()
