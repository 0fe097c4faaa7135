"""Ground control points: which are usable, where the block sees them, and what holds it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from overfly.errors import InputError
from overfly.flights import ControlPoint, Flight
from overfly.geodesy import Origin, enu_from_geodetic, epsg_codes, vertical_crs
from overfly.geometry import Array, fit_similarity, transform
from overfly.mapping.bundle import Bundle
from overfly.mapping.clicks import Control

if TYPE_CHECKING:
    from pyproj import Transformer

FEWEST = 3
FEWEST_TO_CHECK = 4
FEWEST_TO_TELL_HEIGHTS = 5
"""Controls from which heights and positions get a spread of their own."""

CHECK_SHARE = 0.25

FAR_OFF_M = 8.0
"""A point at least this far from the common shift against GPS is wrong."""

MOST_TRIPLES = 1500


def control_origin(points: Sequence[ControlPoint]) -> Origin | None:
    """An origin in the middle of the controls, in their own CRS; None if there are less than three."""
    if len(points) < FEWEST:
        return None
    latitude, longitude, height = (float(v) for v in np.median(control_places(points), axis=0))
    return Origin(latitude, longitude, height, *control_crs(points[0].crs))


def control_crs(text: str) -> tuple[int | None, int | None]:
    """EPSG codes of the projected CRS in metres and of the vertical CRS of a control file's first line.

    None where there is none; without a vertical one heights are taken as they are.
    """
    from pyproj import CRS

    from overfly.flights.odm import crs_name

    crs = CRS.from_user_input(crs_name(text))
    horizontal, vertical = epsg_codes(crs)
    metres = crs.is_projected and all(axis.unit_name == "metre" for axis in crs.axis_info[:2])
    return horizontal if metres else None, vertical


def control_places(points: Sequence[ControlPoint]) -> Array:
    """Latitude, longitude and height [N, 3] of control points; heights over the ellipsoid where their CRS tells that.

    Raises:
        InputError: the CRS does not fit the coordinates, or PROJ lacks the grid of its vertical part.
    """
    # Finding the way through a vertical CRS takes PROJ a second or two: once for all points of a file.
    ways = {crs: _way(crs) for crs in {point.crs for point in points}}
    return np.array([_place(point, *ways[point.crs]) for point in points]).reshape(-1, 3)


def _way(text: str) -> tuple[Transformer, int | None]:
    """From a control file's CRS to longitude and latitude, and height where it has a vertical CRS; its code."""
    from pyproj import CRS, Transformer
    from pyproj.exceptions import ProjError

    from overfly.flights.odm import crs_name

    try:
        crs = CRS.from_user_input(crs_name(text))
        if not crs.is_compound:
            return Transformer.from_crs(crs, "EPSG:4326", always_xy=True), None
        vertical = epsg_codes(crs)[1]
        try:
            vertical_crs(str(vertical))
        except InputError as error:
            lacking = str(error).split(", or map with")[0].rstrip(".")
            raise InputError(
                f"The first line of gcp_list.txt, {text}, asks for it: {lacking[0].lower()}{lacking[1:]}; or write it "
                "without the vertical CRS and the heights above the ellipsoid, or map with --control none."
            ) from error
        return Transformer.from_crs(crs, "EPSG:4979", always_xy=True, allow_ballpark=False, only_best=True), vertical
    except ProjError as error:
        raise _unfit(text, error) from error


def _place(point: ControlPoint, way: Transformer, vertical: int | None) -> tuple[float, float, float]:
    from pyproj.exceptions import ProjError

    x, y, z = point.position
    try:
        if vertical is None:
            longitude, latitude = way.transform(x, y, errcheck=True)
            return latitude, longitude, z
        longitude, latitude, height = way.transform(x, y, z, errcheck=True)
    except ProjError as error:
        if vertical is None:
            raise _unfit(point.crs, error) from error
        raise InputError(
            f"The height of {point.name} in gcp_list.txt cannot be taken from EPSG:{vertical} to the ellipsoid "
            f"({str(error).splitlines()[0]}): check its coordinates and the CRS."
        ) from error
    return latitude, longitude, height


def _unfit(crs: str, error: Exception) -> InputError:
    return InputError(
        f"The first line of gcp_list.txt must be a CRS that fits the coordinates, such as EPSG:32617, not "
        f"{crs!r} ({str(error).splitlines()[0]})."
    )


