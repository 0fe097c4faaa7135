"""A textured hill whose height is known everywhere, and frames that look at it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest

from overfly.flights import Flight, Frame, Gps
from overfly.geodesy import Origin, geodetic_from_enu
from overfly.geometry import Array, Camera, on_plane, pixel_grid, pose, rays, rotation_from_gimbal

ORIGIN = Origin(52.2, 21.0, 100.0)


@contextmanager
def bar(step: str, what: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar that shows nothing."""
    yield lambda done, total: None


@pytest.fixture(scope="module")
def few_features() -> Iterator[None]:
    """Small images need few key points, and tests little time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("overfly.mapping.features.FEATURES", 1200)
        yield


class Hill:
    """Ground z = height(x, y), with a texture that is the same from everywhere."""

    size = 240.0  # metres

    def __init__(self) -> None:
        rng = np.random.default_rng(3)
        texture = np.zeros((960, 960))
        for octave in range(7):
            cells = 15 * 2**octave
            noise = rng.uniform(size=(cells, cells)).astype(np.float32)
            texture += cv2.resize(noise, (960, 960), interpolation=cv2.INTER_CUBIC) * 0.8**octave
        low, high = np.quantile(texture, [0.01, 0.99])
        self.texture = np.clip((texture - low) / (high - low) * 215 + 20, 0, 255).astype(np.float32)

    def height(self, xy: Array) -> Array:
        x, y = xy[..., 0], xy[..., 1]
        return 4 * np.sin(x / 17) * np.cos(y / 23) + 0.05 * x

    def surface(self, camera: Camera, world_from_camera: Array) -> Array:
        """World points [H, W, 3] under the pixels' centres."""
        pixels = pixel_grid(camera.width, camera.height)
        direction = rays(pixels, camera) @ world_from_camera[:3, :3].T
        centre = world_from_camera[:3, 3]
        points = on_plane(pixels, camera, world_from_camera, 0.0)
        for _ in range(25):
            distance = (self.height(points) - centre[2]) / direction[..., 2]
            points = centre + direction * distance[..., None]
        return points

    def render(self, camera: Camera, world_from_camera: Array) -> np.ndarray:
        """[H, W, 3] uint8."""
        points = self.surface(camera, world_from_camera)
        place = (points[..., :2] / self.size + 0.5) * self.texture.shape[0] - 0.5
        gray = cv2.remap(
            self.texture, place[..., 0].astype(np.float32), place[..., 1].astype(np.float32), cv2.INTER_CUBIC
        )
        return np.repeat(np.clip(np.round(gray), 0, 255).astype(np.uint8)[..., None], 3, axis=2)

    def frames(
        self, folder: Path, camera: Camera, poses: Sequence[Array], *, known: bool, gps: bool = True
    ) -> list[Frame]:
        """Frames on disk; ``known`` gives them their cameras."""
        found = []
        for i, world_from_camera in enumerate(poses):
            path = folder / f"{i:02d}.png"
            cv2.imwrite(str(path), self.render(camera, world_from_camera)[..., ::-1])
            latitude, longitude, height = geodetic_from_enu(world_from_camera[:3, 3], ORIGIN)[0]
            found.append(
                Frame(
                    name=path.name,
                    path=path,
                    width=camera.width,
                    height=camera.height,
                    camera=camera if known else None,
                    world_from_camera=world_from_camera if known else None,
                    gps=Gps(float(latitude), float(longitude), float(height)) if gps else None,
                    focal_px=camera.fx * 1.01,
                )
            )
        return found

    def flight(self, folder: Path, camera: Camera, poses: Sequence[Array], *, gps: bool = True) -> Flight:
        return Flight(folder, self.frames(folder, camera, poses, known=False, gps=gps))

    def off(self, points: Array) -> Array:
        """Height of points [N, 3] above the ground."""
        return points[:, 2] - self.height(points)


def nadir(x: float, y: float, z: float = 80.0, *, yaw: float = 0.0, pitch: float = -90.0, roll: float = 0.0) -> Array:
    """``world_from_camera`` of a camera at x, y, z that looks down."""
    return pose(rotation_from_gimbal(yaw, pitch, roll), [x, y, z])


@pytest.fixture(scope="session")
def hill() -> Hill:
    return Hill()


@pytest.fixture(scope="session")
def strips() -> list[Array]:
    """Two strips of four, flown to and fro: 65 % forward and 55 % side overlap for :data:`CAMERA`."""
    rng = np.random.default_rng(1)
    poses = []
    for row, yaw in enumerate((0.0, 180.0)):
        for step in range(4):
            y = (step - 1.5) * 22 * (1 if row == 0 else -1)
            sway = rng.normal(0, 1.5, 3)
            poses.append(
                nadir((row - 0.5) * 36, y, 80 + rng.normal(0, 2), yaw=yaw + sway[0], pitch=-88 + sway[1], roll=sway[2])
            )
    return poses


@pytest.fixture(scope="session")
def camera() -> Camera:
    return Camera(320, 240, 320.0, 320.0, 160.0, 120.0, k1=-0.02, k2=0.01)
