"""What the images and the photos' own data weigh in an adjustment, and how far they may calibrate a camera."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from overfly.flights import Frame
from overfly.geometry import Array, Camera, distort, invertible, pixel_grid, rays, undistort
from overfly.mapping.adjustment import HEADING_SIGMA, LENS_SIGMA, UP_SIGMA, Adjusted, Held, adjusted, free
from overfly.mapping.bundle import Bundle
from overfly.mapping.database import focal_px
from overfly.mapping.features import LONGEST_SIDE
from overfly.mapping.model import FEWEST_TO_CALIBRATE
from overfly.mapping.placing import FEW_RAYS, FEWEST_TO_SCATTER, widened
from overfly.mapping.ties import unchecked_ties, untied

UNTOLD = "The images do not tell the focal length"
KEPT = "The calibration is kept, but the map that it comes from did not tell its focal length well"
"""How the warnings begin of a map whose camera is not known well, and of one that took it over."""

NOISE_PX = 0.25
"""Standard deviation of a key point, pixels of the picture that was searched: it weighs the images against GPS."""

WORST_PX = 3.0
"""Rays that miss their point by more are dropped."""

FOCAL_TRIED, TRIED_SIGMA = 0.05, 1e-4
"""Share by which a focal length is made longer, to see whether the images notice; and how firmly that is held."""

FOCAL_SIGMA, CALIBRATED_SIGMA = 0.02, 0.005
"""Standard deviation of a focal length by the photo's own data, as a share: by the data sheet, and by the maker's
calibration of this very camera, which temperature moves."""

FEWEST_TO_FREE = 8
"""Images of a camera from which on its focal length may be another than the photos' data tell: two lines of four."""

FEWEST_RAYS_TO_FREE = 150
"""Rays of its median image without which it stays: few wrong ones among few would move it."""

GAIN = 0.01
"""Share of the cost that the images must gain by a lens, or by another focal length than the photos' data tell."""

FARTHEST = 0.25
"""Share by which a focal length is other than the photos tell only where all images of the camera share points with two
others at once: else GPS alone tells how far apart they stand, and the focal length bends to its errors."""

NO_LENS_SIGMA = 0.0001
"""Standard deviation of k1 and k2 until the images ask for a lens."""

LOOSE = 10.0
"""Factor on the standard deviation of GPS until it has shown what it is worth."""

LEAST_DEG = 0.2
"""Degrees that gimbals are taken to scatter by at the least."""

NORMAL, RAYLEIGH = 0.6745, 1.1774
"""Median size of a normal value of standard deviation 1, and length of two."""

HOPELESS, PATIENCE = 20, 5
"""Steps that gain less than this part of what must be gained in all are the last ones after so many of them."""

FITTED = 24
"""Points along each side of an image by which the terms of two lenses are made one."""

ROUGHLY = 1.0
"""What a step must still gain before the decisions; the last adjustment goes on to the end."""


def held_by_images(bundle: Bundle, frames: Sequence[Frame]) -> Held:
    """What the images and the photos' own data say of a bundle: the weights of its rays, priors of its cameras."""
    own = [frames[i] for i in bundle.frames]
    count = np.bincount(bundle.lens_of, minlength=len(bundle.lenses))
    first = [int(np.flatnonzero(bundle.lens_of == j)[0]) for j in range(len(count))]
    focals = [focal_px(own[i]) or np.nan for i in first]
    return replace(
        free(bundle, NOISE_PX * _shrunk(bundle, frames)),
        focals=np.array(focals, float),
        focal_sigma=np.array([FOCAL_SIGMA if own[i].lens is None else CALIBRATED_SIGMA for i in first]),
        lens_sigma=NO_LENS_SIGMA,
        lens_fixed=(count < FEWEST_TO_CALIBRATE) | [own[i].calibration is not None for i in first],
    )


