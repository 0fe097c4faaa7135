"""Key points, nearest-neighbour correspondences between dense maps, and the true ones from depth and cameras.

Pixels are (u, v) = (column, row) with the first pixel's centre at (0.5, 0.5), as everywhere. The cell (row, column) of
a map of ``stride`` s is centred on pixel (s (column + 0.5), s (row + 0.5)). All functions take a batch of P pairs.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from overfly.networks.encoder import MATCH_STRIDE

TILE = 24
"""Cells along a side of the squares whose queries share a window."""


class Matches(NamedTuple):
    """Correspondences of one pair: pixels_a [M, 2], pixels_b [M, 2], score [M] (cosine similarity, -1..1)."""

    pixels_a: Tensor
    pixels_b: Tensor
    score: Tensor


def cell_pixels(height: int, width: int, stride: int = MATCH_STRIDE, device: torch.device | None = None) -> Tensor:
    """The pixels on which the cells of a map [height, width] are centred: [height * width, 2]."""
    v, u = torch.meshgrid(torch.arange(height, device=device), torch.arange(width, device=device), indexing="ij")
    return (torch.stack([u, v], -1).reshape(-1, 2) + 0.5) * stride


def sample(maps: Tensor, pixels: Tensor, stride: int = MATCH_STRIDE) -> Tensor:
    """Bilinear samples of maps [P, C, h, w] at pixels [P, M, 2] -> [P, M, C]; beyond the border its value."""
    size = torch.tensor([maps.shape[3], maps.shape[2]], dtype=maps.dtype, device=maps.device) * stride
    grid = (pixels / size * 2 - 1)[:, :, None]  # [P, M, 1, 2]
    return F.grid_sample(maps, grid, padding_mode="border", align_corners=False)[..., 0].transpose(1, 2)


def keypoints(match_map: Tensor, count: int, *, border: int = 2, radius: int = 1) -> tuple[Tensor, Tensor]:
    """The most distinctive cells of match maps.

    A cell's score is how little its descriptor resembles its neighbours' at two cells' distance: what resembles its
    surroundings (meadow, roof, a straight edge) cannot be located. Only local maxima count.

    Args:
        match_map: unit vectors [P, C, h, w].
        count: number of key points M per map.
        border: cells at the rim that are left out.
        radius: half the window of non-maximum suppression, cells.

    Returns:
        Cell indices (row * w + column) [P, M], best first, and scores [P, M]; the score is -inf where a map has fewer
        local maxima than ``count``.
    """
    h, w = match_map.shape[2:]
    padded = F.pad(match_map, (2, 2, 2, 2), mode="replicate")
    likeness = torch.stack(
        [
            (match_map * padded[:, :, 2 + dy : 2 + dy + h, 2 + dx : 2 + dx + w]).sum(1)
            for dy in (-2, 0, 2)
            for dx in (-2, 0, 2)
            if dy or dx
        ]
    )
    score = 1 - likeness.amax(0)  # [P, h, w]
    peak = score == F.max_pool2d(score[:, None], 2 * radius + 1, 1, radius)[:, 0]
    inside = torch.zeros(h, w, dtype=torch.bool, device=score.device)
    inside[border : h - border, border : w - border] = True
    score = torch.where(peak & inside, score, torch.full_like(score, -torch.inf)).flatten(1)
    best, cells = score.topk(min(count, h * w), dim=1)
    return cells, best


def nearest(queries: Tensor, match_map: Tensor, stride: int = MATCH_STRIDE) -> tuple[Tensor, Tensor]:
    """The best place for each descriptor in another image, refined below the cell by a parabola in each axis.

    Args:
        queries: unit vectors [P, M, C].
        match_map: unit vectors [P, C, h, w].

    Returns:
        Pixels [P, M, 2] and the cosine similarity [P, M] of the best cell.
    """
    h, w = match_map.shape[2:]
    similarity = queries @ match_map.flatten(2)  # [P, M, h w]
    score, cell = similarity.max(dim=2)
    row, column = cell // w, cell % w
    offsets = []
    for position, size, step in ((column, w, 1), (row, h, w)):
        inner = (position > 0) & (position < size - 1)
        before = similarity.gather(2, torch.where(inner, cell - step, cell)[..., None])[..., 0]
        after = similarity.gather(2, torch.where(inner, cell + step, cell)[..., None])[..., 0]
        curvature = before + after - 2 * score  # never positive: the cell is the maximum
        shift = (before - after) / (2 * torch.where(curvature < -1e-6, curvature, torch.ones_like(curvature)))
        offsets.append(torch.where(inner & (curvature < -1e-6), shift.clamp(-0.5, 0.5), torch.zeros_like(shift)))
    refined = torch.stack([column, row], -1) + 0.5 + torch.stack(offsets, -1)
    return refined * stride, score


def nearest_around(
    queries: Tensor, match_map: Tensor, around: Tensor, reach: float, stride: int = MATCH_STRIDE
) -> tuple[Tensor, Tensor]:
    """:func:`nearest` in one image, where it is known roughly where to look: a small part of the cells is compared.

    Args:
        queries: unit vectors [M, C].
        match_map: unit vectors [C, h, w].
        around: pixels [M, 2] about which each is looked for.
        reach: pixels off them to each side, at the least: queries that lie together share a window.

    Returns:
        Pixels [M, 2] and the cosine similarity [M] of the best cell.
    """
    h, w = match_map.shape[1:]
    pixels, score = torch.zeros_like(around), around.new_zeros(len(around))
    limit = torch.tensor([w, h], device=around.device) - 1
    cell = torch.minimum((around / stride).long().clamp(min=0), limit)
    tile, cells = cell // TILE, math.ceil(reach / stride)
    for column, row in tile.unique(dim=0).tolist():
        own = ((tile[:, 0] == column) & (tile[:, 1] == row)).nonzero()[:, 0]
        left, top = (max(0, TILE * k - cells) for k in (column, row))
        window = match_map[None, :, top : TILE * (row + 1) + cells, left : TILE * (column + 1) + cells]
        found, similarity = nearest(queries[None, own], window, stride)
        pixels[own] = found[0] + torch.tensor([left, top], device=found.device) * stride
        score[own] = similarity[0]
    return pixels, score


@torch.no_grad()
def match(a: Tensor, b: Tensor, *, count: int = 512, mutual: bool = True, stride: int = MATCH_STRIDE) -> Matches:
    """Correspondences between two images from their match maps.

    Args:
        a, b: unit vectors [C, h, w] (:class:`overfly.networks.encoder.Encoded`).
        count: key points that are looked for in ``a``.
        mutual: keep only those whose best place in ``b`` leads back to within one cell of the key point.

    Returns:
        The matches, best score first.
    """
    cells, score = keypoints(a[None], count)
    cells = cells[0, torch.isfinite(score[0])]
    pixels_a = cell_pixels(a.shape[1], a.shape[2], stride, a.device)[cells]
    pixels_b, similarity = nearest(a.flatten(1).T[cells][None], b[None], stride)
    keep = torch.ones(len(cells), dtype=torch.bool, device=a.device)
    if mutual and len(cells):
        there = sample(b[None], pixels_b, stride)
        back, _ = nearest(F.normalize(there, dim=2), a[None], stride)
        keep = (back[0] - pixels_a).abs().amax(1) <= stride
    order = similarity[0, keep].argsort(descending=True, stable=True)
    return Matches(pixels_a[keep][order], pixels_b[0, keep][order], similarity[0, keep][order])


def sample_depth(depth: Tensor, pixels: Tensor, edge: float = 0.02) -> tuple[Tensor, Tensor]:
    """Depth between pixel centres, exact on planes (1 / z is affine in the pixel there).

    Args:
        depth: [P, H, W], 0 = unknown.
        pixels: [P, M, 2].
        edge: the four pixels around must be known and agree within this share of their depth.

    Returns:
        Depth [P, M] and whether it is valid [P, M] (inside the image, known, not across an edge).
    """
    h, w = depth.shape[1:]
    u, v = pixels[..., 0] - 0.5, pixels[..., 1] - 0.5
    inside = (u >= 0) & (u <= w - 1) & (v >= 0) & (v <= h - 1)
    u, v = (torch.where(inside, x, torch.zeros_like(x)) for x in (u, v))
    left, top = u.floor().clamp(max=w - 2).long(), v.floor().clamp(max=h - 2).long()
    fu, fv = u - left, v - top
    flat = depth.flatten(1)
    corners = torch.stack([flat.gather(1, (top + dy) * w + left + dx) for dy in (0, 1) for dx in (0, 1)])  # [4, P, M]
    low, high = corners.amin(0), corners.amax(0)
    valid = inside & (low > 0) & (high - low <= edge * low)
    inverse = 1 / torch.where(valid, corners, torch.ones_like(corners))
    weights = torch.stack([(1 - fu) * (1 - fv), fu * (1 - fv), (1 - fu) * fv, fu * fv])
    return 1 / (inverse * weights).sum(0), valid


def true_correspondences(
    pixels_a: Tensor,
    depth_a: Tensor,
    intrinsics_a: Tensor,
    a_from_window: Tensor,
    depth_b: Tensor,
    intrinsics_b: Tensor,
    b_from_window: Tensor,
    *,
    tolerance: float = 0.01,
) -> tuple[Tensor, Tensor]:
    """Where the surface seen at pixels of image a appears in image b, and whether b truly sees it.

    Args:
        pixels_a: [P, M, 2].
        depth_a, depth_b: [P, H, W], 0 = unknown.
        intrinsics_a, intrinsics_b: [P, 3, 3]; any homography from camera axes to pixels.
        a_from_window, b_from_window: rigid camera poses [P, 4, 4], in the depths' unit.
        tolerance: b sees the point if its depth there is the point's own within this share.

    Returns:
        Pixels in b [P, M, 2] (meaningful only where visible) and visible [P, M]: depth is known on both sides, the
        point lies in front of b and inside its image, and nothing hides it.
    """
    depth, known = sample_depth(depth_a, pixels_a)
    ones = torch.ones_like(depth)[..., None]
    rays = torch.cat([pixels_a, ones], -1) @ torch.linalg.inv(intrinsics_a).transpose(1, 2)
    rays = rays / rays[..., 2:]  # of an aligned frame, whose matrix is any homography
    b_from_a = b_from_window @ torch.linalg.inv(a_from_window)
    in_b = (rays * depth[..., None]) @ b_from_a[:, :3, :3].transpose(1, 2) + b_from_a[:, None, :3, 3]
    z = in_b[..., 2]
    ahead = known & (z > 1e-6)
    projected = in_b @ intrinsics_b.transpose(1, 2)
    ahead = ahead & (projected[..., 2] > 1e-6)
    pixels_b = projected[..., :2] / torch.where(ahead, projected[..., 2], torch.ones_like(z))[..., None]
    pixels_b = torch.where(ahead[..., None], pixels_b, torch.full_like(pixels_b, -1.0))
    seen, valid = sample_depth(depth_b, pixels_b)
    return pixels_b, ahead & valid & ((seen - z).abs() <= tolerance * z)
