"""A planned flight as files for ground stations: KML, and the CSV of Litchi's Mission Hub."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

from overfly.files import replacing
from overfly.geodesy import Origin, geodetic_from_enu
from overfly.geometry import Array, gimbal_from_rotation

MOST_WAYPOINTS = 99
"""Of one mission, by DJI's older drones, which Litchi flies."""

ACTIONS = 15
LITCHI_COLUMNS = [
    "latitude", "longitude", "altitude(m)", "heading(deg)", "curvesize(m)", "rotationdir", "gimbalmode",
    "gimbalpitchangle",
    *[f"action{what}{k}" for k in range(1, ACTIONS + 1) for what in ("type", "param")],
    "altitudemode", "speed(m/s)", "poi_latitude", "poi_longitude", "poi_altitude(m)", "poi_altitudemode",
    "photo_timeinterval", "photo_distinterval",
]  # fmt: skip
"""As the Mission Hub exports them and litchiutilities.com/docs/litchiCsv.php describes them."""

NO_ACTION, TAKE_PHOTO = -1, 1
INTERPOLATED_GIMBAL, ABOVE_GROUND = 2, 1


@dataclass(frozen=True)
class Waypoint:
    """One place of a mission.

    Attributes:
        latitude, longitude: degrees.
        height: metres over ground.
        yaw_deg, pitch_deg: of the camera, convention of :mod:`overfly.geometry`.
        line: number of its line, from 0.
    """

    latitude: float
    longitude: float
    height: float
    yaw_deg: float
    pitch_deg: float
    line: int


def waypoints(poses: Array, strip: Sequence[int], origin: Origin) -> list[Waypoint]:
    """The cameras world_from_camera [n, 4, 4] over a ground at z = 0, in the order of the flight."""
    flat = poses[:, :3, 3] * [1, 1, 0]
    places = geodetic_from_enu(flat, origin)
    found = []
    for pose, (latitude, longitude, _), line in zip(poses, places, strip, strict=True):
        yaw, pitch, _ = gimbal_from_rotation(pose[:3, :3])
        found.append(Waypoint(float(latitude), float(longitude), float(pose[2, 3]), yaw, pitch, int(line)))
    return found


def line_ends(points: Sequence[Waypoint]) -> list[Waypoint]:
    """The first and the last waypoint of every line."""
    lines = np.array([p.line for p in points])
    edge = np.flatnonzero(np.diff(lines)) + 1
    first, last = [0, *edge], [*(edge - 1), len(points) - 1]
    return [points[i] for pair in zip(first, last) for i in dict.fromkeys(pair)]


def _whole_lines(ends: Sequence[Waypoint]) -> list[list[Waypoint]]:
    """Missions that fit: a cut between the two ends of a line would leave it without photographs."""
    pieces: list[list[Waypoint]] = [[]]
    for _, line in groupby(ends, key=lambda point: point.line):
        group = list(line)
        if len(pieces[-1]) + len(group) > MOST_WAYPOINTS:
            pieces.append([])
        pieces[-1] += group
    return pieces


def write_kml(path: Path, points: Sequence[Waypoint], name: str, outline: Array | None = None) -> None:
    """The track as a line, every photograph as a placemark; heights relative to the ground.

    Args:
        path: the file.
        points: in the order of the flight.
        name: of the document.
        outline: latitude, longitude [n, 2] of the area, drawn as a polygon on the ground.
    """

    def where(point: Waypoint) -> str:
        return f"{point.longitude:.8f},{point.latitude:.8f},{point.height:.2f}"

    parts = [
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2">\n<Document>\n'
        f"<name>{escape(name)}</name>\n"
    ]
    if outline is not None:
        ring = " ".join(f"{lon:.8f},{lat:.8f},0" for lat, lon in [*outline, outline[0]])
        parts.append(
            "<Placemark><name>area</name><Polygon><tessellate>1</tessellate><outerBoundaryIs><LinearRing>"
            f"<coordinates>{ring}</coordinates></LinearRing></outerBoundaryIs></Polygon></Placemark>\n"
        )
    parts.append(
        "<Placemark><name>flight</name><LineString><altitudeMode>relativeToGround</altitudeMode>"
        f"<coordinates>{' '.join(where(p) for p in points)}</coordinates></LineString></Placemark>\n"
        "<Folder><name>photographs</name>\n"
    )
    for number, point in enumerate(points, start=1):
        data = "".join(
            f'<Data name="{key}"><value>{value:.1f}</value></Data>'
            for key, value in (("heading_deg", point.yaw_deg), ("gimbal_pitch_deg", point.pitch_deg))
        )
        parts.append(
            f"<Placemark><name>{number}</name><ExtendedData>{data}</ExtendedData><Point>"
            f"<altitudeMode>relativeToGround</altitudeMode><coordinates>{where(point)}</coordinates></Point></Placemark>\n"
        )
    parts.append("</Folder>\n</Document>\n</kml>\n")
    with replacing(path) as temporary:
        temporary.write_text("".join(parts), encoding="utf-8")


def write_litchi(path: Path, points: Sequence[Waypoint], *, speed: float, step_m: float | None) -> list[Path]:
    """Litchi's CSV: heights above ground, the gimbal turned from waypoint to waypoint.

    Up to :data:`MOST_WAYPOINTS` photographs are waypoints, each with the action to take one. Longer flights along lines
    have their ends as waypoints and take photographs every ``step_m``, a line of one photograph takes it there; what is
    still too long is cut between lines, or anywhere in a flight without them, into missions name_1.csv, name_2.csv, ...

    Returns:
        The files written.
    """
    by_distance = len(points) > MOST_WAYPOINTS and step_m is not None
    if by_distance:
        pieces = _whole_lines(line_ends(points))
    else:
        pieces = [list(points[i : i + MOST_WAYPOINTS]) for i in range(0, len(points), MOST_WAYPOINTS)]
    names = [path] if len(pieces) == 1 else [path.with_stem(f"{path.stem}_{k + 1}") for k in range(len(pieces))]
    for name, piece in zip(names, pieces, strict=True):
        buffer = io.StringIO()
        writer = csv.writer(buffer, lineterminator="\r\n")
        writer.writerow(LITCHI_COLUMNS)
        for i, point in enumerate(piece):
            on_line = by_distance and i + 1 < len(piece) and piece[i + 1].line == point.line
            alone = by_distance and sum(p.line == point.line for p in piece) == 1
            actions = [NO_ACTION, 0] * ACTIONS
            if not by_distance or alone:
                actions[:2] = TAKE_PHOTO, 0
            interval = f"{step_m:.2f}" if on_line and step_m is not None else "-1"
            writer.writerow(
                [
                    f"{point.latitude:.8f}", f"{point.longitude:.8f}", f"{point.height:.2f}",
                    f"{point.yaw_deg % 360:.1f}", 0, 0, INTERPOLATED_GIMBAL, round(point.pitch_deg), *actions,
                    ABOVE_GROUND, f"{speed:.1f}", 0, 0, 0, 0, -1, interval,
                ]
            )  # fmt: skip
        with replacing(name) as temporary:
            temporary.write_text(buffer.getvalue(), encoding="utf-8", newline="")
    return names
