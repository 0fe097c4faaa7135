"""The renderer: images with exact depth, height maps and surface points of a scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from overfly.errors import InputError
from overfly.geometry import Camera, is_rotation
from overfly.scenes.appearance import Appearance
from overfly.scenes.device import DeviceScene, ortho_view, perspective_view
from overfly.scenes.kernels import CHUNK, EMPTY, View, rasterize, unpack
from overfly.scenes.ortho import Ortho, rasterize_ortho
from overfly.scenes.scene import Scene
from overfly.scenes.shading import Light, point_colors, shade

MAX_SHADOW_CELLS = 3000


@dataclass(frozen=True)
class Rendered:
    """What a camera sees: ``image`` uint8 [H, W, 3] RGB and ``depth`` float32 [H, W], metres, 0 where nothing is."""

    image: NDArray[np.uint8]
    depth: NDArray[np.float32]


class Renderer:
    """Photographs one scene from any number of cameras.

    Args:
        scene: what is seen.
        device: "cpu", or "cuda" where warp finds a GPU.
    """

    def __init__(self, scene: Scene, *, device: str = "cpu") -> None:
        self.scene = scene
        self.device = device
        self._on_device = DeviceScene(scene, device)
        self._keys: dict[tuple[int, int], wp.array] = {}
        self._shadows: dict[tuple[float, float], tuple[Ortho, wp.array, float]] = {}
        self._none = wp.zeros((0, 0), dtype=wp.vec2d, device=device)
        self._dark = wp.zeros((1, 1), dtype=wp.float32, device=device)
        self._still = wp.zeros((0, 0, 0), dtype=wp.float32, device=device)

    def render(
        self,
        camera: Camera,
        world_from_camera: ArrayLike,
        *,
        supersample: int = 2,
        appearance: Appearance | None = None,
        rng: np.random.Generator | None = None,
    ) -> Rendered:
        """An image and the depth of its pixel centres; the lens's distortion is in both.

        Args:
            camera: size and lens; depth is exact at its own (distorted) pixel centres.
            world_from_camera: [4, 4], OpenCV axes.
            supersample: rays per pixel and side, 1 to 8.
            appearance: light and sensor; None is a clear noon.
            rng: for the sensor's noise; needed where ``appearance.noise_std`` is above 0.

        Raises:
            InputError: a pose that is no rigid transform, a bad supersample, noise without rng.
        """
        appearance = appearance or Appearance()
        if not 1 <= supersample <= 8:
            raise InputError(f"supersample is {supersample}: give 1 to 8 rays per pixel and side.")
        if appearance.noise_std > 0 and rng is None:
            raise InputError("noise_std is above 0 but no rng was given: pass rng=np.random.default_rng(seed).")
        height, width = camera.height, camera.width
        fine = camera.resized(width * supersample, height * supersample)
        view, table, keys = self._visible(fine, world_from_camera)
        grain = self._still
        if appearance.noise_std > 0 and rng is not None:
            grain = wp.array(rng.standard_normal((height, width, 3), dtype=np.float32), device=self.device)
        light, shadow = self._light(appearance)
        image = wp.empty((height, width, 3), dtype=wp.uint8, device=self.device)
        arguments = [keys, view, table, self._on_device.surface, light, shadow, supersample, grain, image]
        wp.launch(shade, dim=(height, width), inputs=arguments, device=self.device)
        if supersample % 2:  # the middle ray is the pixel's centre
            depth = self._unpack(keys, supersample, supersample // 2, height, width)
        else:
            depth = self.depth(camera, world_from_camera)
        return Rendered(image.numpy(), depth)

    def depth(self, camera: Camera, world_from_camera: ArrayLike) -> NDArray[np.float32]:
        """Depth [H, W] at the pixel centres, metres along the camera's axis; 0 where nothing is."""
        _, _, keys = self._visible(camera, world_from_camera)
        return self._unpack(keys, 1, 0, camera.height, camera.width)

    def height_map(
        self, x_min: float, y_min: float, x_max: float, y_max: float, resolution_m: float
    ) -> NDArray[np.float32]:
        """Height [rows, cols] of the top surface at the cells' centres; row 0 is the north, NaN where nothing is."""
        _check_window(x_min, y_min, x_max, y_max)
        if not resolution_m > 0:
            raise InputError(f"The resolution is {resolution_m} m: give more than 0.")
        cols = max(1, int(np.ceil((x_max - x_min) / resolution_m - 1e-6)))
        rows = max(1, int(np.ceil((y_max - y_min) / resolution_m - 1e-6)))
        if rows * cols > 2e8:
            raise InputError(f"A height map of {rows} x {cols} cells is too large: give a coarser resolution.")
        bottom = y_max - rows * resolution_m
        heights = self._heights(x_min, bottom, resolution_m, resolution_m, rows, cols, self._none)
        return heights[::-1].copy()

    def surface(
        self, n: int, rng: np.random.Generator, bounds: tuple[float, float, float, float] | None = None
    ) -> NDArray[np.float64]:
        """``n`` points [n, 3] on the surface that is visible from above, uniform in x and y.

        Points are drawn one to a cell of a jittered grid, so they are more even than independent ones.

        Args:
            n: how many.
            rng: source of the randomness.
            bounds: x_min, y_min, x_max, y_max in metres; None is the scene's extent.
        """
        x_min, y_min, x_max, y_max = bounds or self.scene.extent
        _check_window(x_min, y_min, x_max, y_max)
        width, depth = x_max - x_min, y_max - y_min
        cols = max(1, int(np.ceil(np.sqrt(n * width / depth))))
        rows = max(1, int(np.ceil(n / cols)))
        found: list[NDArray[np.float64]] = []
        for _ in range(20):
            jitter = rng.random((rows, cols, 2))
            on_device = wp.array(jitter, dtype=wp.vec2d, device=self.device)
            z = self._heights(x_min, y_min, width / cols, depth / rows, rows, cols, on_device)
            col, row = np.meshgrid(np.arange(cols), np.arange(rows))
            x = x_min + (col + jitter[..., 0]) * width / cols
            y = y_min + (row + jitter[..., 1]) * depth / rows
            points = np.stack([x, y, z], -1)[np.isfinite(z)]
            found.append(rng.permutation(points))
            if sum(map(len, found)) >= n:
                return np.concatenate(found)[:n]
        raise InputError(f"The scene {self.scene.name} has (almost) no surface within {x_min, y_min, x_max, y_max}.")

    def _visible(self, camera: Camera, world_from_camera: ArrayLike) -> tuple[View, wp.array, wp.array]:
        pose = np.asarray(world_from_camera, float)
        if pose.shape != (4, 4) or not np.isfinite(pose).all() or not is_rotation(pose[:3, :3]):
            raise InputError("A camera's pose must be a finite [4, 4] matrix with a rotation (world_from_camera).")
        view, table, chunks = perspective_view(self._on_device, camera, pose)
        keys = self._fresh_keys(camera.height, camera.width)
        surface = self._on_device.surface
        if len(chunks):
            inputs = [chunks, self._on_device.count, surface.vertices, surface.faces, view, table, keys]
            wp.launch(rasterize, dim=len(chunks) * CHUNK, inputs=inputs, device=self.device)
        return view, table, keys

    def _heights(
        self, left: float, bottom: float, cell_x: float, cell_y: float, rows: int, cols: int, jitter: wp.array
    ) -> NDArray[np.float32]:
        """Top heights [rows, cols], row 0 in the south."""
        axes = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, -1]])
        view, chunks = ortho_view(self._on_device, axes, left, bottom, (cell_x, cell_y), rows, cols)
        depth = self._ortho_depth(view, chunks, jitter).numpy().astype(np.float64)
        return np.where(depth > 0, -(depth + view.offset), np.nan).astype(np.float32)

    def _ortho_depth(self, view: Ortho, chunks: wp.array, jitter: wp.array) -> wp.array:
        keys = wp.full((view.height, view.width), EMPTY, dtype=wp.int64, device=self.device)
        surface = self._on_device.surface
        if len(chunks):
            inputs = [chunks, self._on_device.count, surface.vertices, surface.faces, view, jitter, keys]
            wp.launch(rasterize_ortho, dim=len(chunks) * CHUNK, inputs=inputs, device=self.device)
        depth = wp.empty((view.height, view.width), dtype=wp.float32, device=self.device)
        wp.launch(unpack, dim=(view.height, view.width), inputs=[keys, 1, 0, depth], device=self.device)
        return depth

    def _unpack(self, keys: wp.array, step: int, first: int, height: int, width: int) -> NDArray[np.float32]:
        depth = wp.empty((height, width), dtype=wp.float32, device=self.device)
        wp.launch(unpack, dim=(height, width), inputs=[keys, step, first, depth], device=self.device)
        return depth.numpy()

    def _fresh_keys(self, height: int, width: int) -> wp.array:
        if (height, width) not in self._keys:
            if len(self._keys) > 3:
                self._keys.clear()
            self._keys[height, width] = wp.empty((height, width), dtype=wp.int64, device=self.device)
        keys = self._keys[height, width]
        keys.fill_(EMPTY)
        return keys

    def _light(self, appearance: Appearance) -> tuple[Light, wp.array]:
        light = Light()
        sun = appearance.sun_direction()
        light.sun = wp.vec3(*sun)
        light.sun_strength = appearance.sun
        light.sky_strength = appearance.sky
        light.haze = float(-np.log(1.0 - appearance.haze)) / 1000.0
        light.exposure = appearance.exposure
        light.gain = wp.vec3(*appearance.gain)
        light.vignetting = appearance.vignetting
        light.noise = appearance.noise_std
        light.shadows = int(appearance.shadows)
        if not appearance.shadows:
            return light, self._dark
        key = (appearance.sun_azimuth_deg, appearance.sun_elevation_deg)
        if key not in self._shadows:
            if len(self._shadows) > 3:
                self._shadows.clear()
            self._shadows[key] = self._shadow(sun)
        light.view, shadow, light.bias = self._shadows[key]
        return light, shadow

    def _shadow(self, sun: NDArray[np.float64]) -> tuple[Ortho, wp.array, float]:
        """The sun's depth map over the scene's extent."""
        right = np.cross([0.0, 0.0, 1.0], sun)
        right = right / np.linalg.norm(right) if np.linalg.norm(right) > 1e-9 else np.array([1.0, 0, 0])
        axes = np.stack([right, np.cross(sun, right), -sun])
        low, high = self.scene.bounds
        corners = np.array(np.meshgrid(*zip(low, high))).reshape(3, -1).T @ axes[:2].T
        lower, upper = corners.min(0), corners.max(0)
        cell = max(0.3, float((upper - lower).max()) / MAX_SHADOW_CELLS)
        cols, rows = (int(v) for v in np.ceil((upper - lower) / cell) + 1)
        view, chunks = ortho_view(self._on_device, axes, lower[0], lower[1], (cell, cell), rows, cols)
        return view, self._ortho_depth(view, chunks, self._none), 1.5 * cell


def surface_colors(scene: Scene, faces: NDArray[np.int32], weights: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Unlit colours [n, 3] of points given by face [n] and barycentrics of its second and third vertex [n, 2]."""
    on_device = DeviceScene(scene, "cpu")
    place = np.argsort(on_device.order)[faces]
    out = wp.empty((len(faces), 3), dtype=wp.uint8, device="cpu")
    inputs = [wp.array(place, dtype=wp.int32, device="cpu"), wp.array(weights, dtype=wp.vec2, device="cpu")]
    inputs += [on_device.surface, out]
    wp.launch(point_colors, dim=len(faces), inputs=inputs, device="cpu")
    return out.numpy()


def _check_window(x_min: float, y_min: float, x_max: float, y_max: float) -> None:
    if not (np.isfinite([x_min, y_min, x_max, y_max]).all() and x_max > x_min and y_max > y_min):
        raise InputError(
            f"The window {x_min, y_min, x_max, y_max} is empty: give x_min, y_min, x_max, y_max with min below max."
        )
