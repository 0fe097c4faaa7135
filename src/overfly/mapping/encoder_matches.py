"""Key points and correspondences of the encoder between the frames of a flight, in pixels of the full images.

Two octaves, then the full images. At 256 pixels' width the encoder finds how one frame lies in the other, starting from
the ground plane between them where GPS and gimbal are known, and from quarter turns. Seen so, both look alike, and at
512 pixels their match maps are compared for the key points. Correlation of the full images makes each correspondence
precise, and throws away what does not agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from overfly.geometry import Array
from overfly.mapping.correlate import refine
from overfly.mapping.overlays import Prior, by_priors, quarter_turns
from overfly.networks.encoder import MATCH_STRIDE, Encoder
from overfly.networks.matching import cell_pixels, keypoints, nearest, nearest_around, sample

WIDTHS = (256, 512)
"""Longer side of the images that the encoder compares, pixels."""

POINTS = (400, 1200)
"""Key points of a frame in each of them."""

FEWEST = 15
"""Coarse correspondences that must agree about how a frame lies in another; otherwise there is no common ground."""

ENOUGH = 40
"""Coarse correspondences that agree by no chance: no other guess is better by much."""

AGREEMENT = 0.75
"""Correlation of the full images from which on a correspondence counts."""

OFF = 1 / 60
"""How far off the common affinity a coarse correspondence may be, widths: what stands high moves more."""

REACH = 1 / 6
"""How far off the common affinity a fine correspondence is looked for, widths: houses of a fifth of the flight's height
move by so much at 30 % overlap."""

OFF_PX = 1.5
"""How far off a fine correspondence may be, pixels of the compared images."""


@dataclass(frozen=True, eq=False)
class Octave:
    """A frame at one of the widths: what the encoder sees and answers.

    Attributes:
        image: [h, w, 3].
        scale: [2] pixels of the full image for one of this.
        match_map: unit vectors [C, h / 2, w / 2].
        cells: [M] its key points, most distinctive first.
        centres: [M, 2] the pixels on which they are centred.
    """

    image: NDArray[np.uint8]
    scale: Array
    match_map: Tensor
    cells: Tensor
    centres: Array


@dataclass(frozen=True, eq=False)
class Picture:
    """What the matching keeps of a frame.

    Attributes:
        gray: the full image [H, W].
        octaves: the coarse and the fine one.
        points: key points [M, 2], pixels of the full image: the sharpest corners in the fine octave's.
        prior: roughly where the frame was taken from, if that is known.
    """

    gray: NDArray[np.uint8]
    octaves: tuple[Octave, Octave]
    points: Array
    prior: Prior | None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the full image."""
        return self.gray.shape[1], self.gray.shape[0]


class Correspondences(NamedTuple):
    """Key points of one picture that were found in another.

    Attributes:
        rows: [m] of the first picture's ``points``.
        pixels: [m, 2] in the second full image.
        correlation: [m] of the full images there.
    """

    rows: NDArray[np.int64]
    pixels: Array
    correlation: Array


def picture(encoder: Encoder, image: NDArray[np.uint8], prior: Prior | None = None) -> Picture:
    """Look at an image [H, W, 3]: match maps and key points."""
    import cv2

    coarse, fine = (_octave(encoder, image, *sizes) for sizes in zip(WIDTHS, POINTS, strict=True))
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return Picture(gray, (coarse, fine), _corners(gray, fine.centres * fine.scale, MATCH_STRIDE * fine.scale), prior)


def match_pair(
    encoder: Encoder, first: Picture, second: Picture, second_from_first: Array | None = None
) -> Correspondences:
    """Find the key points of one picture in another.

    Args:
        encoder: a trained network's encoder.
        first, second: from :func:`picture`.
        second_from_first: from :func:`overlay`, which is asked if it is not given.

    Returns:
        The correspondences that are each other's best in the match maps, whose patches agree in the full images; none
        where nothing says how the pictures overlap.
    """
    seen_as = overlay(encoder, first, second) if second_from_first is None else second_from_first
    if seen_as is None:
        return Correspondences(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0))
    fine, other = first.octaves[1], second.octaves[1]
    index, at = _mutual(encoder, fine, other, seen_as, REACH * max(fine.image.shape))
    expected = at * fine.scale + first.points[index] - fine.centres[index] * fine.scale  # of the corner in its cell
    pixels, correlation = refine(
        first.gray, second.gray, first.points[index], _moved(seen_as, expected), _jacobians(seen_as, expected),
        error_px=OFF_PX * float(other.scale.max()),
    )  # fmt: skip
    good = correlation >= AGREEMENT
    return Correspondences(index[good], pixels[good], correlation[good])


