"""Images and cameras of a flight at the sizes that the dense step works with, a few images in memory."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from overfly.data.windows import resample
from overfly.flights import Frame
from overfly.geometry import Camera
from overfly.mapping.subpixel import Shot

LEAST_MATCHED = 800
"""Longest side, pixels, at which pairs are matched at the least, where images have so many."""


class Views:
    """Images and cameras of a flight at the working size and the size at which pairs are matched, a few in memory."""

    def __init__(self, frames: Sequence[Frame], max_size: int) -> None:
        self.frames = frames
        self.poses = [np.asarray(f.world_from_camera, float) for f in frames]
        self.lens: list[Camera] = []
        for frame in frames:
            assert frame.camera is not None
            factor = min(1.0, max_size / max(frame.width, frame.height))
            self.lens.append(frame.camera.resized(round(frame.width * factor), round(frame.height * factor)))
        self.matched_lens = [_for_matching(c) for c in self.lens]
        self.full = [c.undistorted() for c in self.lens]
        self.matched = [c.undistorted() for c in self.matched_lens]
        self.gray = lru_cache(maxsize=12)(self._gray)
        self.shot = lru_cache(maxsize=12)(self._shot)

    def _gray(self, i: int) -> NDArray[np.uint8]:
        import cv2

        image = cv2.cvtColor(self.frames[i].image(), cv2.COLOR_RGB2GRAY)
        size = (self.lens[i].width, self.lens[i].height)
        return image if image.shape[::-1] == size else cv2.resize(image, size, interpolation=cv2.INTER_AREA)

    def small(self, i: int, camera: Camera) -> NDArray[np.uint8]:
        """The frame in colour as an undistorted camera of fewer pixels sees it [h, w, 3]."""
        camera_of = self.frames[i].camera
        assert camera_of is not None
        return resample(self.frames[i].image(), camera_of, camera)

    def matched_gray(self, i: int) -> NDArray[np.uint8]:
        import cv2

        size = (self.matched[i].width, self.matched[i].height)
        return cv2.resize(self.gray(i), size, interpolation=cv2.INTER_AREA)

    def matched_shot(self, i: int) -> Shot:
        """The undistorted frame at the size at which pairs are matched."""
        import cv2

        whole, small = self.shot(i), self.matched[i]
        gray = cv2.resize(whole.gray, (small.width, small.height), interpolation=cv2.INTER_AREA)
        return Shot(gray, small, self.poses[i])

    def _shot(self, i: int) -> Shot:
        import cv2

        lens = self.lens[i]
        image = self.gray(i)
        if lens.is_distorted:
            matrix = lens.matrix()
            matrix[:2, 2] -= 0.5
            image = cv2.undistort(image, matrix, lens.distortion)
        return Shot(image.astype(np.float32), self.full[i], self.poses[i])


def _for_matching(camera: Camera) -> Camera:
    """The camera at half the size, but not under :data:`LEAST_MATCHED`: smaller pictures lose roofs and walls."""
    longest = max(camera.width, camera.height)
    factor = max(0.5, min(1.0, LEAST_MATCHED / longest))
    return camera.resized(max(16, round(camera.width * factor)), max(16, round(camera.height * factor)))