def adjusted_twice(bundle: Bundle, held: Held, frames: Sequence[Frame]) -> Adjusted:
    """Adjusted, then again without the rays that miss, and with GPS weighed by what it turned out to be worth.

    Headings hold only images of few rays, and gimbals that scatter little hold these more than others: errors that
    gimbals have in common would bend a block that its rays hold better.
    """
    few = np.bincount(bundle.image, minlength=len(bundle)) < FEW_RAYS
    held = replace(held, heading_sigma=np.where(few, HEADING_SIGMA, np.inf))
    # Loosely first: GPS that is worse than it says would bend the block and look better than it is.
    loose = replace(held, place_sigmas=held.place_sigmas * LOOSE, lens_sigma=LENS_SIGMA)
    result = adjusted(bundle, loose, tolerance=ROUGHLY)
    kept = result.bundle.kept(result.bundle.errors() <= WORST_PX * _shrunk(bundle, frames))
    kept = kept.kept(~unchecked_ties(kept, np.asarray(np.isfinite(held.places[:, :2]).all(1))))
    images = free(kept, NOISE_PX * _shrunk(kept, frames))
    few = np.bincount(kept.image, minlength=len(kept)) < FEW_RAYS
    judges = ~few & [frames[i].gimbal is not None for i in kept.frames]
    tilted = np.linalg.norm(kept.rotations[:, :, 2] - held.ups, axis=1)[judges]
    turned = np.abs((kept.rotations[:, :, 1] * held.easts).sum(1))[judges]
    again = replace(
        held,
        pixel_sigma=images.pixel_sigma,
        knows=images.knows,
        know_sigmas=images.know_sigmas,
        place_sigmas=widened(held.place_sigmas, result.away()),
        up_sigma=np.where(few, gimbal_sigma(tilted / RAYLEIGH, UP_SIGMA), UP_SIGMA),
        heading_sigma=np.where(few, gimbal_sigma(turned / NORMAL, HEADING_SIGMA), np.inf),
    )
    return adjusted(kept, again, lever=result.lever, tolerance=ROUGHLY)


def gimbal_sigma(off: Array, most: float) -> float:
    """Standard deviation, radians, by how far gimbals are off [n], in medians of what one of unit deviation is off.

    NaN: not told. Few tell nothing, and ``most`` is taken.
    """
    if np.isfinite(off).sum() < FEWEST_TO_SCATTER:
        return most
    return min(most, max(np.deg2rad(LEAST_DEG), float(np.nanmedian(off))))


def _shrunk(bundle: Bundle, frames: Sequence[Frame]) -> Array:
    """Pixels of its image in a pixel of the picture that was searched, for each ray [k]."""
    shrunk = [max(1.0, max(frames[i].width, frames[i].height) / LONGEST_SIDE) for i in bundle.frames]
    return np.array(shrunk)[bundle.image]


