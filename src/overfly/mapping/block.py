"""The block: the frames of a flight whose cameras are known, in one frame of reference, and how well they fit."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from overfly.errors import InputError
from overfly.flights import Flight, Frame
from overfly.geodesy import Origin, enu_from_geodetic
from overfly.geometry import Array, Camera
from overfly.mapping.placing import far_off
from overfly.mapping.survey import Precision, Survey, precision_from, survey_from


@dataclass(frozen=True, eq=False)
class Block:
    """Cameras of one flight.

    Attributes:
        frames: the registered frames, each with camera and pose, in the order of the flight.
        origin: where the local frame stands on the Earth, None if unknown.
        cameras_from: "estimated", or the file they were read from.
        metric: whether lengths are metres.
        reprojection_px: mean reprojection error, None if unknown.
        points: sparse surface points [M, 3] in the block's frame, or None.
        survey: what ground control says, None where the flight has none or it was not asked.
        precision: standard deviations of the cameras, None of given cameras.
        links: (i, j, number of common points) of frames i < j.
        antenna: where GPS is measured in the cameras' axes [3], metres: lever arm, and delay times speed.
        held_by_gps: names of frames that only GPS connects to the others.
        warnings: sentences for the user.
    """

    frames: list[Frame]
    origin: Origin | None
    cameras_from: str
    metric: bool
    reprojection_px: float | None = None
    points: Array | None = None
    survey: Survey | None = None
    precision: Precision | None = None
    links: list[tuple[int, int, int]] = field(default_factory=list)
    antenna: tuple[float, float, float] | None = None
    held_by_gps: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @property
    def cameras(self) -> list[Camera]:
        return [frame.camera for frame in self.frames if frame.camera is not None]

    @property
    def poses(self) -> Array:
        """world_from_camera [n, 4, 4]."""
        return np.stack([f.world_from_camera for f in self.frames if f.world_from_camera is not None])

    @property
    def names(self) -> list[str]:
        return [frame.name for frame in self.frames]

    def gps_positions(self, frames: Sequence[Frame] | None = None) -> dict[str, Array]:
        """Local positions [3] by the frames' own GPS; height NaN where GPS has none. Empty without an origin."""
        found: dict[str, Array] = {}
        for frame in self.frames if frames is None else frames:
            if self.origin is not None and (gps := frame.gps) is not None:
                height = self.origin.height if gps.altitude is None else gps.altitude
                found[frame.name] = enu_from_geodetic([[gps.latitude, gps.longitude, height]], self.origin)[0]
                if gps.altitude is None:
                    found[frame.name][2] = np.nan
        return found

    def gps_residuals(self) -> Array:
        """GPS minus camera [n, 3], metres, NaN where unknown; antenna and known shift against control taken out."""
        told = self.gps_positions()
        nothing = np.full(3, np.nan)
        away = np.array([told.get(name, nothing) for name in self.names]) - self.poses[:, :3, 3]
        if self.antenna is not None:
            away -= self.poses[:, :3, :3] @ np.array(self.antenna)
        if self.survey is not None and self.survey.gps_shift_m is not None:
            away -= self.survey.gps_shift_m
        return away

    def gps_far_off(self) -> list[str]:
        """Names of the frames whose GPS is much further from its camera than that of most."""
        distance = np.linalg.norm(self.gps_residuals()[:, :2], axis=1)
        if np.isnan(distance).all():
            return []
        with np.errstate(invalid="ignore"):
            return [self.names[i] for i in np.flatnonzero(far_off(distance)).tolist()]

    def gps_rms(self) -> dict[str, float | None] | None:
        """RMS distance of the cameras from their own GPS; None without GPS.

        The antenna and a constant shift in height are taken out, and one in the plane where ground control tells it;
        positions that are far off (:meth:`gps_far_off`) do not count.
        """
        away = self.gps_residuals()
        if np.isnan(away[:, :2]).all():
            return None
        far = set(self.gps_far_off())
        away[[name in far for name in self.names]] = np.nan
        rises = away[np.isfinite(away[:, 2]), 2]
        vertical = float(np.sqrt(np.mean((rises - np.median(rises)) ** 2))) if len(rises) else None
        return {
            "horizontal_m": round(float(np.sqrt(np.nanmean((away[:, :2] ** 2).sum(1)))), 3),
            "vertical_m": None if vertical is None else round(vertical, 3),
        }


def checked(block: Block, flight: Flight) -> Block:
    """The block, if a map can be made from it."""
    if len(block.frames) < 2:
        which = f" ({block.frames[0].name})" if block.frames else ""
        raise InputError(
            f"{len(block.frames)} of {len(flight)} images{which} could be placed, and a map needs at least two: "
            "check that neighbouring images show the same ground (30 % overlap at the least) and are sharp."
        )
    return block


def write_block(block: Block, folder: Path) -> None:
    """Keep a block in a folder."""
    content = {
        "frames": {
            frame.name: {"camera": camera.to_dict(), "world_from_camera": pose.tolist()}
            for frame, camera, pose in zip(block.frames, block.cameras, block.poses, strict=True)
        },
        "origin": None if block.origin is None else asdict(block.origin),
        "cameras_from": block.cameras_from,
        "metric": block.metric,
        "reprojection_px": block.reprojection_px,
        "survey": None if block.survey is None else asdict(block.survey),
        "precision": None if block.precision is None else block.precision.to_json(),
        "links": block.links,
        "antenna": block.antenna,
        "held_by_gps": block.held_by_gps,
        "warnings": block.warnings,
    }
    (folder / "block.json").write_text(json.dumps(content))
    if block.points is not None:
        np.save(folder / "points.npy", block.points)


def read_block(folder: Path, flight: Flight) -> Block:
    """The block that :func:`write_block` kept of this flight."""
    content: dict[str, Any] = json.loads((folder / "block.json").read_text())
    known = content["frames"]
    frames = [
        replace(
            frame,
            camera=Camera(**known[frame.name]["camera"]),
            world_from_camera=np.array(known[frame.name]["world_from_camera"]),
        )
        for frame in flight.frames
        if frame.name in known
    ]
    points = folder / "points.npy"
    return Block(
        frames,
        None if content["origin"] is None else Origin(**content["origin"]),
        content["cameras_from"],
        content["metric"],
        content["reprojection_px"],
        np.load(points) if points.is_file() else None,
        survey_from(content["survey"]),
        precision_from(content["precision"]),
        [(i, j, count) for i, j, count in content["links"]],
        None if content["antenna"] is None else tuple(content["antenna"]),
        content["held_by_gps"],
        content["warnings"],
    )
