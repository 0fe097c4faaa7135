"""A bundle that starts where GPS and gimbals say the cameras are: for flights with too few matches to be built up.

Sparse mapping adds frame to frame, and each step needs many matches; what is known of all frames beforehand needs few.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from overfly.flights import Frame
from overfly.geometry import Array, rotation_from_gimbal
from overfly.mapping.adjustment import adjusted
from overfly.mapping.bundle import Bundle, Index
from overfly.mapping.calibration import ROUGHLY, held_by_images
from overfly.mapping.database import focal_px
from overfly.mapping.overlays import Prior
from overfly.mapping.placing import easts_of, gps_sigmas
from overfly.mapping.prior_matches import Features, Verified, first_matches, more_matches
from overfly.mapping.relative import unit_px

FIRST_SIGMAS_PX, SIGMAS_PX = (40.0, 10.0, 2.5), (10.0, 2.5)
"""What a ray is taken to be worth, pixels, one adjustment after another: at first directions are wrong by a degree."""

GPS_LOOSE = 3.0
"""Factor on the standard deviation of GPS: hardly more, or a few wrong matches carry an image away."""

FEWEST_RAYS = 8
"""Rays without which an image is not placed: three tell its pose, the others that they are right."""

FEWEST_SHARED = 10
"""Points that two images must share, or what they alone see is dropped: up to 9 were wrong on orbits over towers."""

FARTHEST_PX = 6.0
"""Rays that miss their point by more at the end are dropped."""


def bundle_by_priors(
    frames: Sequence[Frame],
    told: Array,
    features: Sequence[Features],
    verified: Verified,
    lens_ids: Sequence[int],
    *,
    priors: Sequence[Prior | None] = (),
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Bundle | None:
    """The frames with GPS, gimbal and focal length, adjusted to their matches; None where these do not fit.

    What was matched without knowing anything is adjusted first, with what pairs that have hardly any matches show where
    their priors put them. Then key points are matched again, only where they can be (:mod:`overfly.mapping.guided`):
    that finds several times as many, also in images that had none.

    Args:
        frames: of the flight, n of them.
        told: their GPS positions [n, 3] in local ENU metres, NaN where unknown.
        features: pixels [p, 2] of the key points of each frame, and descriptors [q, 128] of the first q of them: those
            of a network have none.
        verified: of pairs (i, j), rows of indices of their key points [m, 2].
        lens_ids: what the database calls the camera of each frame.
        priors: where each frame stands over the ground, None where that is unknown.
        seed: of random draws.
        progress: called with (pairs matched again, in all).
    """
    known = [
        i
        for i, frame in enumerate(frames)
        if np.isfinite(told[i]).all() and frame.gimbal is not None and focal_px(frame) is not None
    ]
    rank = {i: k for k, i in enumerate(known)}
    rows: Verified = {(rank[i], rank[j]): r for (i, j), r in verified.items() if i in rank and j in rank and len(r)}
    if len(known) < 2:
        return None
    own = [features[i] for i in known]
    ids = tuple(sorted({lens_ids[i] for i in known}))
    first = [next(frames[i] for i in known if lens_ids[i] == lens) for lens in ids]
    start = Bundle(
        frames=np.array(known, np.intp),
        rotations=np.stack([rotation_from_gimbal(*(frames[i].gimbal or (0, 0, 0))).T for i in known]),
        centres=told[known],
        lens_of=np.array([ids.index(lens_ids[i]) for i in known], np.intp),
        lenses=np.array([[focal_px(f) or 0.0, f.width / 2, f.height / 2, 0.0, 0.0] for f in first]),
        lens_ids=ids,
        points=np.zeros((0, 3)),
        image=np.zeros(0, np.intp),
        point=np.zeros(0, np.intp),
        pixels=np.zeros((0, 2)),
    )
    places, sigmas = told[known], gps_sigmas([frames[i] for i in known]) * GPS_LOOSE
    rows = first_matches(start, own, rows, [priors[i] for i in known] if priors else [], seed, progress)
    if not rows:
        return None
    bundle = _fitted(
        start, own, rows, frames, places, sigmas, start.rotations[:, :, 2], start.rotations[:, :, 0], FIRST_SIGMAS_PX
    )
    if len(bundle.points) < FEWEST_RAYS:
        return None
    seen = np.bincount(bundle.image, minlength=len(bundle)) > 0
    shift = np.median((bundle.centres - start.centres)[seen], axis=0)
    bundle = replace(
        bundle,  # nothing held the others
        rotations=np.where(seen[:, None, None], bundle.rotations, start.rotations),
        centres=np.where(seen[:, None], bundle.centres, start.centres + shift),
    )
    more, easts = more_matches(bundle, own, rows, progress), easts_of(bundle, [frames[i].gimbal for i in known])
    bundle = _fitted(bundle, own, more, frames, places, sigmas, start.rotations[:, :, 2], easts, SIGMAS_PX)
    bundle = _without_weak_ties(bundle)
    while len(bundle) and (few := np.bincount(bundle.image, minlength=len(bundle)) < FEWEST_RAYS).any():
        bundle = bundle.without(few)
    return bundle if len(bundle) >= 2 else None


def _without_weak_ties(bundle: Bundle) -> Bundle:
    """Without what only two images see that share few points: so few agree by chance."""
    shared = np.zeros((len(bundle), len(bundle)), int)
    for pair, count in bundle.links().items():
        shared[pair] = count
    seen = np.bincount(bundle.point, minlength=len(bundle.points))
    lowest, highest = np.full(len(seen), len(bundle)), np.zeros(len(seen), int)
    np.minimum.at(lowest, bundle.point, bundle.image)
    np.maximum.at(highest, bundle.point, bundle.image)
    weak = (seen == 2) & (shared[lowest, highest] < FEWEST_SHARED)
    return bundle.kept(~weak[bundle.point])


def _fitted(
    start: Bundle,
    features: Sequence[Features],
    rows: Verified,
    frames: Sequence[Frame],
    places: Array,
    place_sigmas: Array,
    ups: Array,
    easts: Array,
    sigmas_px: Sequence[float],
) -> Bundle:
    """Cameras adjusted to the tracks of matches, from where they are."""
    image, point, at = _tracks([pixels for pixels, _ in features], rows)
    points = np.zeros((point.max(initial=-1) + 1, 3))
    bundle = _triangulated(replace(start, points=points, image=image, point=point, pixels=at))
    unit = max(unit_px(frames[i].width, frames[i].height) for i in start.frames)
    for sigma in (unit * sigma for sigma in sigmas_px):
        if len(bundle.points) < FEWEST_RAYS:
            return bundle
        held = replace(
            held_by_images(bundle, frames),
            pixel_sigma=np.full(len(bundle.image), sigma),
            places=places,
            place_sigmas=place_sigmas,
            ups=ups,
            easts=easts,
            lens_fixed=np.ones(len(bundle.lenses), bool),
        )
        bundle = adjusted(bundle, held, tolerance=ROUGHLY).bundle
        bundle = bundle.kept(bundle.errors() < max(unit * FARTHEST_PX, 4 * sigma))
    return bundle.kept(bundle.errors() < unit * FARTHEST_PX)


def _tracks(pixels: Sequence[NDArray], rows: Verified) -> tuple[Index, Index, Array]:
    """Key points that matches join: image [k], point [k] and pixels [k, 2] of each, ordered by point.

    A track that comes to two places of one image is wrong and left out.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    starts = np.cumsum([0, *(len(p) for p in pixels)])
    ends = [np.concatenate([starts[pair[side]] + r[:, side] for pair, r in rows.items()]) for side in (0, 1)]
    joined = coo_array((np.ones(len(ends[0])), tuple(ends)), shape=(starts[-1], starts[-1]))
    _, track = connected_components(joined, directed=False)
    used = np.unique(np.concatenate(ends))
    image = np.searchsorted(starts, used, side="right") - 1
    _, owner, count = np.unique(track[used] * len(pixels) + image, return_inverse=True, return_counts=True)
    torn = np.unique(track[used][count[owner.reshape(-1)] > 1])
    good = ~np.isin(track[used], torn)
    used, image = used[good], image[good]
    point = np.unique(track[used], return_inverse=True)[1].reshape(-1)
    order = np.lexsort((image, point))
    return image[order], point[order], np.concatenate(pixels)[used[order]].astype(float)


def _triangulated(bundle: Bundle) -> Bundle:
    """With each point nearest to its rays, without those that lie behind a camera or where rays are parallel."""
    f, cx, cy = bundle.lenses[bundle.lens_of[bundle.image]].T[:3]
    flat = (bundle.pixels - np.stack([cx, cy], axis=1)) / f[:, None]
    local = np.concatenate([flat, np.ones((len(flat), 1))], axis=1)
    rays = np.einsum("kji,kj->ki", bundle.rotations[bundle.image], local)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    m = len(bundle.points)
    normal, right = np.zeros((m, 3, 3)), np.zeros((m, 3))
    np.add.at(normal, bundle.point, across)
    np.add.at(right, bundle.point, np.einsum("kij,kj->ki", across, bundle.centres[bundle.image]))
    firm = np.linalg.eigvalsh(normal)[:, 0] > 1e-4
    points = np.zeros((m, 3))
    points[firm] = np.linalg.solve(normal[firm], right[firm][:, :, None])[:, :, 0]
    placed = replace(bundle, points=points)
    return placed.kept(firm[bundle.point] & np.isfinite(placed.errors()))
