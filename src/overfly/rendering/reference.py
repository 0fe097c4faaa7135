"""The renderer once more in plain torch, of any dtype: slow, for tests and comparisons only."""

from __future__ import annotations

import torch
from torch import Tensor

from overfly.rendering.render import NEAR, Rendered, Views
from overfly.rendering.topology import Topology

STEPS = 64
SLACK = 1e-9


def render(
    vertices: Tensor,
    colors: Tensor,
    topology: Topology,
    views: Views,
    *,
    background: Tensor | None = None,
    attributes: Tensor | None = None,
    near: float = NEAR,
    soft: bool = True,
) -> Rendered:
    """As :func:`overfly.rendering.render`, in the dtype of the vertices; ``soft`` False leaves the antialiasing out."""
    pose, k = (matrix.to(vertices.dtype) for matrix in (views.camera_from_world, views.intrinsics))
    points = torch.einsum("bij,vj->bvi", pose[:, :3, :3], vertices) + pose[:, None, :3, 3]
    seen = points[..., 2] >= near
    z = torch.where(seen, points[..., 2], 1)
    column = k[:, 0, 0, None] * points[..., 0] / z + k[:, 0, 2, None]
    row = k[:, 1, 1, None] * points[..., 1] / z + k[:, 1, 2, None]
    screen = torch.stack([column, row, (seen / z).detach()], -1)
    face = rasterise(screen.detach(), topology.faces, views.size)
    channels = colors.shape[1]
    drawn = torch.cat([colors, torch.ones_like(vertices[:, :1])], 1)
    drawn = drawn if attributes is None else torch.cat([drawn, attributes], 1)
    values, depth = interpolate(points, drawn, topology.faces, face, k)
    solid = values[..., : channels + 1]
    if soft:
        solid = antialias(solid, screen, topology, face, depth.detach())
    image, coverage = solid[..., :channels].permute(0, 3, 1, 2), solid[..., channels]
    if background is not None:
        behind = background[:, None, None] if background.dim() == 1 else background
        image = image + (1 - coverage[:, None]) * behind
    further = None if attributes is None else values[..., channels + 1 :].permute(0, 3, 1, 2)
    return Rendered(image, coverage.clamp(0, 1), depth, face, further)


def rasterise(screen: Tensor, faces: Tensor, size: tuple[int, int]) -> Tensor:
    """The face at every pixel's centre: every pixel of every face's bounding box is tried."""
    return torch.stack([_rasterise_one(view, faces.long(), *size) for view in screen])


def _rasterise_one(screen: Tensor, faces: Tensor, width: int, height: int) -> Tensor:
    limit = torch.tensor([width, height], device=screen.device)
    corners = screen[faces]  # [F, 3, 3]
    first = (corners[..., :2].amin(1) - 0.5).ceil().clamp(min=0)
    last = torch.minimum((corners[..., :2].amax(1) - 0.5).floor(), limit - 1)
    tried = (last - first + 1).clamp(min=0) * (corners[..., 2] > 0).all(1, keepdim=True)  # [F, 2]
    first, columns, count = first.long(), tried[:, 0].long(), tried.prod(1).long()
    f = torch.repeat_interleave(torch.arange(len(faces), device=screen.device), count)
    n = torch.arange(len(f), device=screen.device) - (count.cumsum(0) - count)[f]
    x, y = first[f, 0] + n % columns[f], first[f, 1] + n // columns[f]
    p = corners[f]
    centre = torch.stack([x, y], 1) + 0.5
    area = _turn(p[:, 0, :2], p[:, 1, :2], p[:, 2, :2])
    e = torch.stack([_turn(p[:, (i + 1) % 3, :2], p[:, (i + 2) % 3, :2], centre) for i in range(3)], 1)
    e = e * area.sign()[:, None]
    way = (p[:, (2, 0, 1), :2] - p[:, (1, 2, 0), :2]) * area.sign()[:, None, None]  # along each side
    ties = (e == 0) & ((way[..., 1] < 0) | ((way[..., 1] == 0) & (way[..., 0] > 0)))
    hit = ((e > 0) | ties).all(1) & (area != 0)
    e, p, f = e[hit], p[hit], f[hit]
    z = e.sum(1) / (e * p[..., 2]).sum(1)
    key = (z.float().view(torch.int32).long() << 32) + f
    nearest = torch.full((height * width,), 2**63 - 1, device=screen.device)
    nearest.scatter_reduce_(0, (y * width + x)[hit], key, "amin")
    return nearest.to(torch.int32).view(height, width)


