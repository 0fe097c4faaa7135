"""The adjustment with ground control: what is control and what is check, how much the controls weigh, what is left."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from overfly.flights import Flight
from overfly.geodesy import Origin
from overfly.geometry import Array, fit_similarity, transform
from overfly.mapping.adjustment import Adjusted, Held, adjusted
from overfly.mapping.bundle import Bundle
from overfly.mapping.clicks import Control, Seen, click_sigma, see, with_controls
from overfly.mapping.control import (
    FEWEST,
    FEWEST_TO_CHECK,
    FEWEST_TO_TELL_HEIGHTS,
    checks_of,
    consistent,
    control_crs,
    flat,
    read_controls,
    spread_m,
)
from overfly.mapping.survey import Survey, SurveyedPoint

SURVEY_SIGMA_M = 0.01
"""Standard deviation of a surveyed coordinate at the best; the controls' own spread may only make it larger."""

LOOSENED = 10.0
"""Factor on the standard deviation of GPS beside ground control: it keeps only what the controls leave open."""

ROUNDS = 3
"""Of adjustment and estimation of the controls' weight."""


@dataclass(frozen=True, eq=False)
class Controlled:
    """The outcome: the adjustment (its last ``added`` points are controls), the survey, whether any control held it,
    and the EPSG codes of the controls' projected and vertical CRS."""

    adjusted: Adjusted
    survey: Survey
    added: int = 0
    used: bool = False
    crs: tuple[int | None, int | None] = (None, None)

    def in_their_crs(self, origin: Origin) -> Origin:
        """The origin of a block, its products in the CRS of the controls that hold it; degrees are no CRS of products.

        Heights are always those of the controls: over what theirs are, or over nothing known.
        """
        if not self.used:
            return origin
        return replace(origin, epsg=self.crs[0] or origin.epsg, vertical_epsg=self.crs[1])


def placed_by_controls(flight: Flight, result: Adjusted, origin: Origin, warnings: list[str]) -> Adjusted:
    """A block without GPS moved onto its controls by a similarity; unchanged where they do not suffice."""
    quiet: list[str] = []
    sizes = _sizes(flight, result.bundle)
    pairs = [
        (seen.point, control.place)
        for control in read_controls(flight, result.bundle, origin, quiet)
        if (seen := see(result.bundle, control, sizes, quiet)) is not None
    ]
    source, target = np.array([p for p, _ in pairs]).reshape(-1, 3), np.array([q for _, q in pairs]).reshape(-1, 3)
    good = consistent(source, target, metric=False)
    if good.sum() < FEWEST or flat(target[good]):
        return result
    return replace(result, bundle=result.bundle.moved(fit_similarity(source[good], target[good])))


def controlled(
    flight: Flight, result: Adjusted, origin: Origin, *, with_gps: bool, how: str, warnings: list[str]
) -> Controlled:
    """Adjust a block with its flight's ground control.

    Args:
        flight: its control points.
        result: the block as adjusted without them, in metres about ``origin`` unless it has no GPS and too few
            controls to have been moved onto them.
        origin: of the local frame.
        with_gps: whether GPS placed the block.
        how: "split" keeps check points where there are four or more, "all" does not.
        warnings: for the user.
    """
    bundle, sizes = result.bundle, _sizes(flight, result.bundle)
    controls = read_controls(flight, bundle, origin, warnings)
    seen = [see(bundle, control, sizes, warnings) for control in controls]
    usable = fitting(controls, seen, metric=with_gps, warnings=warnings)
    target = np.array([controls[i].place for i in usable]).reshape(-1, 3)
    if len(usable) < FEWEST or (flat(target) and not with_gps):
        why = "lie on a line" if len(usable) >= FEWEST else "are too few, three are needed"
        warnings.append(
            f"Ground control was not used: {len(usable)} of {len(controls)} points are seen in two or more images and "
            f"fit together, which {why}."
        )
        return Controlled(result, Survey(tuple(_unused(c) for c in controls)))
    check = checks_of(target) if how == "split" else np.zeros(len(usable), bool)
    if how == "split" and len(usable) < FEWEST_TO_CHECK:
        warnings.append(
            f"All {len(usable)} usable control points hold the map, so that nothing checks it: give four or more."
        )
    held = [i for i, apart in zip(usable, check, strict=True) if not apart]
    views = [view for i in held if (view := seen[i]) is not None]
    places = np.array([controls[i].place for i in held])
    final, sigma = _weighed(result, views, places, sizes, with_gps=with_gps)
    roles = {i: "check" if apart else "control" for i, apart in zip(usable, check, strict=True)}
    points = [residual_of(final.bundle, control, roles.get(i), sizes) for i, control in enumerate(controls)]
    shift = final.datum if with_gps else None
    east, north, up = (0.0, 0.0, 0.0) if shift is None else (float(v) for v in shift)
    if shift is not None and abs(up) > 5:
        warnings.append(
            f"The heights of the GPS lie {abs(up):.1f} m {'above' if up > 0 else 'below'} the controls', which were "
            "taken: GPS tells heights above the ellipsoid or from a barometer, controls often above sea level."
        )
    survey = Survey(
        tuple(points),
        (round(float(sigma[0]), 4), round(float(sigma[1]), 4)),
        None if shift is None else (round(east, 3), round(north, 3), round(up, 3)),
    )
    return Controlled(final, survey, len(views), True, control_crs(flight.gcps[0].crs))


