"""How far the camera moved from one image to another as their pictures tell, to be held against their positions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from overfly.geometry import Array
from overfly.preflight.ground import Placement
from overfly.preflight.images import THUMBNAIL, Look

WIDTH = THUMBNAIL // 2
"""Width of the pictures compared, pixels: coarse, so that trees and houses, which shift more than the ground, stay in
one cell, and 500 images that look down take two seconds, oblique ones five."""

LARGEST = 224
"""Cells along a side of the raster that holds a picture, at most: oblique ones are cut off far away."""

FINE = 1.5
"""Sigma of the filter that leaves the details, pixels."""

BORDER = 3
"""Pixels at the rim that the filter makes up."""

LEAST_NOISE = 2.0
"""Grey levels: contrast below it is not amplified to that of texture."""

LEAST_SHARED = 0.15
"""Share of a picture that two must have in common: less matches by chance."""

CLEAR, CLEAR_RATIO = 0.2, 1.3
"""Correlation, and its ratio to the second best place, from which a displacement counts. On 89 rendered flights of all
paths, with hills and trees and 30 to 80 % overlap, 6 of 1231 displacements between neighbours were then wrong, and 28
of 691 between every second image."""

LEAST_DOWN = 0.64
"""Cosine off straight down (50 degrees) beyond which the picture of level ground says nothing."""


@dataclass(frozen=True, eq=False)
class GroundPicture:
    """One image as seen from straight above, north up, ready to be compared.

    Attributes:
        spectra: of the filtered picture, its square and its mask.
        offset: x, y of the raster's middle from the camera, metres.
        area: cells seen.
    """

    spectra: tuple[NDArray[np.complexfloating], ...]
    offset: Array
    area: float


class Displacements:
    """Of the frames of a placement; each pair is compared once, when it is asked for."""

    def __init__(self, placed: Placement, looks: Sequence[Look]) -> None:
        """Take the images.

        Args:
            placed: n frames whose gimbal angles are known; those without are never compared, as a wrong position
                turns what is guessed from the track.
            looks: at the same n images.
        """
        self.placed, self.looks = placed, looks
        widths = np.array([c.width / c.fx for c in placed.cameras])
        self.cell = float(np.median(placed.heights) * np.median(widths)) / WIDTH
        self._size = _raster_size(placed, self.cell)
        self._pictures: dict[int, GroundPicture | None] = {}
        self._known: dict[tuple[int, int], Array | None] = {}

    def between(self, i: int, j: int) -> Array | None:
        """East and north from camera i to camera j [2], metres as far as the height over ground is right.

        None where the pictures do not tell it clearly.
        """
        if (i, j) not in self._known:
            a, b = self._picture(i), self._picture(j)
            alike = self.looks[i].digest == self.looks[j].digest
            self._known[i, j] = None if a is None or b is None or alike else _displacement(a, b, self.cell)
        return self._known[i, j]

    def _picture(self, i: int) -> GroundPicture | None:
        if i not in self._pictures:
            while len(self._pictures) > 8:  # tracks are walked along: the oldest is not asked for again soon
                self._pictures.pop(next(iter(self._pictures)))
            self._pictures[i] = self._rectified(i)
        return self._pictures[i]

    def _rectified(self, i: int) -> GroundPicture | None:
        import cv2
        from scipy.fft import rfft2

        thumbnail, camera, world = self.looks[i].thumbnail, self.placed.cameras[i], self.placed.poses[i]
        height, ahead = float(self.placed.heights[i]), world[:3, 2]
        if thumbnail is None or self.placed.frames[i].gimbal is None or ahead[2] > -LEAST_DOWN or height <= 0:
            return None
        small = cv2.resize(thumbnail, (WIDTH, max(8, round(WIDTH * camera.height / camera.width))),
                           interpolation=cv2.INTER_AREA)  # fmt: skip

        def smooth(values: NDArray) -> NDArray:
            return np.asarray(cv2.GaussianBlur(values, (0, 0), FINE, borderType=cv2.BORDER_REFLECT))

        # Only details, all of one contrast: light, exposure and vignetting differ from image to image.
        details = small - smooth(small)
        details = details / (np.sqrt(smooth(details * details)) + LEAST_NOISE)
        inner = np.zeros_like(small)
        inner[BORDER:-BORDER, BORDER:-BORDER] = 1
        size = self._size
        offset = np.round(ahead[:2] / -ahead[2] * height / self.cell) * self.cell
        scale = WIDTH / camera.width
        pixel = np.array([[camera.fx * scale, 0, camera.cx * scale], [0, camera.fy * scale, camera.cy * scale],
                          [0, 0, 1]])  # fmt: skip
        half = self.cell * size / 2
        ray = np.array([[self.cell, 0, offset[0] - half], [0, -self.cell, offset[1] + half], [0, 0, -height]])
        warp = pixel @ world[:3, :3].T @ ray
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        mask = (cv2.warpPerspective(inner, warp, (size, size), flags=flags) > 0.99).astype(np.float32)
        picture = cv2.warpPerspective(details, warp, (size, size), flags=flags) * mask
        # Twice the size, so that nothing wraps around.
        spectra = tuple(rfft2(values, (2 * size, 2 * size)) for values in (picture, picture * picture, mask))
        return GroundPicture(spectra, offset, float(mask.sum()))


def _raster_size(placed: Placement, cell: float) -> int:
    """Cells along a side that hold most footprints: one size, so that all images of a flight can be compared."""
    from scipy.fft import next_fast_len

    diagonals = np.array([np.hypot(c.width, c.height) / c.fx for c in placed.cameras]) * np.maximum(placed.heights, 0)
    down = np.maximum(-placed.poses[:, 2, 2], LEAST_DOWN)
    most = float(np.percentile(diagonals / down**2, 90)) / cell
    return min(next_fast_len(int(np.ceil(most)), real=True), LARGEST)


def _displacement(a: GroundPicture, b: GroundPicture, cell: float) -> Array | None:
    """Normalised cross correlation of what both see, at all displacements (Padfield, Masked object registration)."""
    from scipy.fft import irfft2

    if min(a.area, b.area) == 0:
        return None
    size = a.spectra[0].shape[0]

    def correlate(first: NDArray, second: NDArray) -> NDArray:
        return np.asarray(irfft2(np.conj(first) * second, (size, size)))

    product = correlate(a.spectra[0], b.spectra[0])
    energy = correlate(a.spectra[1], b.spectra[2]) * correlate(a.spectra[2], b.spectra[1])
    shared = np.maximum(correlate(a.spectra[2], b.spectra[2]), 0)
    enough = shared > LEAST_SHARED * min(a.area, b.area)
    alike = np.where(enough, product / np.sqrt(np.maximum(energy, 1e-2)), 0)
    # Small shares correlate highly by chance: more in common weighs more.
    score = alike * shared**0.75
    row, column = divmod(int(score.argmax()), size)
    best, clear = score[row, column], alike[row, column] >= CLEAR
    around = np.arange(-4, 5)
    score[np.ix_((row + around) % size, (column + around) % size)] = 0
    if not clear or best < CLEAR_RATIO * score.max():
        return None
    right, down = ((v + size // 2) % size - size // 2 for v in (column, row))
    return np.asarray(a.offset - b.offset - cell * np.array([right, -down]))
