"""A bundle that starts where GPS and gimbals say the cameras are: for flights with too few matches to be built up.

Sparse mapping adds frame to frame, and each step needs many matches; what is known of all frames beforehand needs few.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from overfly.flights import Frame
from overfly.geometry import Array, rotation_from_gimbal
from overfly.mapping.adjustment import adjusted
from overfly.mapping.bundle import Bundle, Index
from overfly.mapping.calibration import LOOSE, ROUGHLY, held_by_images
from overfly.mapping.database import focal_px
from overfly.mapping.guided import guided_matches
from overfly.mapping.overlays import Prior
from overfly.mapping.placing import gps_sigmas
from overfly.mapping.relative import agreeing

UNIT_PX = 800
"""Longest side of an image to which the lengths below belong, in its pixels; larger ones have larger pixels' errors."""

FIRST_SIGMAS_PX, SIGMAS_PX = (40.0, 10.0, 2.5), (10.0, 2.5)
"""What a ray is taken to be worth, pixels, one adjustment after another: at first directions are wrong by a degree."""

UP_SIGMA_DEG = 3.0
"""What the gimbal's vertical is taken to be worth: a few wrong matches shall not tilt an image."""

REACH_PX, FAR_REACH_PX = 3.0, 40.0
"""Off its epipolar line a key point is looked for so far, and so far if one of the images has no match yet."""

FIRST_REACH_PX, FIRST_HEIGHTS = 60.0, (-0.15, 0.3)
"""Off its epipolar line, and between which heights over the ground, in the cameras' heights over it, a key point is
looked for before any camera is adjusted."""

ENOUGH = 15
"""Matches of a pair from which on nothing more is looked for by then."""

FOOTPRINTS_APART, NEAREST = 1.2, 8
"""Images are compared with so many whose middles lie nearest, no farther than so many times the ground that one sees,
corner to corner."""

FLATTEST = 0.4
"""Cosine from nadir: of flatter images the nearer ground counts."""

BY_CHANCE, DISPLACED = 0.25, (0.13, 0.17)
"""Share of the matches along epipolar lines that may be found there by chance, or none is taken; and shares of an image
by which its key points are moved to count these."""

RELIEF = (0.02, 0.98, 0.5)
"""Shares of the points between whose heights the ground is looked for, and how much more, of their range, each way."""

FEWEST_RAYS = 8
"""Rays without which an image is not placed: three tell its pose, the others that they are right."""

FARTHEST_PX = 6.0
"""Rays that miss their point by more at the end are dropped."""

Features = tuple[NDArray, NDArray]
Verified = Mapping[tuple[int, int], NDArray[np.uint32]]


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
    places, sigmas = told[known], gps_sigmas([frames[i] for i in known]) * LOOSE
    rows = _first(start, own, rows, [priors[i] for i in known] if len(priors) else [None] * len(known), seed)
    if not rows:
        return None
    ups = start.rotations[:, :, 2]
    bundle = _fitted(start, own, rows, frames, places, sigmas, ups, FIRST_SIGMAS_PX)
    if len(bundle.points) < FEWEST_RAYS:
        return None
    seen = np.bincount(bundle.image, minlength=len(bundle)) > 0
    shift = np.median((bundle.centres - start.centres)[seen], axis=0)
    bundle = replace(
        bundle,  # nothing held the others
        rotations=np.where(seen[:, None, None], bundle.rotations, start.rotations),
        centres=np.where(seen[:, None], bundle.centres, start.centres + shift),
    )
    bundle = _fitted(bundle, own, _more(bundle, own, rows, progress), frames, places, sigmas, ups, SIGMAS_PX)
    while len(bundle) and (few := np.bincount(bundle.image, minlength=len(bundle)) < FEWEST_RAYS).any():
        bundle = bundle.without(few)
    return bundle if len(bundle) >= 2 else None


def _fitted(
    start: Bundle,
    features: Sequence[Features],
    rows: Verified,
    frames: Sequence[Frame],
    places: Array,
    place_sigmas: Array,
    ups: Array,
    sigmas_px: Sequence[float],
) -> Bundle:
    """Cameras adjusted to the tracks of matches, from where they are."""
    image, point, at = _tracks([pixels for pixels, _ in features], rows)
    points = np.zeros((point.max(initial=-1) + 1, 3))
    bundle = _triangulated(replace(start, points=points, image=image, point=point, pixels=at))
    unit = max(1.0, max(max(frames[i].width, frames[i].height) for i in start.frames) / UNIT_PX)
    for sigma in (unit * sigma for sigma in sigmas_px):
        if len(bundle.points) < FEWEST_RAYS:
            return bundle
        held = replace(
            held_by_images(bundle, frames),
            pixel_sigma=np.full(len(bundle.image), sigma),
            places=places,
            place_sigmas=place_sigmas,
            ups=ups,
            up_sigma=np.radians(UP_SIGMA_DEG),
            lens_fixed=np.ones(len(bundle.lenses), bool),
        )
        bundle = adjusted(bundle, held, tolerance=ROUGHLY).bundle
        bundle = bundle.kept(bundle.errors() < max(unit * FARTHEST_PX, 4 * sigma))
    return bundle.kept(bundle.errors() < unit * FARTHEST_PX)


