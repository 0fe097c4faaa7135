"""ODM's side files: ``geo.txt`` (where images were taken) and ``gcp_list.txt`` (ground control points)."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

from overfly.errors import InputError
from overfly.flights.flight import ControlPoint, Gps


@dataclass(frozen=True)
class Geolocation:
    """One line of geo.txt."""

    gps: Gps
    gimbal: tuple[float, float, float] | None


def read_geo(path: Path) -> dict[str, Geolocation]:
    """Image name -> position (and angles), from ``name x y [z] [yaw pitch roll] [horizontal vertical accuracy]``.

    The first line is the CRS: an EPSG code, a PROJ string, or "WGS84 UTM 16N". ODM's pitch is 0 straight down; three
    zeros mean that the angles are not known (https://docs.opendronemap.org/geo/).

    Raises:
        InputError: an unknown CRS, or a line that cannot be read; the sentence names it.
    """
    lines = _lines(path)
    if not lines:
        raise InputError(f"{path} is empty: its first line is the CRS, for instance EPSG:4326.")
    crs, result = lines[0][1], {}
    rows = []
    for number, line in lines[1:]:
        name, *rest = line.split()
        values = _numbers(rest[:8], path, number)
        if len(values) < 2:
            raise InputError(f"Line {number} of {path} has no position: write image name, x, y and z.")
        rows.append((name, values))
    longitude, latitude = _geographic(crs, [v[0] for _, v in rows], [v[1] for _, v in rows], path)
    for (name, values), lon, lat in zip(rows, longitude, latitude):
        accuracy = [v if v > 0 else None for v in values[6:8]] + [None, None]
        gimbal = None
        if len(values) >= 6 and any(values[3:6]):
            gimbal = (values[3], values[4] - 90, values[5])
        altitude = values[2] if len(values) > 2 else None
        result[name] = Geolocation(Gps(lat, lon, altitude, accuracy[0], accuracy[1]), gimbal)
    return result


def read_gcps(path: Path) -> list[ControlPoint]:
    """Points of ``x y z u v image [name]`` lines under a CRS line; lines with equal x, y, z (and name) are one point.

    Raises:
        InputError: a line that cannot be read; the sentence names it.
    """
    lines = _lines(path)
    if not lines:
        raise InputError(f"{path} is empty: its first line is the CRS, for instance EPSG:32617.")
    crs = lines[0][1]
    points: dict[tuple, ControlPoint] = {}
    for number, line in lines[1:]:
        fields = line.split()
        values = _numbers(fields[:5], path, number)
        if len(fields) < 6:
            raise InputError(f"Line {number} of {path} is too short: write x, y, z, column, row, image name.")
        name = fields[6] if len(fields) > 6 else ""
        key = (*values[:3], name)
        if key not in points:
            points[key] = ControlPoint(name or f"gcp{len(points) + 1}", (values[0], values[1], values[2]), crs, {})
        points[key].pixels[fields[5]] = (values[3], values[4])
    return list(points.values())


def crs_name(text: str) -> str:
    """The CRS line as pyproj understands it: "WGS84 UTM 16N" becomes an EPSG code."""
    utm = re.fullmatch(r"WGS84\s+UTM\s+(\d{1,2})\s*([NS])", text.strip(), re.IGNORECASE)
    if utm:
        return f"EPSG:{(32600 if utm.group(2).upper() == 'N' else 32700) + int(utm.group(1))}"
    return text.strip()


def _geographic(crs: str, x: list[float], y: list[float], path: Path) -> tuple[list[float], list[float]]:
    from pyproj import Transformer
    from pyproj.exceptions import ProjError

    try:
        transformer = Transformer.from_crs(crs_name(crs), "EPSG:4326", always_xy=True)
        lon, lat = transformer.transform(x, y, errcheck=True)
    except ProjError as error:
        raise InputError(
            f"The first line of {path} must be a CRS that fits the coordinates (EPSG:4326, WGS84 UTM 16N or a PROJ "
            f"string), not {crs!r} ({str(error).splitlines()[0]})."
        ) from error
    return list(lon), list(lat)


def _lines(path: Path) -> list[tuple[int, str]]:
    text = path.read_text(encoding="utf-8-sig", errors="replace")
    numbered = [(i, line.strip()) for i, line in enumerate(text.splitlines(), start=1)]
    return [(i, line) for i, line in numbered if line and not line.startswith("#")]


def _numbers(fields: list[str], path: Path, number: int) -> list[float]:
    values = []
    for field in fields:
        try:
            value = float(field)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise InputError(f"Line {number} of {path}: {field!r} is not a number; see the ODM format of this file.")
        values.append(value)
    return values
