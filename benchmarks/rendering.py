"""Two renderers, each beside others on the same scene in one run: milliseconds, ratios, agreement.

The z-buffer that draws flights beside Embree's rays, and the differentiable renderer beside plain torch and DEODR.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from overfly.geometry import Camera, look_at, pixel_grid, rays
from overfly.rendering import Views, reference, render, topology
from overfly.scenes import Renderer, make_scene

SIZE = 512


def fastest(run: Callable[[], Any], repeats: int = 5) -> tuple[float, Any]:
    best, result = np.inf, None
    for _ in range(repeats):
        start = time.perf_counter()
        result = run()
        best = min(best, time.perf_counter() - start)
    return best, result


def flight_renderer() -> None:
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


class Hills:
    """n x n vertices over steep hills that hide each other, seen obliquely, and an image of lower hills as target."""

    def __init__(self, n: int, size: int) -> None:
        x, y = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n))
        z = 0.15 * np.tanh(4 * np.sin(14 * x + 1) * np.sin(14 * y)) + 0.02 * np.sin(40 * x * y)
        corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
        a, b, c, d = corner, corner + 1, corner + n, corner + n + 1
        self.faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
        self.vertices = np.stack([x, y, z], -1).reshape(-1, 3)
        self.colors = 0.5 + 0.4 * np.sin(self.vertices @ [[7, 3, 1], [2, 5, 8], [9, 1, 4]])
        self.pose = np.linalg.inv(look_at([0.3, -1.5, 1.4], [0, 0, 0]))
        self.k = np.array([[1.3 * size, 0, size / 2], [0, 1.3 * size, size / 2], [0, 0, 1]])
        self.size = size
        self.topology = topology(self.faces, len(self.vertices))
        self.target = self.draw(render, torch.tensor(self.vertices * [1, 1, 0.8]), torch.tensor(self.colors)).numpy()

    def draw(self, way: Callable[..., Any], vertices: torch.Tensor, colors: torch.Tensor) -> torch.Tensor:
        views = Views(torch.tensor(self.k)[None], torch.tensor(self.pose)[None], (self.size, self.size))
        return way(vertices, colors, self.topology, views, background=torch.zeros(3)).image[0]

    def step(self, way: Callable[..., Any], dtype: torch.dtype) -> tuple[np.ndarray, np.ndarray]:
        """Image and gradient of the vertices, by ``render`` or its reference."""
        leaves = [torch.tensor(x, dtype=dtype, requires_grad=True) for x in (self.vertices, self.colors)]
        image = self.draw(way, *leaves)
        (image - torch.tensor(self.target, dtype=dtype)).square().mean().backward()
        assert leaves[0].grad is not None
        return image.detach().numpy(), leaves[0].grad.numpy()

    def deodr_step(self) -> tuple[np.ndarray, np.ndarray]:
        """The same by DEODR (linear on the screen), in camera axes: its gradient ignores how the camera is turned."""
        from deodr import Camera as Pinhole
        from deodr import ColoredTriMesh, Scene3D

        if not hasattr(self, "scene"):
            self.scene = Scene3D(integer_pixel_centers=False)
            self.scene.set_light(None, 1.0)
            self.scene.set_background_color([0.0, 0, 0])
            mesh = ColoredTriMesh(self.faces.astype(np.uint32), self.vertices, colors=self.colors, nb_colors=3)
            self.scene.set_mesh(mesh)
        self.scene.mesh.set_vertices(self.vertices @ self.pose[:3, :3].T + self.pose[:3, 3])
        image = self.scene.render(Pinhole(np.eye(3, 4), self.k, self.size, self.size))
        self.scene.clear_gradients()
        self.scene.render_backward(2 * (image - self.target.transpose(1, 2, 0)) / image.size)
        return image.transpose(2, 0, 1), self.scene.mesh._vertices_b @ self.pose[:3, :3]


def cpu_ms(run: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    """The least milliseconds of one core over several runs, after one that compiles: other work does not count."""
    result, best = run(), np.inf
    for _ in range(repeats):
        start = time.process_time()
        result = run()
        best = min(best, time.process_time() - start)
    return 1e3 * best, result


def differentiable_renderer() -> None:
    """Forward and backward of the mean square difference to an image, to vertices and colours, on one core."""
    torch.set_num_threads(1)
    print("image loss, gradients to vertices and colours, one core")
    for n, size in ((101, 256), (225, 512)):
        case = Hills(n, size)
        ours, (image, gradient) = cpu_ms(lambda case=case: case.step(render, torch.float32), 10)
        print(f"{len(case.faces)} faces, {size} x {size} pixels")
        print(f"  ours                {ours:7.1f} ms")
        others = {"plain torch": (lambda case=case: case.step(reference.render, torch.float64), 2)}
        if find_spec("deodr"):
            others["DEODR"] = (case.deodr_step, 5)
        for name, (step, repeats) in others.items():
            taken, (image_other, gradient_other) = cpu_ms(step, repeats)
            likeness = (gradient * gradient_other).sum() / np.linalg.norm(gradient) / np.linalg.norm(gradient_other)
            print(
                f"  {name:18}  {taken:7.1f} ms, {taken / ours:.2f} times ours; its image differs by "
                f"{np.abs(image - image_other).mean():.1e}, its vertices' gradient has the cosine {likeness:.4f}"
            )
    if not find_spec("deodr"):
        print("DEODR is not installed: `.venv/bin/pip install deodr` lets it run beside ours.")


def main() -> None:
    flight_renderer()
    print()
    differentiable_renderer()


if __name__ == "__main__":
    main()
