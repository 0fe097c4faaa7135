"""Whole flights over scenes whose geometry is known, and the figures of a cloud on one of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, cKDTree
from truth.surface import Surface

from overfly.cloud import Cloud, read_cloud, voxel_thin
from overfly.flights import Flight, find_preset, fly, read_flight
from overfly.flights.launch import default_area
from overfly.flights.noise import NOISE, PoseNoise
from overfly.flights.plan import DEFAULT_TILT_DEG
from overfly.geodesy import enu_from_crs
from overfly.geometry import Array, pixel_grid, unproject
from overfly.metrics.functional import THRESHOLDS_M, harmonic
from overfly.scenes import STYLES, Scene, load_scene, make_scene

CELLS = {f"{path}-{overlap}": (path, overlap) for path in ("grid", "circular") for overlap in (30, 50, 80)}
ORBITS_M, BEYOND_M = 4.0, {"grid": 1.2, "double_grid": 2.0, "random": 2.0, "circular": 2.0}
"""As multiples of the altitude: side of the square that two orbits cover, and how much wider than it the scene is."""

SEED = 900
"""Of every landscape here: no training uses seeds this high."""

CAMERA, FRAMES, VOXEL_M = "p4p", 25, 0.1
JUDGED = 400_000
"""Points of a cloud, drawn at random, whose distance to the surface is measured; recall asks all of them."""

STEEP = 0.5
"""Surfaces whose normal rises less than this are walls, on which an error in height means nothing."""


@dataclass
class Case:
    """One flight: a style or scene file, flown on a path with an overlap at an altitude (metres).

    ``noise`` is that of the positions and angles in the images' metadata.
    """

    scene_name: str
    cell: str
    altitude: float
    work: Path
    noise: PoseNoise = NOISE["none"]

    @property
    def name(self) -> str:
        return f"{Path(self.scene_name).stem}_{self.cell}_{self.altitude:g}m"

    @property
    def folder(self) -> Path:
        return self.work / self.name

    @cached_property
    def scene(self) -> Scene:
        """The landscape; a style's reaches beyond the area flown."""
        if self.scene_name not in STYLES:
            return load_scene(self.scene_name)
        path, overlap = CELLS[self.cell]
        camera = find_preset(CAMERA).camera(800, 600)
        usual = default_area(path, camera, self.altitude, overlap, overlap, DEFAULT_TILT_DEG[path])
        size = (self.area or max(usual)) + BEYOND_M[path] * self.altitude
        return make_scene(self.scene_name, SEED, size_m=float(np.ceil(size)))

    @property
    def area(self) -> float | None:
        """Side in metres of the square flown over: two orbits; None is the usual 5 x 5 frames."""
        return ORBITS_M * self.altitude if CELLS[self.cell][0] == "circular" else None

    @cached_property
    def flight(self) -> Flight:
        """The flight folder, written if it is not there."""
        folder = self.folder / "flight"
        if not (folder / "transforms.json").is_file():
            path, overlap = CELLS[self.cell]
            options: dict[str, Any] = {"width": 800, "height": 600, "frames": FRAMES, "seed": SEED}
            options |= {"overlap": overlap, "altitude": self.altitude, "area_m": self.area, "noise": self.noise}
            fly(self.scene, out=folder, flight_path=path, **options)
        return read_flight(folder)

    @cached_property
    def cameras(self) -> tuple[list, list[Array]]:
        return [f.camera for f in self.flight.frames], [np.asarray(f.world_from_camera) for f in self.flight.frames]

    @cached_property
    def surface(self) -> Surface:
        return Surface(self.scene)

    @cached_property
    def reference(self) -> tuple[Array, Array]:
        """Points [M, 3] of the surface that images see, uniform by area, and the number of images [M]."""
        assert self.flight.reference is not None
        points, kept = read_cloud(self.flight.reference).points, self.folder / "views.npy"
        if not kept.is_file():
            np.save(kept, self.surface.count_views(points, *self.cameras))
        views = np.load(kept)
        return points[views > 0], views[views > 0]

    def interior(self, points: Array) -> NDArray[np.bool_]:
        """Whether each point [N, 3] lies straight below the area that the cameras stand around."""
        stands = np.array([pose[:2, 3] for pose in self.cameras[1]])
        return np.asarray(Delaunay(stands).find_simplex(points[:, :2]) >= 0)

    def exact_cloud(self) -> Cloud:
        """What the images see, from their true depth: one point per ground pixel."""
        parts = []
        for camera, pose in zip(*self.cameras, strict=True):
            depth = self.surface.renderer.depth(camera, pose)
            parts.append(unproject(pixel_grid(camera.width, camera.height)[depth > 0], depth[depth > 0], camera, pose))
        points = np.concatenate(parts)
        return Cloud(points[voxel_thin(points, self.altitude / self.cameras[0][0].fx)])

    def map_cloud(self, folder: Path) -> Cloud:
        """The cloud of a map in the cameras' frame."""
        cloud = read_cloud(folder / "cloud.laz")
        if cloud.epsg is None:
            return cloud
        assert self.flight.origin is not None
        return cloud.with_points(enu_from_crs(cloud.points, self.flight.origin, cloud.epsg, cloud.vertical_epsg))


