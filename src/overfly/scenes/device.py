"""A scene on a warp device, cut into chunks of near triangles, and the views in which it is rasterised."""

from __future__ import annotations

import os
import sys
from functools import cache, lru_cache

import numpy as np
import warp as wp
from numpy.typing import NDArray

from overfly.errors import InputError
from overfly.geometry import Camera, distort, undistort
from overfly.scenes.ground import GroundData
from overfly.scenes.kernels import CHUNK, View
from overfly.scenes.ortho import Ortho
from overfly.scenes.scene import Scene
from overfly.scenes.shading import Surface

NEAR = 0.05
"""Nothing nearer than this (metres) is seen."""


@cache
def start() -> None:
    """Start warp once, without its note on stderr that there is no GPU, which comes from below Python."""
    sys.stderr.flush()
    held = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        wp.init()
    finally:
        os.dup2(held, 2)
        os.close(held)
        os.close(nowhere)


class DeviceScene:
    """The arrays of a scene, with the faces sorted into chunks that lie together.

    Attributes:
        surface: the kernels' view of the scene.
        count: number of faces.
        low, high: [chunks, 3] bounding boxes.
    """

    def __init__(self, scene: Scene, device: str) -> None:
        start()
        if device != "cpu" and not wp.is_cuda_available():
            raise InputError(f"The scene cannot be rendered on {device!r}: warp finds no GPU here, use 'cpu'.")
        self.device = device
        order = _morton_order(scene)
        faces = scene.faces[order]
        self.count = len(faces)
        corners = scene.vertices[faces].reshape(-1, 9)
        starts = np.arange(0, len(faces), CHUNK)
        self.low = np.minimum.reduceat(corners, starts).reshape(-1, 3, 3).min(1)
        self.high = np.maximum.reduceat(corners, starts).reshape(-1, 3, 3).max(1)
        self.order = order
        self.surface = self._upload(scene, faces, order)

    def _upload(self, scene: Scene, faces: NDArray, order: NDArray) -> Surface:
        # Vertices in the order of the faces that use them: what a pixel needs lies together in memory.
        used, first = np.unique(faces, return_index=True)
        used = used[np.argsort(first)]
        place = np.zeros(len(scene.vertices), np.int32)
        place[used] = np.arange(len(used))
        faces = place[faces]

        def put(array: NDArray, dtype: type) -> wp.array:
            return wp.array(np.ascontiguousarray(array), dtype=dtype, device=self.device)

        s = Surface()
        s.vertices = put(scene.vertices[used].astype(np.float32), wp.vec3)
        s.faces = put(faces, wp.vec3i)
        s.normals = put(scene.normals[used], wp.vec3)
        s.material = put(scene.material[order], wp.int32)
        s.paint = put(scene.paint[order], wp.vec4)
        s.shape = put(scene.shape[order], wp.vec4)
        colors = np.zeros((1, 3)) if scene.colors is None else _linear(scene.colors[used])
        s.colors = put(colors.astype(np.float32), wp.vec3)
        s.uv = put(np.zeros((1, 2), np.float32) if scene.uv is None else scene.uv[used].astype(np.float32), wp.vec2)
        texels, levels = _pyramid(np.zeros((1, 1, 3), np.uint8) if scene.texture is None else scene.texture)
        s.texels, s.levels = put(texels, wp.uint8), put(levels, wp.vec3i)
        g = GroundData()
        cover = scene.cover
        kind = np.zeros((2, 2), np.uint8) if cover is None else cover.kind
        g.kind = put(kind, wp.uint8)
        g.road = put(np.zeros((1, 1, 4), np.float32) if cover is None else cover.road, wp.vec4)
        if cover is not None:
            turn = np.radians(cover.heading_deg)
            g.x_min, g.y_min, g.size = cover.x_min, cover.y_min, cover.size_m
            g.turn = wp.vec2(float(np.cos(turn)), float(np.sin(turn)))
            g.pavement, g.marked, g.wild = cover.pavement, int(cover.marked), cover.wild
        else:
            g.size, g.turn = 1.0, wp.vec2(1.0, 0.0)
        s.ground = g
        s.seed = scene.seed * 7919 % 1000003
        return s


def _morton_order(scene: Scene) -> NDArray[np.int64]:
    """Order of the faces along a Z curve over x and y, so that each chunk is compact."""
    middle = scene.vertices[scene.faces].mean(1)[:, :2]
    low, high = middle.min(0), middle.max(0)
    cells = ((middle - low) / max(float((high - low).max()), 1e-9) * 65535).astype(np.uint64)
    code = np.zeros(len(cells), np.uint64)
    for axis in range(2):
        v = cells[:, axis]
        for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
            v = (v | (v << np.uint64(shift))) & np.uint64(mask)
        code |= v << np.uint64(axis)
    return np.argsort(code, kind="stable")


def _linear(colors: NDArray[np.uint8]) -> NDArray[np.float64]:
    v = colors.astype(float) / 255
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


