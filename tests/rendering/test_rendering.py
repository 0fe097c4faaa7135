"""What the renderer shows: held against plain torch and against what is known."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from meshes import looking_along_z, make_solid, make_views
from torch import Tensor

from overfly.errors import InputError
from overfly.rendering import Rendered, Views, reference, render, topology
from overfly.rendering.operations import antialias, interpolate, rasterise
from overfly.rendering.render import project


def everything(draw, dtype: torch.dtype, kind: str, seed: int = 0) -> dict[str, Tensor]:
    """All outputs of a way to render, and the gradients of a loss in which all of them take part."""
    solid, views = make_solid(kind, seed), make_views(2)
    rng = torch.Generator().manual_seed(seed)
    inputs = {
        "vertices": solid.vertices,
        "colors": solid.colors,
        "k": views.intrinsics,
        "pose": views.camera_from_world,
    }
    leaf = {name: value.to(dtype, copy=True).requires_grad_() for name, value in inputs.items()}
    background = torch.tensor([0.1, 0.5, 0.3], dtype=dtype, requires_grad=True)
    views = Views(leaf["k"], leaf["pose"], views.size)
    further = torch.cat([leaf["vertices"], leaf["colors"]], 1)
    r = draw(leaf["vertices"], leaf["colors"], solid.topology, views, background=background, attributes=further)
    loss = torch.zeros((), dtype=dtype)
    for out in (r.image, r.coverage, r.depth, r.attributes):
        loss = loss + ((out - 0.5).square() * torch.rand(out.shape, generator=rng, dtype=torch.float64).to(dtype)).sum()
    loss.backward()
    found = {**r._asdict(), **{f"to {name}": x.grad for name, x in leaf.items()}, "to background": background.grad}
    return {name: value.detach().double() for name, value in found.items()}


@pytest.mark.parametrize("kind", ["sphere", "box"])
def test_kernels_equal_plain_torch_in_float64(kind: str) -> None:
    ours, plain = everything(render, torch.float32, kind), everything(reference.render, torch.float64, kind)
    assert (ours["face"] >= 0).double().mean() > 0.5
    assert (ours["coverage"] % 1 > 0).sum() > 10
    for name, value in plain.items():
        error = (ours[name] - value).abs().max() / value.abs().max()
        assert error < 1e-5, f"{name}: {error:.1e}"


def test_views_in_one_batch_equal_single_views() -> None:
    solid, views = make_solid("box"), make_views(3)
    together = render(solid.vertices, solid.colors, solid.topology, views, background=torch.ones(3))
    for i in range(3):
        one = Views(views.intrinsics[i : i + 1], views.camera_from_world[i : i + 1], views.size)
        alone = render(solid.vertices, solid.colors, solid.topology, one, background=torch.ones(3))
        for a, b in zip(together[:4], alone[:4]):
            assert torch.equal(a[i], b[0])


def make_grid(n: int, rng: np.random.Generator) -> tuple[Tensor, np.ndarray]:
    """Vertices of an irregular grid that covers the view of ``looking_along_z``, and its faces."""
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, n), np.linspace(-0.6, 0.6, n))
    plane = np.stack([x, y], -1).reshape(-1, 2) + rng.normal(0, 0.02, (n * n, 2))
    z = rng.uniform(1, 1.5, (n * n, 1))
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    a, b, c, d = corner, corner + 1, corner + n, corner + n + 1
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, c, d], 1)])  # of mixed winding
    return torch.tensor(np.concatenate([plane * z, z], 1), dtype=torch.float32), faces


@pytest.mark.parametrize("aligned", [False, True])
def test_shared_edges_are_watertight(aligned: bool) -> None:
    vertices, faces = make_grid(9, np.random.default_rng(1))
    views = looking_along_z()
    if aligned:  # vertices and edges right on the centres of pixels
        x, y = np.meshgrid(np.arange(9) * 2 - 8 + 0.5, np.arange(9) * 2 - 8 + 0.5)
        vertices = torch.tensor(np.stack([x, y, np.full_like(x, 16)], -1).reshape(-1, 3), dtype=torch.float32)
    _, screen, _ = project(vertices, views)
    face = torch.from_numpy(faces).int()
    count = sum((rasterise(screen, face[i : i + 1], views.size) >= 0).int() for i in range(len(face)))
    assert isinstance(count, Tensor)
    within = count[0, :15, :15] if aligned else count  # on the lower and right end of the grid belong to no face
    assert (within == 1).all()


def test_interpolation_is_perspective_correct() -> None:
    slanted = torch.tensor([[-9.0, -9, 2], [9, -9, 2], [9, 9, 20], [-9, 9, 20]])
    shape = topology(np.array([[0, 1, 2], [0, 2, 3]]), 4)
    views = looking_along_z()
    seen = render(slanted, slanted[:, :1], shape, views, attributes=slanted)
    x, y = torch.meshgrid((torch.arange(16) + 0.5 - 8) / 16, (torch.arange(16) + 0.5 - 8) / 16, indexing="xy")
    z = 11 / (1 - y)  # the plane is z = 11 + y
    hit = seen.face[0] >= 0
    assert hit.float().mean() > 0.9
    assert torch.allclose(seen.depth[0][hit], z[hit], rtol=1e-6)
    assert seen.attributes is not None
    assert torch.allclose(seen.attributes[0, :, hit], torch.stack([x * z, y * z, z])[:, hit], atol=1e-5)


def test_the_nearer_face_hides_the_farther_whatever_their_order() -> None:
    square = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    vertices = torch.cat([square * 4 + torch.tensor([0, 0, 4.0]), square * 0.5 + torch.tensor([0, 0, 2.0])])
    colors = torch.tensor([[0.0]] * 4 + [[1.0]] * 4)
    near, far = [[4, 5, 6], [4, 6, 7]], [[0, 1, 2], [0, 2, 3]]
    for faces in (near + far, far + near):
        seen = render(vertices, colors, topology(np.array(faces), 8), looking_along_z())
        assert torch.equal(seen.depth[0] == 2, seen.image[0, 0] == 1)
        assert (seen.depth[0, 4:12, 4:12] == 2).all()
        assert (seen.depth == 2).sum() == 64
        assert (seen.coverage == 1).all()


def test_coverage_is_the_share_of_the_pixel_that_a_square_covers() -> None:
    square = torch.tensor([[-4.3, -3, 16], [4.1, -3, 16], [4.1, 3, 16], [-4.3, 3, 16]], dtype=torch.float64)
    seen = render(square, square[:, :1] * 0 + 1, topology(np.array([[0, 1, 2], [0, 2, 3]]), 4), looking_along_z())
    row = seen.coverage[0, 8]
    assert torch.allclose(row[2:14], torch.tensor([0, 0.3, *[1.0] * 8, 0.1, 0]), atol=1e-6)
    assert float(seen.coverage.sum()) == pytest.approx(8.4 * 6, rel=1e-6)
    assert torch.equal(seen.image[:, 0], seen.coverage)


def test_backgrounds_show_where_the_mesh_does_not() -> None:
    solid, views = make_solid("box"), make_views(2)
    pictures = torch.rand(2, 3, 40, 48)
    box = topology(solid.topology.faces[:-2], len(solid.vertices))
    black, flat, given = (
        render(solid.vertices, solid.colors, box, views, background=b) for b in (None, torch.ones(3), pictures)
    )
    empty = black.coverage[:, None]
    assert 0.05 < empty.mean() < 0.5
    assert torch.allclose(flat.image, black.image + 1 - empty)
    assert torch.allclose(given.image, black.image + (1 - empty) * pictures)


@pytest.mark.parametrize("channels", [1, 2, 4, 7])
def test_any_number_of_channels(channels: int) -> None:
    solid, views = make_solid("sphere"), make_views(1)
    attributes = torch.rand(len(solid.vertices), channels)
    points, screen, rays = project(solid.vertices, views)
    face = rasterise(screen, solid.topology.faces, views.size)
    values, depth = interpolate(points, attributes, solid.topology.faces, face, rays)
    soft = antialias(values, screen, solid.topology, face, depth)
    assert soft.shape == values.shape == (1, 40, 48, channels)
    for c in range(channels):
        single, _ = interpolate(points, attributes[:, c : c + 1], solid.topology.faces, face, rays)
        assert torch.equal(single[..., 0], values[..., c])
        assert torch.equal(antialias(single, screen, solid.topology, face, depth)[..., 0], soft[..., c])


def test_faces_behind_or_too_near_are_dropped() -> None:
    vertices = torch.tensor(
        [[-1.0, -1, 2], [1, -1, 2], [0, 1, 2], [-1, -1, -2], [1, -1, -2], [0, 1, -2], [0, 0, 0.005]], requires_grad=True
    )
    shape = topology(np.array([[3, 4, 5], [0, 1, 2], [0, 1, 3], [1, 2, 6]]), 7)
    seen = render(vertices, torch.ones(7, 3), shape, looking_along_z())
    assert set(seen.face.unique().tolist()) == {-1, 1}
    assert (seen.depth == 2).any()
    backward(seen)
    assert vertices.grad is not None
    assert vertices.grad.isfinite().all()
    assert vertices.grad[:3].abs().sum() > 0
    assert (vertices.grad[3:] == 0).all()


def backward(seen: Rendered) -> None:
    rng = torch.Generator().manual_seed(1)
    parts = [(x * torch.rand(x.shape, generator=rng)).sum() for x in (seen.image, seen.coverage, seen.depth)]
    torch.stack(parts).sum().backward()


def test_degenerate_and_absent_faces_give_no_nan() -> None:
    base = [[-1.0, -1, 2], [1, -1, 2], [1, 1, 2], [-1, 1, 2]]
    odd = [[0.0, 0, 2], [0, 0, 2], [0.5, 0.5, 2], [0, 0, 1], [0, 0, 3], [0, 1, 2]]  # points, lines, faces seen edge-on
    vertices = torch.tensor(base + odd, requires_grad=True)
    colors = torch.rand(10, 3, requires_grad=True)
    faces = [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 4, 6], [4, 6, 2], [7, 8, 9]]
    seen = render(vertices, colors, topology(np.array(faces), 10), looking_along_z())
    assert set(seen.face.unique().tolist()) <= {-1, 0, 1}
    backward(seen)
    assert vertices.grad is not None
    assert colors.grad is not None
    assert vertices.grad.isfinite().all()
    assert colors.grad.isfinite().all()
    for shape, n in ((topology(np.zeros((0, 3), int), 10), 10), (topology(np.zeros((0, 3), int), 0), 0)):
        vertices, colors = torch.rand(n, 3, requires_grad=True), torch.rand(n, 3, requires_grad=True)
        nothing = render(vertices, colors, shape, looking_along_z(), background=torch.tensor([0.1, 0.2, 0.3]))
        assert (nothing.face == -1).all()
        assert (nothing.image[0, 2] == 0.3).all()
        backward(nothing)
    away = Views(torch.eye(3)[None], torch.diag(torch.tensor([1.0, -1, -1, 1]))[None], (8, 8))
    whole = make_solid("box")
    vertices = (whole.vertices + 5).requires_grad_()
    unseen = render(vertices, whole.colors, whole.topology, away)
    backward(unseen)
    assert (unseen.coverage == 0).all()
    assert vertices.grad is not None
    assert (vertices.grad == 0).all()


def test_silhouettes_of_a_fine_mesh_are_soft_all_around() -> None:
    """Near the outline of a fine sphere many faces lie within a pixel: the walk has to cross all of them."""
    mesh = trimesh.creation.icosphere(5)  # 20 480 faces, some 0.6 of a pixel long
    shape = topology(mesh.faces, len(mesh.vertices))
    vertices = torch.tensor(mesh.vertices + np.array([0, 0, 4]), dtype=torch.float32)
    seen = render(vertices, torch.ones(len(vertices), 1), shape, looking_along_z((64, 64), 64.0))
    radius = 64 / 15**0.5  # of the outline, pixels
    assert float(seen.coverage.sum()) == pytest.approx(np.pi * radius**2, rel=2e-3)
    assert float((seen.face >= 0).sum()) == pytest.approx(np.pi * radius**2, rel=2e-2)
    y, x = np.mgrid[:64, :64] + 0.5 - 32
    inside = torch.from_numpy(np.hypot(x, y) < radius - 1.5)
    assert (seen.coverage[0][inside] == 1).all()  # no seams
    outline = torch.from_numpy(np.abs(np.hypot(x, y) - radius) < 0.25)
    soft = (seen.coverage[0] > 0) & (seen.coverage[0] < 1)
    assert soft[outline].float().mean() > 0.97


def test_wrong_shapes_are_refused_with_an_instruction() -> None:
    solid, views = make_solid("box"), make_views(2)
    v, c, t = solid
    cases = [
        (v[1:], c, views, None, "Vertices"),
        (v, c.repeat(1, 2), views, None, "Colours"),
        (v, c, views._replace(camera_from_world=views.camera_from_world[:, :3]), None, "Views"),
        (v, c, views._replace(size=(0, 4)), None, "image size"),
        (v, c, views, torch.rand(4, 4), "background"),
    ]
    for vertices, colors, cameras, background, message in cases:
        with pytest.raises(InputError, match=message):
            render(vertices, colors, t, cameras, background=background)
    with pytest.raises(InputError, match="Attributes"):
        render(v, c, t, views, attributes=torch.rand(3, 2))
