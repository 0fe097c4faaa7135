"""The point cloud: points with colour, confidence and origin, and its files (PLY, LAS, LAZ).

PLY carries the CRS as a comment ``epsg 32615``, LAS and LAZ in their header. Coordinates are stored as float64 (PLY) or
on a 1 mm grid (LAS, LAZ), so that UTM coordinates keep their millimetres. Confidence, sigma_m, views and predicted
are properties of these names in PLY and extra dimensions in LAS.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from overfly.errors import InputError
from overfly.files import existing, replacing
from overfly.geodesy import crs_code, epsg_codes
from overfly.ply import read_ply, write_ply_tables

SUFFIXES = (".ply", ".las", ".laz")
EXTRAS: dict[str, str] = {"confidence": "f4", "sigma_m": "f4", "views": "u1", "predicted": "u1"}
"""The optional attributes that files keep, and their types there."""

PIECE = 1_000_000
"""Points that are encoded for a file at once."""


@dataclass(frozen=True)
class Cloud:
    """Points in one frame of reference; every array has the same first dimension N.

    Attributes:
        points: [N, 3] float64, metres (local ENU, or easting, northing, height where ``epsg`` is set).
        colors: [N, 3] uint8 RGB, or None.
        confidence: [N] float32 in 0..1, or None.
        sigma_m: [N] float32, standard deviation of the height (of points on walls: across them), metres, or None.
        views: [N] uint8, number of frames that measured the point, or None.
        predicted: [N] bool, True where fewer than two frames support the point, or None.
        epsg: projected CRS of the points, None for a local frame.
        vertical_epsg: vertical CRS of their heights, None where they are above the ellipsoid or not said.
    """

    points: NDArray[np.float64]
    colors: NDArray[np.uint8] | None = None
    confidence: NDArray[np.float32] | None = None
    sigma_m: NDArray[np.float32] | None = None
    views: NDArray[np.uint8] | None = None
    predicted: NDArray[np.bool_] | None = None
    epsg: int | None = None
    vertical_epsg: int | None = None

    def __len__(self) -> int:
        return len(self.points)

    @property
    def crs(self) -> str | None:
        """The CRS as PROJ calls it, ``EPSG:32632``, with a vertical one ``EPSG:32632+5773``; None of a local frame."""
        return None if self.epsg is None else crs_code(self.epsg, self.vertical_epsg)

    def __getitem__(self, index: NDArray | slice) -> Cloud:
        """The points that ``index`` (a mask, integers or a slice) selects, with all their attributes."""
        arrays: dict[str, Any] = {name: getattr(self, name) for name in ARRAYS}
        arrays = {name: None if array is None else array[index] for name, array in arrays.items()}
        return replace(self, **arrays)

    def with_points(self, points: NDArray, epsg: int | None = None, vertical_epsg: int | None = None) -> Cloud:
        """The same attributes at other coordinates, in another CRS."""
        return replace(self, points=np.asarray(points, np.float64), epsg=epsg, vertical_epsg=vertical_epsg)


ARRAYS = tuple(f.name for f in fields(Cloud) if not f.name.endswith("epsg"))
"""The attributes that have a value for each point."""


def voxel_thin(points: NDArray, size_m: float) -> NDArray[np.int64]:
    """Indices of one point (the first) per cubic voxel of ``size_m``, counted from the frame's origin; sorted."""
    keys = np.floor(points / size_m).astype(np.int64)
    keys -= keys.min(0)
    spans = [int(span) + 1 for span in keys.max(0)]
    if spans[0] * spans[1] * spans[2] >= 2**63:  # an outlier far away: the flat key would overflow
        return np.sort(np.unique(keys, axis=0, return_index=True)[1])
    flat = (keys[:, 0] * spans[1] + keys[:, 1]) * spans[2] + keys[:, 2]
    return np.sort(np.unique(flat, return_index=True)[1])


def concatenate(clouds: list[Cloud]) -> Cloud:
    """All points of several clouds that share a frame of reference; attributes missing from any one are dropped."""
    if len({c.crs for c in clouds}) > 1:
        raise InputError(
            f"Clouds in different CRS cannot be joined: {', '.join(sorted({str(c.crs) for c in clouds}))}."
        )
    joined: dict[str, Any] = {}
    for name in ARRAYS:
        values = [getattr(c, name) for c in clouds]
        joined[name] = None if any(v is None for v in values) else np.concatenate(values)
    return replace(clouds[0], **joined)