def _turn(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Twice the area of triangles whose corners are [N, 2]; antisymmetric in a and b to the last bit."""
    return (a[:, 0] - c[:, 0]) * (b[:, 1] - c[:, 1]) - (b[:, 0] - c[:, 0]) * (a[:, 1] - c[:, 1])


def interpolate(
    points: Tensor, attributes: Tensor, faces: Tensor, face: Tensor, intrinsics: Tensor
) -> tuple[Tensor, Tensor]:
    """Attributes [B, H, W, C] and depth [B, H, W] where the pixels' rays meet their faces."""
    b, y, x = (face >= 0).nonzero(as_tuple=True)
    corners = faces.long()[face[b, y, x].long()]
    k = intrinsics[b]
    column, row = (x + 0.5 - k[:, 0, 2]) / k[:, 0, 0], (y + 0.5 - k[:, 1, 2]) / k[:, 1, 1]
    ray = torch.stack([column, row, torch.ones_like(column)], 1)
    p0, p1, p2 = (points[b, corners[:, i]] for i in range(3))
    e1, e2 = p1 - p0, p2 - p0
    h, g = torch.linalg.cross(ray, e2), torch.linalg.cross(-p0, e1)
    det = (e1 * h).sum(1)
    b1, b2, z = -(p0 * h).sum(1) / det, (ray * g).sum(1) / det, (e2 * g).sum(1) / det
    a0, a1, a2 = (attributes[corners[:, i]] for i in range(3))
    found = a0 + b1[:, None] * (a1 - a0) + b2[:, None] * (a2 - a0)
    values = found.new_zeros(*face.shape, attributes.shape[1]).index_put((b, y, x), found)
    return values, found.new_zeros(face.shape).index_put((b, y, x), z)


def antialias(values: Tensor, screen: Tensor, topology: Topology, face: Tensor, depth: Tensor) -> Tensor:
    """Values [B, H, W, C] in which each pixel with an end of the surface has its share of the pixel beyond."""
    softened = values
    for axis in range(2):
        step = torch.tensor([axis, 1 - axis], device=face.device)  # in rows and columns
        height, width = face.shape[1:]
        here, there = face[:, : height - axis, : width - 1 + axis], face[:, axis:, 1 - axis :]
        b, *at = (here != there).nonzero(as_tuple=True)
        first = torch.stack(at, 1)
        second = first + step
        z1, z2 = (torch.where(face >= 0, depth, torch.inf)[b, p[:, 0], p[:, 1]] for p in (first, second))
        swap = (z2 < z1)[:, None]
        near, far = torch.where(swap, second, first), torch.where(swap, first, second)
        # Along the walk, across it:
        flat = screen if axis == 0 else screen[..., (1, 0, 2)]
        centre = near[:, (1 - axis, axis)] + 0.5
        way = (1 - 2 * swap[:, 0].int()).to(values.dtype)
        ends = [face[b, p[:, 0], p[:, 1]].long() for p in (near, far)]
        with torch.no_grad():
            i, j = _walk(flat, topology, b, centre, way, *ends)
        kept = i >= 0
        b, i, j, near, far, centre, way = (part[kept] for part in (b, i, j, near, far, centre, way))
        weight = (_crossing(flat[b, i], flat[b, j], centre, way) - 0.5)[:, None]
        change = weight * (values[b, near[:, 0], near[:, 1]] - values[b, far[:, 0], far[:, 1]])
        target = torch.where(weight > 0, far, near)
        softened = softened.index_put((b, target[:, 0], target[:, 1]), change, accumulate=True)
    return softened


def _crossing(p: Tensor, q: Tensor, centre: Tensor, way: Tensor) -> Tensor:
    """How far along the walk from the centre it meets the line p, q."""
    share = (centre[:, 1] - p[:, 1]) / (q[:, 1] - p[:, 1])
    return (p[:, 0] + share * (q[:, 0] - p[:, 0]) - centre[:, 0]) * way


def _walk(
    screen: Tensor, topology: Topology, b: Tensor, centre: Tensor, way: Tensor, start: Tensor, end: Tensor
) -> tuple[Tensor, Tensor]:
    """The two vertices of the side by which a walk of one pixel leaves the surface; -1 if it does not."""
    faces, neighbours = topology.faces.long(), topology.neighbours.long()
    i = torch.full_like(b, -1)
    j = i.clone()
    # Of a face's sides the one that the walk leaves by is where it crosses last.
    f, d, k = start.clone(), torch.full_like(way, -torch.inf), torch.zeros_like(start)
    alive = torch.arange(len(b), device=b.device)

    def leave(f: Tensor, n: Tensor) -> tuple[Tensor, Tensor]:
        corners = screen[b[n, None], faces[f]]  # [N, 3, 3]
        found = []
        for k in range(3):
            p, q = corners[:, (k + 1) % 3], corners[:, (k + 2) % 3]
            crosses = (p[:, 1] <= centre[n, 1]) != (q[:, 1] <= centre[n, 1])
            found.append(torch.where(crosses, _crossing(p, q, centre[n], way[n]), -torch.inf))
        return torch.stack(found, 1).max(1)

    def entered(f: Tensor, came: Tensor, n: Tensor) -> tuple[Tensor, Tensor]:
        """The other side that the walk crosses than the one it came by."""
        corners = screen[b[n, None], faces[f]]
        at, side = torch.full_like(way[n], -torch.inf), torch.zeros_like(f)
        for k in range(3):
            p, q = corners[:, (k + 1) % 3], corners[:, (k + 2) % 3]
            crosses = (p[:, 1] <= centre[n, 1]) != (q[:, 1] <= centre[n, 1])
            crosses &= neighbours[f, k] != came
            at = torch.where(crosses, _crossing(p, q, centre[n], way[n]), at)
            side = torch.where(crosses, k, side)
        return at, side

    if len(b):
        d, k = leave(f, alive)
        alive = alive[d >= -SLACK]
    for _ in range(STEPS):
        alive = alive[d[alive] <= 1]
        if not len(alive):
            break
        at, side = f[alive], k[alive]
        g = neighbours[at, side]
        alive, at, side, g = (part[(g < 0) | (g != end[alive])] for part in (alive, at, side, g))
        there, out = entered(g.clamp(min=0), at, alive)
        behind = (screen[b[alive, None], faces[g.clamp(min=0)], 2] <= 0).any(1)
        over = (g < 0) | behind | (there < d[alive] - SLACK)
        n, p, q = alive[over], faces[at, (side + 1) % 3][over], faces[at, (side + 2) % 3][over]
        reach = (screen[b[n], q] - screen[b[n], p]).abs()
        steep = reach[:, 0] <= reach[:, 1]
        i[n[steep]], j[n[steep]] = p[steep], q[steep]
        alive, g, there, out = (part[~over] for part in (alive, g, there, out))
        f[alive], k[alive], d[alive] = g, out, there
    return i, j
