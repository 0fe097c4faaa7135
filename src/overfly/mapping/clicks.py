"""Where a block sees a control point: the clicks of a person, triangulated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from overfly.geometry import Array, rays
from overfly.mapping.bundle import Bundle

CLICK_PX = 1.0
"""Standard deviation of a pixel that a person clicked, for images up to :data:`CLICK_SIDE` pixels wide."""

CLICK_SIDE = 1600
FAR_CLICK = 6.0
"""A click this many standard deviations off where the other images see the point is wrong."""


@dataclass(frozen=True, eq=False)
class Control:
    """A ground control point: surveyed place [3] in the block's frame, clicks (image of the bundle, pixel)."""

    name: str
    place: Array
    clicks: tuple[tuple[int, tuple[float, float]], ...]


@dataclass(frozen=True, eq=False)
class Seen:
    """A control as the block sees it: triangulated position [3], mean distance from the clicks, the clicks used."""

    point: Array
    pixels: float
    clicks: tuple[tuple[int, tuple[float, float]], ...]


def see(bundle: Bundle, control: Control, sizes: Sequence[tuple[int, int]], warnings: list[str]) -> Seen | None:
    """Triangulate a control from its clicks; clicks that contradict the others are left out, with a warning.

    Args:
        bundle: the cameras.
        control: with its clicks.
        sizes: width and height of the bundle's images.
        warnings: for the user.

    Returns:
        None if less than two consistent clicks are left.
    """
    clicks = control.clicks
    while len(clicks) >= 2:
        point = triangulated(bundle, clicks, sizes)
        image = np.array([k for k, _ in clicks])
        away = bundle.project(np.repeat(point[None], len(clicks), axis=0), image) - [pixel for _, pixel in clicks]
        distance = np.nan_to_num(np.linalg.norm(away, axis=1), nan=np.inf)
        relative = distance / [click_sigma(sizes[k]) for k, _ in clicks]
        worst = int(relative.argmax())
        if relative[worst] <= FAR_CLICK:
            return Seen(point, float(distance.mean()), clicks)
        if len(clicks) == 2:
            warnings.append(
                f"The two clicks of {control.name} miss each other by {distance.sum():.0f} px, so it was not used: "
                "check its pixels in gcp_list.txt."
            )
            return None
        warnings.append(
            f"One click of {control.name} lies {distance[worst]:.0f} px from where the other images see it and was not "
            "used: check its pixels in gcp_list.txt."
        )
        clicks = tuple(click for k, click in enumerate(clicks) if k != worst)
    return None


def click_sigma(size: tuple[int, int]) -> float:
    """Standard deviation of a click in an image of this size, pixels."""
    return CLICK_PX * max(1.0, max(size) / CLICK_SIDE)


def triangulated(
    bundle: Bundle, clicks: Sequence[tuple[int, tuple[float, float]]], sizes: Sequence[tuple[int, int]]
) -> Array:
    """The point [3] nearest to the clicks' rays, then with the least robust distance in the images."""
    from scipy.optimize import least_squares

    square, right = np.zeros((3, 3)), np.zeros(3)
    for k, pixel in clicks:
        ray = bundle.rotations[k].T @ rays(np.array([pixel]), bundle.camera(k, *sizes[k]))[0]
        ray /= np.linalg.norm(ray)
        across = np.eye(3) - np.outer(ray, ray)
        square, right = square + across, right + across @ bundle.centres[k]
    start = np.linalg.lstsq(square, right, rcond=None)[0]
    image = np.array([k for k, _ in clicks])
    pixels = np.array([pixel for _, pixel in clicks])
    scale = np.array([click_sigma(sizes[k]) for k, _ in clicks])[:, None]

    def away(point: Array) -> Array:
        off = bundle.project(np.repeat(point[None], len(image), axis=0), image) - pixels
        return np.asarray((np.nan_to_num(off, nan=1e4) / scale).ravel())

    return np.asarray(least_squares(away, start, loss="cauchy" if len(clicks) > 2 else "linear", x_scale="jac").x)


def with_controls(bundle: Bundle, seen: Sequence[Seen]) -> Bundle:
    """The bundle with the controls as its last points, at where it sees them."""
    first = len(bundle.points)
    image = [k for control in seen for k, _ in control.clicks]
    point = [first + i for i, control in enumerate(seen) for _ in control.clicks]
    pixels = np.array([pixel for control in seen for _, pixel in control.clicks], float).reshape(-1, 2)
    return replace(
        bundle,
        points=np.concatenate([bundle.points, np.array([control.point for control in seen]).reshape(-1, 3)]),
        image=np.concatenate([bundle.image, np.array(image, np.intp)]),
        point=np.concatenate([bundle.point, np.array(point, np.intp)]),
        pixels=np.concatenate([bundle.pixels, pixels]),
    )