def fitting(
    controls: Sequence[Control], seen: Sequence[Seen | None], *, metric: bool, warnings: list[str]
) -> list[int]:
    """Numbers of the controls that are seen and fit together (:func:`consistent`); contradicting ones are named."""
    usable = [i for i, view in enumerate(seen) if view is not None]
    source = np.array([view.point for view in seen if view is not None]).reshape(-1, 3)
    good = consistent(source, np.array([controls[i].place for i in usable]).reshape(-1, 3), metric=metric)
    for i in (i for i, fits in zip(usable, good, strict=True) if not fits):
        warnings.append(
            f"The control point {controls[i].name} contradicts the others and was not used: check its coordinates and "
            "its pixels in gcp_list.txt."
        )
    return [i for i, fits in zip(usable, good, strict=True) if fits]


def _weighed(
    result: Adjusted, views: Sequence[Seen], places: Array, sizes: Sequence[tuple[int, int]], *, with_gps: bool
) -> tuple[Adjusted, Array]:
    """Adjusted with the controls, and their standard deviations [2], horizontal and vertical.

    Their weight is that of their own residuals, by variance components (Förstner, "Ein Verfahren zur Schätzung von
    Varianz- und Kovarianzkomponenten", 1979): the squares of each group over its redundancy.
    """
    source = np.array([view.point for view in views])
    bundle, held, datum = result.bundle, result.held, np.zeros(3)
    sigma = np.maximum(spread_m(source, places, scaled=not flat(places)), SURVEY_SIGMA_M)
    if with_gps:
        matrix, datum = _onto(bundle, held, source, places, sigma)
    else:
        matrix = fit_similarity(source, places)
    bundle = bundle.moved(matrix)
    views = [replace(view, point=point) for view, point in zip(views, transform(matrix, source), strict=True)]
    state = replace(result, bundle=with_controls(bundle, views), datum=datum)
    first = len(bundle.points)
    for turn in range(ROUNDS):
        ruled = _with_knowledge(held, views, places, sigma, sizes, gps=with_gps)
        state = adjusted(state.bundle, ruled, lever=state.lever, datum=state.datum)
        if turn == ROUNDS - 1 or len(views) < FEWEST_TO_TELL_HEIGHTS:  # little is left to estimate a spread from
            break
        off = state.bundle.points[first:] - places
        redundancy = 1 - np.einsum("kii->ki", state.point_covariances(np.arange(first, first + len(views)))) / (
            sigma[[0, 0, 1]] ** 2
        )
        new = sigma.copy()
        for group, axes in enumerate(((0, 1), (2,))):
            total = float(np.clip(redundancy[:, axes], 0, 1).sum())
            if total > 0.5:
                new[group] = np.sqrt((off[:, axes] ** 2).sum() / total)
        new = np.clip(new, np.maximum(sigma / 3, SURVEY_SIGMA_M), sigma * 3)
        settled = bool(np.all(np.abs(np.log(new / sigma)) < 0.05))
        sigma = new
        if settled:
            break
    return state, sigma


def _onto(bundle: Bundle, held: Held, source: Array, places: Array, sigma: Array) -> tuple[Array, Array]:
    """The similarity [4, 4] that brings a block to controls and loosened GPS together, and the shift of GPS [3]."""
    known = np.isfinite(held.places).all(1) & (held.place_sigmas[:, 2] < 1e2)
    centres, told = bundle.centres[known], held.places[known]
    weights = np.concatenate(
        [
            np.full(len(source), 1 / (sigma**2).mean()),
            1 / ((held.place_sigmas[known] * LOOSENED) ** 2).mean(1),
        ]
    )
    datum, matrix = np.median(source - places, axis=0), np.eye(4)
    for _ in range(20):
        matrix = fit_similarity(
            np.concatenate([source, centres]), np.concatenate([places, told - datum]), weights=weights
        )
        if known.any():
            datum = np.median(told - transform(matrix, centres), axis=0)
    return matrix, datum


def _with_knowledge(
    held: Held, views: Sequence[Seen], places: Array, sigma: Array, sizes: Sequence[tuple[int, int]], *, gps: bool
) -> Held:
    """What holds the block, with the controls as its last points and GPS loosened, shifted as a whole."""
    clicks = [click_sigma(sizes[k]) for view in views for k, _ in view.clicks]
    return replace(
        held,
        pixel_sigma=np.concatenate([held.pixel_sigma, clicks]),
        place_sigmas=held.place_sigmas * LOOSENED,
        datum=gps,
        knows=np.concatenate([held.knows, places]),
        know_sigmas=np.concatenate([held.know_sigmas, np.tile(sigma[[0, 0, 1]], (len(views), 1))]),
    )


def residual_of(bundle: Bundle, control: Control, role: str | None, sizes: Sequence[tuple[int, int]]) -> SurveyedPoint:
    """How far the block sees a point from where it was surveyed: from its clicks alone, controls like checks."""
    view = see(bundle, control, sizes, [])
    if view is None:
        return _unused(control)
    x, y, z = (round(float(v), 4) for v in view.point - control.place)
    return replace(
        _unused(control),
        role=role or "unused",
        residual=(x, y, z),
        pixels=round(view.pixels, 3),
        images=len(view.clicks),
    )


def _unused(control: Control) -> SurveyedPoint:
    x, y, z = (round(float(v), 4) for v in control.place)
    return SurveyedPoint(control.name, "unused", (x, y, z), images=len(control.clicks))


def _sizes(flight: Flight, bundle: Bundle) -> list[tuple[int, int]]:
    return [(flight.frames[i].width, flight.frames[i].height) for i in bundle.frames.tolist()]