def _pyramid(texture: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
    """All levels of an image as one list of texels [T, 3], and first texel, width, height of each [L, 3]."""
    level, parts, table, first = texture.astype(np.float32), [], [], 0
    while True:
        rows, cols = level.shape[:2]
        parts.append(np.clip(level + 0.5, 0, 255).astype(np.uint8).reshape(-1, 3))
        table.append((first, cols, rows))
        first += rows * cols
        if min(rows, cols) < 2:
            return np.concatenate(parts), np.array(table, np.int32)
        even = level[: rows // 2 * 2, : cols // 2 * 2]
        level = 0.25 * (even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2])


@lru_cache(maxsize=4)
def _lens_table(camera: Camera) -> tuple[NDArray, NDArray, NDArray, float, float]:
    """Ideal coordinates of every pixel [H, W, 2], their box, and bounds of the lens's bend and shift."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    target = np.stack(np.meshgrid(x, y), -1)
    with np.errstate(over="ignore", invalid="ignore"):  # a lens that folds the image diverges, and is refused
        ideal = undistort(target, camera, iterations=60)
        error = np.abs(distort(ideal, camera) - target).max() * max(camera.fx, camera.fy)
    if not error < 0.01:
        raise InputError(
            f"The lens distortion k1={camera.k1}, k2={camera.k2}, k3={camera.k3}, p1={camera.p1}, p2={camera.p2} "
            "cannot be inverted over the whole image: check the coefficients (OpenCV's model, focal length in pixels)."
        )
    low, high = ideal.reshape(-1, 2).min(0), ideal.reshape(-1, 2).max(0)
    margin = 0.05 * (high - low)
    low, high = low - margin, high + margin
    grid = np.stack(np.meshgrid(*(np.linspace(low[i], high[i], 41) for i in range(2))), -1)
    step = (high - low) / 40
    moved = distort(grid, camera)
    bend = 0.0
    for axis, h in ((1, step[0]), (0, step[1])):
        bend = max(bend, float(np.abs(np.diff(moved, 2, axis=axis)).max() / h**2))
    mixed = np.diff(np.diff(moved, axis=0), axis=1)
    bend = 1.2 * (bend + float(np.abs(mixed).max() / (step[0] * step[1])))
    shift = 1.1 * float(np.abs(moved - grid).max())
    return ideal, low, high, bend, shift


def perspective_view(scene: DeviceScene, camera: Camera, pose: NDArray[np.float64]) -> tuple[View, wp.array, wp.array]:
    """The kernels' camera, its ray table (empty for a pinhole) and the chunks in its frustum."""
    view = View()
    rotation = pose[:3, :3].T
    view.camera_from_world = wp.mat33d(*rotation.ravel())
    view.eye = wp.vec3d(*pose[:3, 3])
    view.focal, view.centre = wp.vec2d(camera.fx, camera.fy), wp.vec2d(camera.cx, camera.cy)
    view.width, view.height, view.near = camera.width, camera.height, NEAR
    if camera.is_distorted:
        ideal, low, high, view.bend, view.shift = _lens_table(camera)
        view.distorted = 1
        view.radial = wp.vec3d(camera.k1, camera.k2, camera.k3)
        view.tangential = wp.vec2d(camera.p1, camera.p2)
        table = wp.array(ideal, dtype=wp.vec2d, device=scene.device)
    else:
        low = np.array([-camera.cx / camera.fx, -camera.cy / camera.fy])
        high = np.array([(camera.width - camera.cx) / camera.fx, (camera.height - camera.cy) / camera.fy])
        table = wp.zeros((0, 0), dtype=wp.vec2d, device=scene.device)
    view.low, view.high = wp.vec2d(*low), wp.vec2d(*high)
    planes = np.array([[0, 0, 1.0], [1, 0, -low[0]], [-1, 0, high[0]], [0, 1, -low[1]], [0, -1, high[1]]]) @ rotation
    offsets = -planes @ pose[:3, 3]
    # The corner of a box that lies furthest along each plane's normal decides.
    reach = np.maximum(scene.low[:, None] * planes, scene.high[:, None] * planes).sum(-1) + offsets
    return view, table, _chunk_list(scene, (reach >= 0).all(1))


def ortho_view(
    scene: DeviceScene,
    axes: NDArray[np.float64],
    left: float,
    bottom: float,
    cell: tuple[float, float],
    rows: int,
    cols: int,
) -> tuple[Ortho, wp.array]:
    """A parallel view along ``axes`` (right, up, away; [3, 3]) and the chunks that it can see."""
    view = Ortho()
    view.right, view.up, view.away = (wp.vec3d(*axis) for axis in axes)
    view.left, view.bottom, view.cell = left, bottom, wp.vec2d(*cell)
    view.width, view.height = cols, rows
    low = np.minimum(scene.low[:, None] * axes, scene.high[:, None] * axes).sum(-1)
    high = np.maximum(scene.low[:, None] * axes, scene.high[:, None] * axes).sum(-1)
    view.offset = float(low[:, 2].min()) - 1.0
    seen = (high[:, 0] >= left) & (low[:, 0] <= left + cols * cell[0])
    seen &= (high[:, 1] >= bottom) & (low[:, 1] <= bottom + rows * cell[1])
    return view, _chunk_list(scene, seen)


def _chunk_list(scene: DeviceScene, seen: NDArray[np.bool_]) -> wp.array:
    return wp.array(np.flatnonzero(seen).astype(np.int32), dtype=wp.int32, device=scene.device)
