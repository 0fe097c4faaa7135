"""Points of one frame's depth map: checked against the maps of its partners and averaged where they agree."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from overfly.cloud import Cloud, concatenate
from overfly.flights import Frame
from overfly.geometry import unproject
from overfly.mapping.compared import GATE, Partner, compared
from overfly.mapping.depth_map import DepthMap, Opinion
from overfly.mapping.point_sigma import point_sigmas, roughness
from overfly.mapping.subpixel import Map
from overfly.mapping.thinning import WALL
from overfly.mapping.wall_cloud import instead_of_words, wall_cloud
from overfly.mapping.walls import looked_up, measured_points, wall_points

WORST_SCORE = {True: 0.2, False: 0.3}
"""Smallest correlation of a point that several pairs confirm, and of one that only one pair has seen."""

UNMATCHED = 0.15
"""What is added to that for each further partner that speaks against the place (:class:`Compared`)."""

SURE_THOUGH_SEEN, SURER = 0.7, 0.1
"""Confidence from which on a network's word alone stands where another frame that has the place inside has matched
nothing, and what is added for each further one that speaks against it: against four it never stands."""

AGREED, AGREED_UNSEEN = 0.8, 0.6
"""Confidence from which on a depth stands that began with a network's word and that another frame agrees with: the
first where further frames speak against it, as on waves and in shadows, the second where none does. It is the
network's own, or, of a word that was moved to where images correlate, that of matched points."""

NEAR, AWAY = 4, 30
"""Voxels along a cell of the plan in which one matched point makes a guess needless: the first if it is sure
or frames agree, as the next constants say, the second else."""

EXACT_NEAR, AGREED_NEAR = 7.0, 0.9
"""What a guess needs to stand close to matched points: if one frame alone sees the place, at most so many ground pixels
of standard deviation; if a third frame says something else than the two that agree, so much confidence, which a word
that was moved to where two images correlate never has. If no third frame sees it, nothing."""

SAME_SURFACE, BESIDE, FAINT = 3.0, 2.0, 0.05
"""A network's word is moved by what it misses matched depths by around: those that are so many of its standard
deviations off or less, weighted by a Gaussian of so many of its pixels; the fewer there are, the less it moves."""

SPECK, ISLAND, ISLAND_SCORE = 15, 40, 0.7
"""Connected pieces of depth with fewer pixels are speckle; pieces up to the second size must correlate so well."""

SURELY = 0.5
"""Correlation from which on what one pair has matched serves as roof or ground of the walls in other frames."""

CONNECTED = 32
"""Standard deviations that neighbouring pixels of a piece may be apart: 8 pixels of disparity, as on walls."""


def cleaned(depth_map: DepthMap) -> dict[str, NDArray]:
    """The map without badly correlated pixels, speckle and what its network contradicts; then the network's word."""
    import cv2

    data = depth_map.load()
    depth = data["depth"]
    threshold = np.where(data["support"] >= 2, WORST_SCORE[True], WORST_SCORE[False])
    known = np.isfinite(depth) & (data["score"] >= threshold)
    opinion = depth_map.opinion()
    word = None if opinion is None else opinion.resized(depth.shape[1], depth.shape[0])
    if word is not None:
        known &= ~(data["paired"] & word.contradicts(depth, data["support"]))
    # Speckle is judged in steps of sigma along the inverse depth, where a slope is smooth.
    middle = float(np.median(depth[known])) if known.any() else 1.0
    unit = float(np.median((data["sigma"] / depth**2)[known])) if known.any() else 1.0
    steps = np.clip(np.where(known, (1 / np.where(known, depth, middle) - 1 / middle) / unit, -30000), -30000, 30000)
    for pixels, score in ((SPECK, np.inf), (ISLAND, ISLAND_SCORE)):
        labels = steps.astype(np.int16)
        cv2.filterSpeckles(labels, -30000, pixels, CONNECTED)
        known &= (labels > -30000) | (data["score"] >= score)
    depth = np.where(known, depth, np.float32(np.nan))
    if opinion is None or word is None:
        return {**data, "depth": depth}
    once = word.views < 2
    matched = np.where(data["paired"] & ~once, depth, np.float32(np.nan))
    said = word.depth + np.where(once, 0, _amiss(word, matched, opinion.depth.shape))
    # Where nothing could be measured, the network's word stands.
    guessed = ~known & np.isfinite(said)
    return {
        **data,
        "depth": np.where(guessed, said, depth),
        "sigma": np.where(guessed, word.sigma, data["sigma"]),
        "support": np.where(guessed, 0, data["support"]).astype(np.uint8),
        "guessed": guessed,
        "second": guessed | ~data["paired"],
        "sure": word.confidence,
        "once": once,
    }