def read_cloud(path: Path | str) -> Cloud:
    """Read a .ply (its vertices, if it is a mesh), .las or .laz file.

    Raises:
        InputError: the file is missing, of another kind, broken, empty, holds NaN or is not in metres.
    """
    path = existing(path, "The cloud", SUFFIXES)
    cloud = _read_ply(path) if path.suffix.lower() == ".ply" else _read_las(path)
    if not len(cloud):
        raise InputError(f"The cloud {path} has no points: give a file with at least one.")
    if bad := int((~np.isfinite(cloud.points)).any(axis=1).sum()):
        raise InputError(f"{bad} of the {len(cloud)} points of {path} are NaN or infinite: remove them first.")
    return cloud


def write_cloud(cloud: Cloud, path: Path | str) -> None:
    """Write .ply, .las or .laz (by the suffix), atomically; every attribute and the CRS are kept.

    Raises:
        InputError: the suffix is unknown, the cloud is empty or holds NaN.
    """
    low = cloud.points.min(0) if len(cloud) else np.zeros(3)
    write_clouds([cloud], path, count=len(cloud), low=low)


def write_clouds(clouds: Iterable[Cloud], path: Path | str, *, count: int, low: NDArray) -> None:
    """Write the parts of one cloud into one file, as :func:`write_cloud` does; one part at a time is in memory.

    Args:
        clouds: parts with the same attributes and CRS.
        path: .ply, .las or .laz.
        count: points of all parts.
        low: [3], the smallest coordinates of all parts.

    Raises:
        InputError: the suffix is unknown, there is no point, or a coordinate is NaN.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"A cloud cannot be written as {path.name}: end the name in {', '.join(SUFFIXES)}.")
    if not count:
        raise InputError(f"The cloud for {path} has no points, so it was not written.")
    if not np.isfinite(low).all():
        raise InputError(_NAN.format(path))
    write = _write_ply if path.suffix.lower() == ".ply" else _write_las
    write(_checked(clouds, path), path, count, low)


_NAN = "The cloud for {} has NaN or infinite coordinates, so it was not written."


def _checked(clouds: Iterable[Cloud], path: Path) -> Iterator[Cloud]:
    """The parts that hold points, in pieces that are encoded at once."""
    for cloud in clouds:
        for start in range(0, len(cloud), PIECE):
            piece = cloud[start : start + PIECE]
            if not np.isfinite(piece.points).all():
                raise InputError(_NAN.format(path))
            yield piece


def _read_ply(path: Path) -> Cloud:
    ply = read_ply(path)
    columns = ply.columns
    if not {"x", "y", "z"} <= columns.keys():
        raise InputError(f"{path} has no x, y and z: give a point cloud or a mesh.")
    colors = None
    for names in (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue")):
        if set(names) <= columns.keys():
            colors = np.stack([_as_uint8(columns[name]) for name in names], axis=1)
            break
    said = {c.split()[0]: c.split()[1] for c in ply.comments if len(c.split()) == 2}
    epsg, vertical_epsg = (int(v) if (v := said.get(k, "")).isdigit() else None for k in ("epsg", "vertical_epsg"))
    return Cloud(
        np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1),
        colors,
        **_attributes({name: columns[name] for name in EXTRAS if name in columns}),
        epsg=epsg,
        vertical_epsg=vertical_epsg,
    )


def _write_ply(clouds: Iterator[Cloud], path: Path, count: int, low: NDArray) -> None:
    first = next(clouds)
    tables = (_columns(cloud) for cloud in chain([first], clouds))
    comments = [f"{k} {code}" for k in ("epsg", "vertical_epsg") if (code := getattr(first, k))]
    write_ply_tables(path, tables, count, comments=comments)


def _columns(cloud: Cloud) -> dict[str, NDArray]:
    columns = dict(zip("xyz", np.asarray(cloud.points, np.float64).T, strict=True))
    if cloud.colors is not None:
        columns |= dict(zip(("red", "green", "blue"), np.asarray(cloud.colors, np.uint8).T, strict=True))
    for name, kind in EXTRAS.items():
        if (values := getattr(cloud, name)) is not None:
            columns[name] = np.asarray(values).astype(kind)
    return columns


def _read_las(path: Path) -> Cloud:
    import laspy
    import lazrs

    try:
        las = laspy.read(path)
    except (laspy.LaspyException, lazrs.LazrsError, ValueError, OSError, EOFError, OverflowError) as error:
        raise InputError(
            f"{path} is not a readable LAS file ({error}): write it again or give another file."
        ) from error
    if len(las.points) != las.header.point_count:
        raise InputError(
            f"{path} is cut off: {len(las.points)} of its {las.header.point_count} points are there; copy it again."
        )
    names = set(las.point_format.dimension_names)
    colors = None
    if {"red", "green", "blue"} <= names:
        deep = np.stack([las.red, las.green, las.blue], axis=1)
        # The standard asks for 16 bits, yet many programs write 8-bit values.
        colors = (deep >> 8 if deep.size and deep.max() > 255 else deep).astype(np.uint8)
        colors = colors if deep.any() else None
    epsg, vertical_epsg = _crs(las.header, path)
    return Cloud(
        np.stack([np.asarray(las.x), np.asarray(las.y), np.asarray(las.z)], axis=1).astype(np.float64),
        colors,
        **_attributes({name: np.asarray(las[name]) for name in EXTRAS if name in names}),
        epsg=epsg,
        vertical_epsg=vertical_epsg,
    )


def _crs(header: Any, path: Path) -> tuple[int | None, int | None]:
    """The EPSG codes in a LAS header, horizontal and vertical; None without a CRS or code: then the frame is local."""
    from pyproj.exceptions import CRSError

    try:
        crs = header.parse_crs()
    except CRSError as error:
        raise InputError(f"The CRS in the header of {path} is not readable ({error}): write it again.") from error
    if crs is None:
        return None, None
    if units := {a.unit_name for a in crs.axis_info} - {"metre", "meter"}:
        raise InputError(
            f"{path} is in {crs.name}, whose unit is {', '.join(sorted(units))}; Overfly works in metres: "
            "reproject it first, for example with `pdal translate in.laz out.laz reprojection "
            "--filters.reprojection.out_srs=EPSG:32610` and the UTM zone of the place."
        )
    return epsg_codes(crs)


def _write_las(clouds: Iterator[Cloud], path: Path, count: int, low: NDArray) -> None:
    import laspy
    from pyproj import CRS

    first = next(clouds)
    header = laspy.LasHeader(point_format=6 if first.colors is None else 7, version="1.4")
    header.scales = np.full(3, 0.001)
    header.offsets = np.floor(low)
    header.generating_software = "Overfly"
    if first.crs:
        header.add_crs(CRS.from_user_input(first.crs))
    kept = [name for name in EXTRAS if getattr(first, name) is not None]
    header.add_extra_dims([laspy.ExtraBytesParams(name, EXTRAS[name]) for name in kept])
    with replacing(path) as temporary, laspy.open(temporary, mode="w", header=header) as las:
        for cloud in chain([first], clouds):
            record = laspy.ScaleAwarePointRecord.zeros(len(cloud), header=header)
            record.x, record.y, record.z = np.asarray(cloud.points, np.float64).T
            if cloud.colors is not None:
                record.red, record.green, record.blue = np.asarray(cloud.colors, np.uint16).T * 257
            for name in kept:
                record[name] = np.asarray(getattr(cloud, name)).astype(EXTRAS[name])
            las.write_points(record)


def _as_uint8(values: NDArray) -> NDArray[np.uint8]:
    """Colours as uint8; fractions of one, in floating-point files, are scaled."""
    if np.issubdtype(values.dtype, np.floating) and (not values.size or values.max() <= 1):
        values = np.rint(values * 255)
    if values.dtype.itemsize == 2 and values.size and values.max() > 255:
        values = values >> 8
    return np.clip(values, 0, 255).astype(np.uint8)


def _attributes(columns: dict[str, NDArray]) -> dict[str, NDArray]:
    """File columns in the types of :class:`Cloud`."""
    return {k: v.astype(bool) if k == "predicted" else v.astype(EXTRAS[k]) for k, v in columns.items()}
