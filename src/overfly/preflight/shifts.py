"""The shift of the picture from each image to the next, by which the height over ground is found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from overfly.geometry import Array
from overfly.preflight.images import THUMBNAIL, Look

CLEAR_PEAK = 0.15
"""Response of the phase correlation at which the shift of two neighbours counts (0.03 is noise)."""


@dataclass(frozen=True, eq=False)
class Shifts:
    """Shift of the picture between each frame and the next, in widths of the image [n - 1, 2]; NaN where unclear."""

    xy: Array

    def angles(self) -> Array:
        """Direction of the drone's motion in the image, degrees clockwise from its top [n - 1]."""
        return np.asarray(np.degrees(np.arctan2(-self.xy[:, 0], self.xy[:, 1])))


def shifts_of(looks: Sequence[Look]) -> Shifts:
    """Phase correlation of neighbouring thumbnails of n images: shifts up to half a picture, views that look alike."""
    import cv2

    found = np.full((max(len(looks) - 1, 0), 2), np.nan)
    # OpenCV applies the window to its arguments where they need no padding: what others look at must not be given. A
    # picture is so windowed once as the second and once more as the first of a pair; CLEAR_PEAK was found with that.
    own = [None if look.thumbnail is None else look.thumbnail.copy() for look in looks]
    for i, (a, b) in enumerate(pairwise(own)):
        if a is None or b is None or a.shape != b.shape:
            continue
        window = cv2.createHanningWindow(a.shape[::-1], cv2.CV_32F)
        shift, peak = cv2.phaseCorrelate(a, b, window)
        if peak >= CLEAR_PEAK and looks[i].digest != looks[i + 1].digest:
            found[i] = np.array(shift) / THUMBNAIL
    return Shifts(found)