def _amiss(word: Opinion, matched: Map, shape: tuple[int, int]) -> Map:
    """By how many metres a network's depths [H, W] are too small, as the matched ones around each pixel tell.

    Args:
        word: at full size.
        matched: depth [H, W], NaN where pairs have matched nothing.
        shape: of the network's own maps, in whose pixels :data:`BESIDE` is given.
    """
    import cv2

    off = matched - word.depth
    with np.errstate(invalid="ignore"):
        told = np.abs(off) < SAME_SURFACE * word.sigma
    total, weight = (
        cv2.GaussianBlur(cv2.resize(part, shape[::-1], interpolation=cv2.INTER_AREA), (0, 0), BESIDE)
        for part in (np.where(told, off, np.float32(0)), told.astype(np.float32))
    )
    return np.asarray(cv2.resize(total / (weight + FAINT), matched.shape[::-1], interpolation=cv2.INTER_LINEAR))


def frame_points(
    own: DepthMap,
    data: Mapping[str, NDArray],
    partners: Iterable[Partner],
    frame: Frame,
    single: bool,
    walls: bool = False,
) -> tuple[Cloud, NDArray[np.uint8], NDArray[np.bool_], float]:
    """The points of one map that earlier maps have not given.

    Args:
        own, data: the map and its cleaned content.
        partners: of each map that it is compared with, the map, its cleaned content and, if it was asked before this
            one, the pixels [H, W] that it has given.
        frame: it was made from, for the colours.
        single: keep points that only one pair has seen.
        walls: add what the frame shows of walls that nobody has matched, also in place of what the network alone says
            there; the frame of reference is in metres.

    Returns:
        The points; how far apart [N] from matched points they stand (:func:`overfly.mapping.thinning.thinned_tile`), 0
        for what pairs have matched; which pixels [H, W] later frames need not give: given now, doubted, or
        replaced by a wall; and metres per pixel.
    """
    depth: Map = data["depth"]
    guessed = data.get("guessed", np.zeros(depth.shape, bool))
    second = data.get("second", guessed)
    once = data.get("once", np.zeros(depth.shape, bool))
    around: list[NDArray] = []
    seen = compared(own, data, second, _noted(own, partners, around) if walls else partners)
    agree = seen.agree
    # Where nobody agrees one of them is the partner that it was matched with, whose own map leaves such places out.
    silent = np.maximum(seen.against.astype(np.int8) - (agree == 0), 0)
    votes = np.maximum(agree, data["support"])
    several = data["support"] >= 2
    known = np.isfinite(depth) & (votes >= (1 if single else 2)) & ((agree >= 1) | seen.slope | several)
    # Scores are whole hundredths.
    known &= guessed | several | (data["score"] > WORST_SCORE[False] + UNMATCHED * silent - 0.005)
    alone = guessed & (agree == 0)  # predicted: no other frame agrees
    if "once" in data:
        alone &= once | (data["sure"] > SURE_THOUGH_SEEN + SURER * silent)
    own_word = data["sure"] if "sure" in data else np.float32(0)
    confidence = np.where(guessed, own_word, _confidence(votes, agree, data["score"])).astype(np.float32)
    doubted = second & ~alone & (confidence < np.where(silent > 0, AGREED, AGREED_UNSEEN))
    exact = seen.sigma * own.camera.fx <= EXACT_NEAR * depth
    near = np.where(alone, once & exact, (silent == 0) | (confidence >= AGREED_NEAR))
    apart = np.where(second, np.where(near, NEAR, AWAY), 0).astype(np.uint8)
    image, shown = _shown(frame, own)
    known = (known | alone) & shown
    # What is doubted counts as given: else Brighton gets twice the false points, from frames that agree by chance, too.
    # The price: a later frame that is surer of the place is not asked.
    fresh = known & ~seen.taken & ~doubted
    on_walls = None
    if walls:
        # Blank is also where a word was doubted, or is the network's alone: at walls it is wrong nine times in ten.
        left = np.where(known & ~alone & ~doubted, seen.depth, np.float32(np.nan))
        left = np.where(shown, left, np.float32(np.inf))
        on_walls = wall_points(left, ~second, own.camera, own.world_from_camera, around)
        on_walls, words = instead_of_words(
            on_walls, own, np.where(alone, seen.depth + GATE * seen.sigma, np.float32(np.nan))
        )
        fresh &= ~words
    merged = seen.depth[fresh]
    rows, columns = np.nonzero(fresh)
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=1)
    points = unproject(pixels, merged, own.camera, own.world_from_camera)
    rough = roughness(np.where(known, seen.depth, np.float32(np.nan)), own.camera.fx)
    sigma = point_sigmas(
        rough[fresh], agree[fresh], data["score"][fresh], confidence[fresh], seen.sigma[fresh], merged, own.camera.fx,
        second=second[fresh], alone=alone[fresh], once=once[fresh],
    )  # fmt: skip
    cloud = Cloud(
        points,
        image[rows, columns],
        confidence=confidence[fresh],
        sigma_m=sigma,
        views=(1 + votes[fresh]).astype(np.uint8),
        predicted=alone[fresh],
    )
    apart = apart[fresh]
    if on_walls is not None:
        cloud = concatenate([cloud, wall_cloud(on_walls, own, image)])
        apart = np.concatenate([apart, np.full(len(on_walls.points), WALL + on_walls.voxels, np.uint8)])
    measured = merged[~second[fresh]] if (~second[fresh]).any() else merged
    gsd = float(np.median(measured)) / own.camera.fx if len(merged) else float("nan")
    return cloud, apart, known, gsd