def calibrated(result: Adjusted) -> tuple[Adjusted, bool]:
    """Adjusted with the lens free, then without prior of the focal length, where the images clearly ask for it.

    Over level ground seen from one height they hardly tell a lens or a focal length from a bent block, and formal
    precision cannot decide: rolling shutter and the lens leave errors that all rays of a region have in common. So a
    share of the whole cost must be gained.

    Args:
        result: with focal length and lens held.

    Returns:
        The adjusted block, and whether the images leave its focal length open: one that is :data:`FOCAL_TRIED` longer,
        of all cameras together, would cost less than that share. False where no camera has a focal length by its
        photos' data, or images enough to try another.
    """
    start = result.lever
    lens = adjusted(result.bundle, replace(result.held, lens_sigma=LENS_SIGMA), lever=start, tolerance=ROUGHLY)
    if result.cost - lens.cost > GAIN * lens.cost:
        result = lens
    needed, untold = GAIN * result.cost, False
    told = np.isfinite(result.held.focals)
    doubted = told & ~result.held.lens_fixed & (np.broadcast_to(result.held.focal_sigma, told.shape) > CALIBRATED_SIGMA)
    if (told & ~result.held.lens_fixed).any():
        hopeless = needed / HOPELESS
        focals = np.where(told, result.bundle.lenses[:, 0] * (1 + FOCAL_TRIED), np.nan)
        longer = replace(result.held, focals=focals, focal_sigma=np.full(len(focals), TRIED_SIGMA))
        tried = adjusted(result.bundle, longer, lever=start, tolerance=hopeless, patience=PATIENCE)
        untold = bool(doubted.any()) and tried.cost - result.cost < needed
        rays = np.median(np.bincount(result.bundle.image, minlength=len(result.bundle)))
        if np.bincount(result.bundle.lens_of).min() >= FEWEST_TO_FREE and rays >= FEWEST_RAYS_TO_FREE:
            free_focal = replace(result.held, focals=np.full_like(result.held.focals, np.nan))
            focal = adjusted(result.bundle, free_focal, lever=start, tolerance=hopeless, patience=PATIENCE)
            if result.cost - focal.cost > needed:
                far = np.abs(focal.bundle.lenses[:, 0] / result.held.focals - 1) > FARTHEST
                loose = np.bincount(result.bundle.lens_of[untied(result.bundle)], minlength=len(far)) > 0
                untold = bool((far & loose).any())
                result = result if untold else focal
    return adjusted(result.bundle, result.held, lever=result.lever), untold


def composed(lens: Camera, straightened: Camera) -> Camera:
    """The camera of an image whose straightened pixels (:meth:`overfly.flights.Frame.straight`) were calibrated.

    Args:
        lens: that the pixels were straightened by.
        straightened: found with these: another focal length than its pinhole's, and radial terms on top.
    """
    from scipy.optimize import least_squares

    if not straightened.is_distorted and straightened.fx == np.sqrt(lens.fx * lens.fy):
        return lens
    grid = (pixel_grid(FITTED, FITTED) - 0.5) / (FITTED - 1) * [lens.width, lens.height]  # from border to border
    seen = rays(grid, lens)[..., :2].reshape(-1, 2)
    # What points the straightened camera sees where the lens alone would see these.
    points = undistort(seen * (np.sqrt(lens.fx * lens.fy) / straightened.fx), straightened)
    target = distort(seen, lens) * [lens.fx, lens.fy] + [lens.cx, lens.cy]
    points, target = (values[np.isfinite(points).all(1)] for values in (points, target))
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    scale = np.array([lens.fx, lens.fy, lens.fx, lens.fy, 1, 1, 1, 1, 1])

    def camera(x: Array) -> Camera:
        return replace(lens, **dict(zip(names, (x * scale).tolist(), strict=True)))

    def misses(x: Array) -> Array:
        c = camera(x)
        return np.asarray(distort(points, c) * [c.fx, c.fy] + [c.cx, c.cy] - target).ravel()

    start = np.array([getattr(lens, name) for name in names]) / scale
    found = camera(least_squares(misses, start, method="lm", xtol=1e-12, ftol=1e-12).x)
    if invertible(found):
        return found
    share = straightened.fx / float(np.sqrt(lens.fx * lens.fy))  # terms that make no lens together
    return replace(lens, fx=lens.fx * share, fy=lens.fy * share)


def source_remarks(path: Path | str) -> list[str]:
    """What the map said that a calibration comes from, in its folder or beside a file: whether it knew its camera."""
    given = Path(path)
    told = (given if given.is_dir() else given.parent) / "map.json"
    try:
        said = json.loads(told.read_text(encoding="utf-8")).get("warnings")
    except (OSError, ValueError, AttributeError):
        return []
    if not isinstance(said, list) or not any(str(text).startswith((UNTOLD, KEPT)) for text in said):
        return []
    return [
        f"{KEPT} ({told.parent}): differences in height may be wrong by as much as there. Calibrate from "
        "another height, over relief, or with ground control."
    ]