def _first(
    start: Bundle, features: Sequence[Features], rows: Verified, priors: Sequence[Prior | None], seed: int
) -> Verified:
    """The matches, and of pairs with few those that agree with the priors among what is alike where these put it."""
    above = [p.world_from_camera[2, 3] for p in priors if p is not None]
    if not above:
        return rows
    tops = [z - p.world_from_camera[2, 3] for z, p in zip(start.centres[:, 2], priors, strict=True) if p is not None]
    level, height = float(np.median(tops)), float(np.median(above))
    heights = level + FIRST_HEIGHTS[0] * height, level + FIRST_HEIGHTS[1] * height
    unit, found = _unit(start), dict(rows)
    for i, j in _near(start, level):
        first, second = priors[i], priors[j]
        had = rows.get((i, j), np.zeros((0, 2), np.uint32))
        if first is None or second is None or len(had) >= ENOUGH:
            continue
        reach = FIRST_REACH_PX * max(unit[i], unit[j])
        new = _guided(start, (i, j), features, heights, reach)
        both = np.unique(np.concatenate([had, new]), axis=0)
        pixels = features[i][0][both[:, 0]], features[j][0][both[:, 1]]
        if (good := agreeing(first, second, pixels, seed, reach)).sum() > len(had):
            found[i, j] = both[good]
    return found


def _more(
    bundle: Bundle, features: Sequence[Features], rows: Verified, progress: Callable[[int, int], None] | None
) -> Verified:
    """The matches and those that the cameras' poses lead to."""
    least, most, more = RELIEF
    low, high = np.quantile(bundle.points[:, 2], [least, most])
    heights = float(low - more * (high - low)), float(high + more * (high - low))
    seen = np.bincount(bundle.image, minlength=len(bundle)) > 0
    unit, near, found = _unit(bundle), _near(bundle, float(low)), dict(rows)
    for done, (i, j) in enumerate(near):
        reach = (REACH_PX if seen[i] and seen[j] else FAR_REACH_PX) * max(unit[i], unit[j])
        new = _guided(bundle, (i, j), features, heights, reach)
        if len(new) and len(
            _guided(bundle, (i, j), _displaced(features, j, bundle), heights, reach)
        ) <= BY_CHANCE * len(new):
            found[i, j] = np.unique(np.concatenate([rows.get((i, j), new[:0]), new]), axis=0)
        if progress:
            progress(done + 1, len(near))
    return found


def _unit(bundle: Bundle) -> Array:
    """Pixels [n] of each image in those of :data:`UNIT_PX`."""
    return np.maximum(1.0, 2 * bundle.lenses[bundle.lens_of, 1:3].max(1) / UNIT_PX)


def _near(bundle: Bundle, ground: float) -> list[tuple[int, int]]:
    """Pairs i < j of images that may see common ground at a height: what is in their middles lies near."""
    corner = np.linalg.norm(bundle.lenses[bundle.lens_of, 1:3], axis=1) / bundle.lenses[bundle.lens_of, 0]
    above = np.maximum(bundle.centres[:, 2] - ground, 0)
    ahead = bundle.rotations[:, 2]
    middle = bundle.centres[:, :2] + ahead[:, :2] / np.maximum(-ahead[:, 2:], FLATTEST) * above[:, None]
    near: set[tuple[int, int]] = set()
    for i in range(len(bundle)):
        away = np.linalg.norm(middle - middle[i], axis=1)
        away[i] = np.inf
        partners = np.argsort(away, kind="stable")[:NEAREST]
        partners = partners[away[partners] < FOOTPRINTS_APART * 2 * corner[i] * above[i]]
        near |= {(min(i, j), max(i, j)) for j in partners.tolist()}
    return sorted(near)


def _guided(
    bundle: Bundle, pair: tuple[int, int], features: Sequence[Features], heights: tuple[float, float], reach: float
) -> NDArray[np.uint32]:
    looks = features[pair[0]][1], features[pair[1]][1]
    pixels = features[pair[0]][0][: len(looks[0])], features[pair[1]][0][: len(looks[1])]
    return guided_matches(bundle, pair, pixels, looks, heights, reach)


def _displaced(features: Sequence[Features], j: int, bundle: Bundle) -> list[Features]:
    """The features, with the key points of image j where they are not: what is found there is found by chance."""
    size = 2 * bundle.lenses[bundle.lens_of[j], 1:3]
    moved = list(features)
    moved[j] = (features[j][0] + DISPLACED * size) % size, features[j][1]
    return moved


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
