"""The ground that a flight shall cover: a size in metres, a place with a size, or a polygon from a file."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import shapely

from overfly.errors import InputError
from overfly.files import existing
from overfly.geodesy import Origin, enu_from_geodetic
from overfly.geometry import Array

ALLOWED = (
    "give WIDTHxHEIGHT in metres such as 300x200, LATITUDE,LONGITUDE,WIDTH,HEIGHT, or a .kml, .geojson or .json file "
    "with a polygon"
)
LARGEST_M = 20_000.0


@dataclass(frozen=True, eq=False)
class AskedArea:
    """A polygon in local metres around its own middle.

    Attributes:
        outline: x, y [n, 2] east and north of the middle.
        origin: where the middle lies; None where the user gave only a size.
    """

    outline: Array
    origin: Origin | None

    @property
    def polygon(self) -> shapely.Polygon:
        return shapely.Polygon(self.outline)


def read_area(text: str, at: str | None) -> AskedArea:
    """The area of ``--area``, its middle at ``--at`` "latitude,longitude" if that is given.

    Raises:
        InputError: neither a size, nor a place with a size, nor a file with a polygon.
    """
    place = None if at is None else read_place(at)
    if size := re.fullmatch(r"\s*([0-9.]+)\s*[x×*]\s*([0-9.]+)\s*(?:m)?\s*", text, re.IGNORECASE):
        return AskedArea(_rectangle(text, *(_number(v) for v in size.groups())), place)
    if re.fullmatch(r"[^,]+(,[^,]+){3}", text) and not Path(text).exists():
        latitude, longitude, width, height = (_number(v) for v in text.split(","))
        if place is not None:
            raise InputError("The area names its place already: leave --at out, or give --area WIDTHxHEIGHT.")
        if not np.isfinite([latitude, longitude, width, height]).all():
            raise InputError(f"--area {text!r} is not understood: {ALLOWED}.")
        return AskedArea(_rectangle(text, width, height), Origin(latitude, longitude))
    if Path(text).suffix.lower() not in (".kml", ".geojson", ".json"):
        raise InputError(f"--area {text!r} is not understood: {ALLOWED}.")
    if place is not None:
        raise InputError("The polygon's file names its place already: leave --at out.")
    path = existing(text, "The area", (".kml", ".geojson", ".json"))
    corners = _kml(path) if path.suffix.lower() == ".kml" else _geojson(path)
    middle = (corners.min(0) + corners.max(0)) / 2
    if not (np.abs(corners[:, 0]) <= 90).all() or not (np.abs(corners[:, 1]) <= 180).all():
        raise InputError(f"The polygon of {path} is not in degrees: save it in WGS 84, longitude before latitude.")
    origin = Origin(float(middle[0]), float(middle[1]))
    outline = enu_from_geodetic(np.column_stack([corners, np.zeros(len(corners))]), origin)[:, :2]
    polygon = shapely.Polygon(outline)
    if not polygon.is_valid or polygon.area < 1:
        raise InputError(f"The polygon of {path} crosses itself or is empty: draw it again in one sweep.")
    if np.ptp(outline, axis=0).max() > LARGEST_M:
        raise InputError(f"The polygon of {path} is more than {LARGEST_M / 1000:g} km wide: give a part of it.")
    return AskedArea(outline, origin)


def read_place(text: str) -> Origin:
    """An origin from "latitude,longitude" in degrees.

    Raises:
        InputError: anything else.
    """
    values = [_number(v) for v in text.split(",")]
    if len(values) != 2 or not np.isfinite(values).all():
        raise InputError(f"--at {text!r} is not a place: give LATITUDE,LONGITUDE in degrees, such as 46.01,8.02.")
    return Origin(values[0], values[1])


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")


def _rectangle(text: str, width: float, height: float) -> Array:
    if not (1 <= width <= LARGEST_M and 1 <= height <= LARGEST_M):
        raise InputError(f"--area {text!r} is not possible: give sides from 1 to {LARGEST_M:g} metres.")
    return np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [width / 2, height / 2]


def _kml(path: Path) -> Array:
    """Latitude, longitude [n, 2] of the first polygon's outer border."""
    try:
        root = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise InputError(f"{path} is no KML file ({error}): export the polygon again.") from error
    for polygon in root.iter():
        if polygon.tag.rsplit("}", 1)[-1] == "Polygon":
            for element in polygon.iter():
                if element.tag.rsplit("}", 1)[-1] == "coordinates":
                    points = [[_number(v) for v in part.split(",")[:2]] for part in (element.text or "").split()]
                    return _corners(path, points)
    raise InputError(f"{path} holds no polygon: draw one around the area and export it.")


def _geojson(path: Path) -> Array:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise InputError(f"{path} is no GeoJSON file ({error}): export the polygon again.") from error
    waiting = [content]
    while waiting:
        item = waiting.pop(0)
        if not isinstance(item, dict):
            continue
        coordinates = item.get("coordinates")
        if item.get("type") == "Polygon" and coordinates:
            return _corners(path, coordinates[0])
        if item.get("type") == "MultiPolygon" and coordinates:
            return _corners(path, coordinates[0][0])
        waiting += [item.get("geometry"), *item.get("features", []), *item.get("geometries", [])]
    raise InputError(f"{path} holds no polygon: draw one around the area and export it.")


def _corners(path: Path, points: list) -> Array:
    """Latitude, longitude [n, 2] without the repeated first corner."""
    try:
        corners = np.array([[float(p[1]), float(p[0])] for p in points])
    except (TypeError, ValueError, IndexError):
        corners = np.zeros((0, 2))
    if len(corners) > 1 and np.array_equal(corners[0], corners[-1]):
        corners = corners[:-1]
    if len(corners) < 3 or not np.isfinite(corners).all():
        raise InputError(f"The polygon of {path} has less than three corners: draw it again.")
    return corners