def measure(case: Case, cloud: Cloud) -> dict[str, Any]:
    """All figures of a cloud in the cameras' frame; lengths in metres, the rest shares.

    ``seen_1``, ``seen_2``, ``seen_3`` (three or more), ``walls``, ``level``, ``interior`` (see
    :meth:`Case.interior`) and ``interior_level`` are parts of the reference, and ``recall_1_...``, ``recall_2_...`` the
    recall at 1 and 2 m there. ``error_...`` are distances from the cloud to surface that two or more
    images see, or one (``_seen_1``). ``within_k_sigma`` is the share of measured points, off the walls, whose error in
    height is below k times the stated ``sigma_m``.
    """
    thin = cloud[voxel_thin(cloud.points, VOXEL_M)]
    reference, seen_by = case.reference
    missing = cKDTree(thin.points).query(reference, distance_upper_bound=1.01 * max(THRESHOLDS_M))[0]
    thin = thin[np.random.default_rng(0).permutation(len(thin))[:JUDGED]]
    near = case.surface.nearest(thin.points)
    views = case.surface.count_views(near.place, *case.cameras)
    found: dict[str, Any] = {"points": len(cloud)}
    for t in THRESHOLDS_M:
        precision, recall = float((near.distance < t).mean()), float((missing < t).mean())
        found |= {f"fscore_{t:g}": harmonic(precision, recall), f"precision_{t:g}": precision, f"recall_{t:g}": recall}
    walls = case.surface.nearest(reference).upward <= STEEP
    parts = {"seen_1": seen_by == 1, "seen_2": seen_by == 2, "seen_3": seen_by >= 3, "walls": walls, "level": ~walls}
    parts |= {"interior": case.interior(reference), "interior_level": case.interior(reference) & ~walls}
    for label, mask in parts.items():
        found[label] = float(mask.mean())
        found |= {f"recall_{t}_{label}": share(missing < t, mask) for t in (1, 2)}
    for label, mask in (("", views >= 2), ("_seen_1", views == 1)):
        errors = near.distance[mask]
        found[f"error_median{label}"] = float(np.median(errors)) if len(errors) else None
        found[f"error_p90{label}"] = float(np.quantile(errors, 0.9)) if len(errors) else None
    if thin.predicted is not None and thin.sigma_m is not None:
        found["predicted"] = float(thin.predicted.mean())
        for label, mask in (("", ~thin.predicted), ("_predicted", thin.predicted)):
            level = mask & (near.upward > STEEP)
            for k in (1, 2):
                found[f"within_{k}_sigma{label}"] = share(near.rise < k * thin.sigma_m, level)
    return found


def share(true: NDArray[np.bool_], among: NDArray[np.bool_]) -> float | None:
    """The part of ``among`` where ``true`` holds; None of nothing."""
    return float(true[among].mean()) if among.any() else None


def text(row: dict[str, Any], *keys: str, digits: int = 2) -> str:
    """Figures of a row beside each other, a dash for each that it lacks."""
    return " / ".join("-" if row.get(k) is None else f"{row[k]:.{digits}f}" for k in keys)
