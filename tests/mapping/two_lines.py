"""Two lines of frames over rough ground, for tests of what matches and priors make of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from overfly.flights import Frame
from overfly.geometry import Camera, pose, project, rotation_from_gimbal

CAMERA = Camera(800, 600, 600.0, 600.0, 400.0, 300.0)
SHOWN = 250
"""Key points of a frame."""


class Block:
    """Two lines of four frames at 100 m over rough ground; every ground point has a descriptor of its own.

    The second line is tilted, and then stands so far back that it looks at the same ground.
    """

    def __init__(self, seed: int = 0, tilt: float = 0.0) -> None:
        rng = np.random.default_rng(seed)
        self.places = np.array([(60.0 * (k // 4), 45.0 * (k % 4), 100.0) for k in range(8)])
        self.places[4:, 1] += 100.0 * np.tan(np.radians(tilt))
        self.yaws = np.where(np.arange(8) < 4, 0.0, 180.0)
        pitches = np.where(np.arange(8) < 4, -90.0, tilt - 90.0)
        looks_at = [rotation_from_gimbal(yaw, pitch) for yaw, pitch in zip(self.yaws, pitches, strict=True)]
        self.poses = np.stack([pose(turn, place) for turn, place in zip(looks_at, self.places, strict=True)])
        self.ground = np.column_stack([rng.uniform(-80, 220, (2500, 2)), rng.uniform(0, 8, 2500)])
        looks = rng.integers(0, 80, (2500, 128)).astype(np.uint8)
        self.features, self.seen = [], []
        for matrix in self.poses:
            pixels, depth = project(self.ground, CAMERA, matrix)
            inside = np.flatnonzero((depth > 0) & ((pixels > 0) & (pixels < (800, 600))).all(1))
            shown = rng.permutation(inside)[:SHOWN]
            self.seen.append(shown)
            noisy = pixels[shown] + rng.normal(0, 0.2, (len(shown), 2))
            self.features.append((noisy, np.clip(looks[shown] + rng.integers(0, 4, (len(shown), 128)), 0, 255)))
        # Priors: GPS off by 2 m, all headings by 2 degrees and each by half a degree.
        self.told = self.places + rng.normal(0, 2, (8, 3))
        self.frames = [
            Frame(
                f"{k}.jpg",
                Path(f"{k}.jpg"),
                800,
                600,
                focal_px=600.0,
                gimbal=(float(yaw), float(pitches[k]) + 0.3, 0.0),
            )
            for k, yaw in enumerate(self.yaws + 2 + rng.normal(0, 0.5, 8))
        ]

    def common(self, most: int, without: int = -1) -> dict[tuple[int, int], np.ndarray]:
        """Right matches, at most so many of a pair, none of one frame."""
        found = {}
        for i in range(8):
            for j in range(i + 1, 8):
                both = np.intersect1d(self.seen[i], self.seen[j], return_indices=True)
                if len(both[0]) >= 3 and without not in (i, j):
                    found[i, j] = np.column_stack(both[1:])[:most].astype(np.uint32)
        return found