def read_controls(flight: Flight, bundle: Bundle, origin: Origin, warnings: list[str]) -> list[Control]:
    """The flight's control points with their clicks in the bundle's images; for heights see :func:`control_places`.

    Clicks outside of their image or in images that the flight does not have are left out, with one warning each kind.
    """
    by_name = {frame.name: i for i, frame in enumerate(flight.frames)}
    by_base = {name.rsplit("/", 1)[-1].lower(): i for name, i in by_name.items()}
    image_of = {int(frame): k for k, frame in enumerate(bundle.frames)}
    absent, outside, found = set(), set(), []
    for point, place in zip(flight.gcps, enu_from_geodetic(control_places(flight.gcps), origin), strict=True):
        clicks = []
        for name, (u, v) in point.pixels.items():
            number = by_name.get(name, by_base.get(name.rsplit("/", 1)[-1].lower()))
            if number is None:
                absent.add(name)
                continue
            frame = flight.frames[number]
            if not (0 <= u <= frame.width and 0 <= v <= frame.height):
                outside.add(f"{point.name} in {name}")
            elif number in image_of:
                u, v = frame.straight(np.array([u, v])).tolist()
                clicks.append((image_of[number], (u, v)))
        found.append(Control(point.name, place, tuple(sorted(clicks))))
    if absent:
        warnings.append(
            f"gcp_list.txt names {len(absent)} images that the flight does not have ({_listed(absent)}): these lines "
            "were not used."
        )
    if outside:
        warnings.append(
            f"gcp_list.txt gives pixels outside of the image for {_listed(outside)}: these were not used; it must hold "
            "column and row in the images as they are stored."
        )
    return found


def consistent(source: Array, target: Array, *, metric: bool) -> NDArray[np.bool_]:
    """Which controls [n] fit together.

    Args:
        source: triangulated [n, 3].
        target: surveyed [n, 3].
        metric: whether the source is in metres, level and oriented, so that a shift must nearly do.

    A least trimmed squares fit over triples (Rousseeuw & Leroy, "Robust regression", 1987) shows one wrong point in
    five or more; of fewer a contradiction cannot be told apart.
    """
    good = np.ones(len(source), bool)
    if metric and len(source) >= 2:
        away = target - source
        distance = np.linalg.norm(away - np.median(away, axis=0), axis=1)
        good = distance <= max(FAR_OFF_M, 6 * float(np.median(distance)))
    n = int(good.sum())
    if n < 5:
        return good
    rows = np.flatnonzero(good)
    triples = list(combinations(range(n), 3))
    triples = triples[:: max(1, len(triples) // MOST_TRIPLES)]
    most = n - max(1, n // 4)
    least, inside = np.inf, np.zeros(0, np.intp)
    for triple in triples:
        three = rows[list(triple)]
        if flat(target[three]):
            continue
        matrix = fit_similarity(source[three], target[three])
        distance = np.linalg.norm(transform(matrix, source[rows]) - target[rows], axis=1)
        nearest = np.argsort(distance, kind="stable")[:most]
        if (total := float((distance[nearest] ** 2).sum())) < least:
            least, inside = total, rows[nearest]
    if not len(inside):
        return good
    matrix = fit_similarity(source[inside], target[inside])
    distance = np.linalg.norm(transform(matrix, source) - target, axis=1)
    spread = float(np.sqrt((distance[inside] ** 2).sum() / (3 * most - 7)))
    return np.asarray(good & (distance <= max(3 * (1 + 5 / (n - 3)) * spread, 0.1)))


def flat(places: Array) -> bool:
    """Whether points [n, 3] lie on a line, so that they leave a rotation open."""
    spread = np.linalg.svd(places - places.mean(0), compute_uv=False)
    return bool(len(places) < 3 or spread[1] < 0.05 * spread[0])


def spread_m(source: Array, target: Array, *, scaled: bool) -> Array:
    """Standard deviation [2] of controls, horizontal and vertical, metres: what a similarity (else a shift) leaves."""
    away = transform(fit_similarity(source, target, rotate=scaled, scale=scaled), source) - target
    share = np.sqrt(3 * len(source) / max(3 * len(source) - (7 if scaled else 3), 1))
    if len(source) < FEWEST_TO_TELL_HEIGHTS:  # three heights fit any plane
        return np.full(2, np.sqrt((away**2).mean()) * share)
    return np.array([np.sqrt((away[:, :2] ** 2).mean()), np.sqrt((away[:, 2] ** 2).mean())]) * share


def checks_of(places: Array) -> NDArray[np.bool_]:
    """Which of the surveyed points [n, 3] are kept as check points; deterministic.

    Three points that span the area hold the block; of the others the quarter that is farthest from these and from one
    another checks it, so that the checks do not flatter.
    """
    n = len(places)
    check = np.zeros(n, bool)
    if n < FEWEST_TO_CHECK:
        return check
    plan = places[:, :2]
    held = [int(np.linalg.norm(plan - plan.mean(0), axis=1).argmax())]
    while len(held) < FEWEST:
        distance = np.linalg.norm(plan[:, None] - plan[held], axis=2).min(1)
        if len(held) == 2:  # the third spans a triangle
            along = plan[held[1]] - plan[held[0]]
            distance = np.abs((plan - plan[held[0]]) @ [along[1], -along[0]])
        held.append(int(distance.argmax()))
    taken = list(held)
    for _ in range(max(1, round(CHECK_SHARE * n))):
        distance = np.linalg.norm(plan[:, None] - plan[taken], axis=2).min(1)
        distance[taken] = -1
        chosen = int(distance.argmax())
        check[chosen] = True
        taken.append(chosen)
    return check


def _listed(names: set[str]) -> str:
    some = sorted(names)[:4]
    return ", ".join(some) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