def _noted(own: DepthMap, partners: Iterable[Partner], around: list[NDArray]) -> Iterator[Partner]:
    """The partners as they come; what each has surely measured inside a frame is noted in ``around``, points [M, 3]."""
    for partner, data, given in partners:
        sure = (data["support"] >= 2) | (data["score"] >= SURELY)
        if "second" in data:
            sure &= ~data["second"]
        depth = np.where(sure, data["depth"], np.float32(np.nan))
        points = measured_points(depth, partner.camera, partner.world_from_camera)
        around.append(points[looked_up(points, own.camera, own.world_from_camera)[-1]])
        yield partner, data, given


def _shown(frame: Frame, own: DepthMap) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """The frame's image in the pixels of its depth map [H, W, 3], and which of them [H, W] the lens has shown."""
    import cv2

    assert frame.camera is not None
    lens = frame.camera.resized(own.camera.width, own.camera.height)
    image = frame.image()
    if image.shape[:2] != (lens.height, lens.width):
        image = cv2.resize(image, (lens.width, lens.height), interpolation=cv2.INTER_AREA)
    whole = np.full(image.shape[:2], 255, np.uint8)
    if lens.is_distorted:
        matrix = lens.matrix()
        matrix[:2, 2] -= 0.5
        image, whole = (np.asarray(cv2.undistort(part, matrix, lens.distortion)) for part in (image, whole))
    return image, whole == 255


def _confidence(votes: NDArray, agree: NDArray, score: NDArray) -> NDArray[np.float32]:
    """0..1 from the number of confirming pairs and maps and the correlation."""
    base = np.select([(votes <= 1) & (agree == 0), agree == 0, agree == 1], [0.45, 0.7, 0.85], 0.95)
    return (base * np.clip(0.4 + 0.7 * score, 0, 1)).astype(np.float32)