def overlay(encoder: Encoder, first: Picture, second: Picture, guesses: Sequence[Array] | None = None) -> Array | None:
    """How the second picture lies on the first: a homography [3, 3] of full pixels, second from first; None if nowhere.

    The guess is taken about which most coarse correspondences agree up to an affinity, which then improves it; the
    first about which :data:`ENOUGH` do ends the search.

    Args:
        encoder: a trained network's encoder.
        first, second: from :func:`picture`.
        guesses: homographies; None: the ground plane between priors (:func:`by_priors`), then four quarter turns.
    """
    import cv2

    coarse, other = first.octaves[0], second.octaves[0]
    best, most = None, FEWEST - 1
    if guesses is None:
        guesses = [*by_priors(first.prior, second.prior), *quarter_turns(first.size, second.size)]
    for guess in guesses:
        if most >= ENOUGH:
            break
        index, at = _mutual(encoder, coarse, other, guess)
        if len(index) <= most:
            continue
        off = OFF * max(coarse.image.shape)
        affinity, agree = cv2.estimateAffine2D(
            coarse.centres[index], at, method=cv2.USAC_MAGSAC, ransacReprojThreshold=off, maxIters=3000
        )
        if affinity is not None and int(agree.sum()) > most:
            most = int(agree.sum())
            scale = np.diag([*coarse.scale, 1.0])
            best = guess @ scale @ np.vstack([affinity, [0, 0, 1]]) @ np.linalg.inv(scale)
    return best


@torch.no_grad()
def _octave(encoder: Encoder, image: NDArray[np.uint8], longer: int, points: int) -> Octave:
    import cv2

    height, width = image.shape[:2]
    shrink = longer / max(height, width)
    size = tuple(max(32, round(side * shrink / 32) * 32) for side in (width, height))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    match_map = _match_map(encoder, small)
    cells, score = keypoints(match_map[None], points)
    chosen = cells[0, torch.isfinite(score[0])]
    centres = cell_pixels(*match_map.shape[1:])[chosen].double().numpy()
    return Octave(small, np.array([width, height]) / size, match_map, chosen, centres)


def _match_map(encoder: Encoder, image: NDArray[np.uint8]) -> Tensor:
    return encoder.dense(torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255).match_map[0]


@torch.no_grad()
def _mutual(
    encoder: Encoder, first: Octave, second: Octave, seen_as: Array, reach: float | None = None
) -> tuple[NDArray[np.int64], Array]:
    """Key points [m] of the first and where [m, 2] the second shows them, in the first's pixels, each other's best.

    Args:
        seen_as: homography of full pixels, second from first, by which the second is seen as from the first.
        reach: pixels off where that puts a key point within which it is looked for; None: everywhere.
    """
    import cv2

    height, width = first.image.shape[:2]
    margin = np.array([width // 8, height // 8]) // 8 * 8
    canvas = np.diag([*first.scale, 1.0]) @ np.array([[1, 0, -margin[0]], [0, 1, -margin[1]], [0, 0, 1.0]])
    own = np.linalg.inv(np.diag([*second.scale, 1.0])) @ seen_as @ canvas
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    seen = cv2.warpPerspective(
        second.image,
        np.linalg.inv(half) @ own @ half,  # cv2 counts pixel centres from 0
        (width + 2 * int(margin[0]), height + 2 * int(margin[1])),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    match_map = _match_map(encoder, seen)
    queries = first.match_map.flatten(1)[:, first.cells].T
    if reach is None:
        there = nearest(queries[None], match_map[None])[0][0]
    else:
        there, _ = nearest_around(queries, match_map, torch.from_numpy(first.centres + margin).float(), reach)
    looked_for = F.normalize(sample(match_map[None], there[None]), dim=2)
    if reach is None:
        back = nearest(looked_for, first.match_map[None])[0][0]
    else:
        back, _ = nearest_around(looked_for[0], first.match_map, there - torch.from_numpy(margin).float(), reach)
    mutual = np.abs(back.numpy() - first.centres).max(1, initial=0) <= MATCH_STRIDE
    at = there.double().numpy()
    inside = (np.abs(_moved(own, at) / second.image.shape[1::-1] - 0.5) < 0.5).all(1)
    index = np.flatnonzero(mutual & inside)
    return index, at[index] - margin


def _moved(homography: Array, pixels: Array) -> Array:
    at = np.column_stack([pixels, np.ones(len(pixels))]) @ homography.T
    return np.asarray(at[:, :2] / at[:, 2:])


def _jacobians(homography: Array, pixels: Array) -> Array:
    """How the homography turns and scales the surroundings of pixels: [M, 2, 2]."""
    here = _moved(homography, pixels)
    return np.stack([_moved(homography, pixels + step) - here for step in np.eye(2)], axis=2)


def _corners(gray: NDArray[np.uint8], centres: Array, size: Array) -> Array:
    """The sharpest corner within ``size`` pixels around each centre: pixels [M, 2]."""
    import cv2

    sharp = cv2.cornerMinEigenVal(gray, blockSize=5)
    half = np.maximum(size / 2, 1).astype(int)
    dx, dy = (x.ravel() for x in np.meshgrid(np.arange(-half[0], half[0] + 1), np.arange(-half[1], half[1] + 1)))
    start = np.floor(centres).astype(int)
    column = np.clip(start[:, :1] + dx, 0, gray.shape[1] - 1)
    row = np.clip(start[:, 1:] + dy, 0, gray.shape[0] - 1)
    best = sharp[row, column].argmax(1)[:, None] if len(centres) else np.zeros((0, 1), int)
    corner = [np.take_along_axis(x, best, axis=1)[:, 0] for x in (column, row)]
    return np.stack(corner, 1) + 0.5
