"""The z-buffer beside Embree's rays on one procedural city, in one run: seconds, ratio, agreement."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from overfly.geometry import Camera, look_at, pixel_grid, rays
from overfly.scenes import Renderer, make_scene

SIZE = 512


def fastest(run: Callable[[], Any], repeats: int = 5) -> tuple[float, Any]:
    best, result = np.inf, None
    for _ in range(repeats):
        start = time.perf_counter()
        result = run()
        best = min(best, time.perf_counter() - start)
    return best, result


def main() -> None:
    scene = make_scene("blocks", seed=1, size_m=500)
    camera = Camera.from_fov(SIZE, SIZE, 70)
    pose = look_at([0, -80, 150], [0, 0, 0])
    renderer = Renderer(scene)
    renderer.depth(camera, pose)  # compiles the kernels once
    z_buffer, depth = fastest(lambda: renderer.depth(camera, pose))
    image, _ = fastest(lambda: renderer.render(camera, pose, supersample=1), repeats=3)

    start = time.perf_counter()
    embree = EmbreeScene()
    TriangleMesh(embree, np.ascontiguousarray(scene.vertices[scene.faces], dtype=np.float32))
    directions = (rays(pixel_grid(SIZE, SIZE), camera) @ pose[:3, :3].T).reshape(-1, 3).astype(np.float32)
    origins = np.broadcast_to(pose[:3, 3].astype(np.float32), directions.shape).copy()
    embree.run(origins[:8], directions[:8], output=True)  # builds the tree
    build = time.perf_counter() - start
    traced, hit = fastest(lambda: embree.run(origins, directions, output=True))
    truth = np.where(hit["primID"] >= 0, hit["tfar"], 0).reshape(SIZE, SIZE)

    print(f"{len(scene.faces)} triangles, {SIZE} x {SIZE} pixels")
    print(f"z-buffer depth        {1e3 * z_buffer:7.1f} ms")
    print(f"Embree rays           {1e3 * traced:7.1f} ms (and {1e3 * build:.0f} ms for the tree)")
    print(f"Embree / z-buffer     {traced / z_buffer:7.2f}")
    print(f"shaded image          {1e3 * image:7.1f} ms")
    agree = np.abs(depth - truth) <= 1e-3 * 10
    print(f"pixels within 1 cm    {100 * agree.mean():7.2f} %")


if __name__ == "__main__":
    main()
