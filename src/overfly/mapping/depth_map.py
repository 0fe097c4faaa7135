"""The depth of one frame: what pairs measured, what a network said, and the file both are kept in."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from overfly.files import opened_arrays
from overfly.geometry import Array, Camera, pixel_grid, rays
from overfly.mapping.anchor import RIGHT, Map, anchored

OBLIQUE_DEG = 20.0
"""Tilt from which on an image is oblique."""


def is_oblique(world_from_camera: Array) -> bool:
    """Whether a frame [4, 4], z up, is tilted so far from looking down."""
    return bool(world_from_camera[2, 2] > -np.cos(np.deg2rad(OBLIQUE_DEG)))


ONE_SIGMA = 0.683
"""Share of errors below one standard deviation."""

CONTRADICTED, BY_PAIRS = (1.6, 8.0), 1.5
"""What was matched is dropped if it is so many of the network's standard deviations off its word: the first where the
network is not sure at all, since images match badly there, the second where it is quite sure and may only have rounded
a wall off; between them in even ratios; and so many times that if several pairs agree. On six rendered flights this
drops 0.6 to 3.6 % of the matched pixels that correlate, of which 2 to 32 % are right to 1 m; of all that one pair alone
has matched 53 to 81 % are."""


@dataclass(frozen=True)
class Opinion:
    """What a network says of a frame before any pixel is matched: maps [h, w] over its undistorted image.

    Attributes:
        depth: metres, NaN where it knows nothing.
        sigma: metres, about 70 % of the errors are below it.
        confidence: 0..1, the probability that the depth is right.
        views: frames that have the place inside, this one included.
        alone: metres, the depth that this frame suggests without any other.
    """

    depth: Map
    sigma: Map
    confidence: Map
    views: NDArray[np.uint8]
    alone: Map

    def resized(self, width: int, height: int) -> Opinion:
        """The same maps [height, width]."""
        import cv2

        parts = {
            name: cv2.resize(part, (width, height), interpolation=cv2.INTER_LINEAR)
            for name, part in vars(self).items()
            if name != "views"
        }
        return Opinion(**parts, views=cv2.resize(self.views, (width, height), interpolation=cv2.INTER_NEAREST))

    def contradicts(self, depth: Map, support: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Where several frames have the place inside and their surface is another than what was matched.

        Args:
            depth: what pairs have matched, of the opinion's own size, metres.
            support: pairs that agree.
        """
        return (self.views >= 2) & contradicted(depth - self.depth, support, self.sigma, self.confidence)

    def settled(self, measured: Map, camera: Camera, world_from_camera: Array) -> Opinion:
        """The opinion after the frame was measured: places seen once follow the measured ones around them.

        Args:
            measured: depth [H, W] of the whole image, NaN where nothing is sure.
            camera: undistorted, of any size.
            world_from_camera: [4, 4].
        """
        import cv2

        once = self.views < 2
        if not once.any():
            return self
        height, width = self.depth.shape
        fall = rays(pixel_grid(width, height), camera.resized(width, height)) @ world_from_camera[2, :3]
        fall = np.minimum(fall, -0.1).astype(np.float32)  # metres down per metre of depth
        small = cv2.resize(measured, (width, height), interpolation=cv2.INTER_NEAREST)
        asked = ~once if is_oblique(world_from_camera) else None
        heights, sure = anchored((self.alone * fall).astype(np.float32), (small * fall).astype(np.float32), asked)
        # A slope carried on far enough passes the camera.
        depth = np.where(heights < 0, heights / fall, np.float32(np.nan))
        # The standard deviation of a Laplace distribution of which so much is right.
        sigma = RIGHT * depth * np.log(1 - ONE_SIGMA) / np.log(1 - np.clip(sure, 0.01, 0.99))
        return replace(
            self,
            depth=np.where(once, depth, self.depth).astype(np.float32),
            sigma=np.where(once, sigma, self.sigma).astype(np.float32),
            confidence=np.where(once, sure, self.confidence).astype(np.float32),
        )


def contradicted(off: NDArray, support: NDArray, sigma: NDArray, confidence: NDArray) -> NDArray[np.bool_]:
    """Which matched places a network contradicts, arrays of one shape; not those of which either says nothing (NaN).

    Args:
        off: how far what was matched is from the network's word, metres.
        support: pairs that agree.
        sigma, confidence: of the network's word; metres, 0..1.
    """
    unsure, sure = CONTRADICTED
    limit = sigma * unsure * (sure / unsure) ** confidence
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(off) > np.where(support < 2, limit, BY_PAIRS * limit))


@dataclass(frozen=True)
class DepthMap:
    """Depth of one frame, kept in a file.

    Attributes:
        name: of the frame.
        camera: undistorted, at the size of the maps.
        world_from_camera: [4, 4].
        partners: names of the frames it was compared with.
        path: .npz with depth [H, W] in metres (NaN where unknown), sigma [H, W] in metres, support [H, W], the number
            of pairs that agree, and score [H, W], the correlation with its best partners (-1..1), and paired
            [H, W], whether any pair was matched there; with a network, its own ``opinion`` [h, w] too.
    """

    name: str
    camera: Camera
    world_from_camera: Array
    partners: list[str]
    path: Path

    def load(self) -> dict[str, NDArray]:
        """What pairs have measured.

        Raises:
            Damaged: the file is missing, cut off or changed.
        """
        with opened_arrays(self.path) as data:
            return {
                "depth": data["depth"],
                "sigma": data["sigma"].astype(np.float32),
                "support": data["support"],
                "score": data["score"].astype(np.float32) / 100,
                "paired": data["paired"],
            }

    def opinion(self) -> Opinion | None:
        """What the network said of the frame, None without one."""
        with opened_arrays(self.path) as data:
            if "opinion_depth" not in data:
                return None
            return Opinion(*(data[f"opinion_{name}"] for name in ("depth", "sigma", "confidence", "views", "alone")))
