"""What depth and cameras teach the encoder: its loss terms and its accuracies, for the encoder and the full stage."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import torch
from torch import Tensor

from overfly import losses
from overfly.networks.encoder import MATCH_STRIDE
from overfly.networks.matching import cell_pixels, keypoints, nearest, true_correspondences
from overfly.networks.poses import inverse, motion, relative, transform_from, true_correction

RIGHT_PX = 2.0
"""A match counts as right within this distance of the truth (design: the encoder's accuracy)."""


def encoder_terms(
    output: Mapping[str, Tensor],
    batch: Mapping[str, Tensor],
    names: Iterable[str],
    *,
    pixels: int,
    random: torch.Generator,
) -> dict[str, Tensor]:
    """The encoder's loss terms, means over what can be judged.

    Args:
        output: of the network: ``match_map``, ``descriptor``, ``correction``; ``compared`` where a sweep compares
            another map than the match map.
        batch: of windows.
        names: the terms that are asked for.
        pixels: number of correspondences drawn per pair of frames.
        random: draws them.

    Returns:
        Scalars by name, differentiable; 0 where nothing can be judged (no overlap, one frame).
    """
    names, terms = set(names), {}
    if "correspondence" in names:
        compared = output.get("compared", output["match_map"])
        terms["correspondence"] = _correspondence(compared, output, batch, pixels, random)
    if "matching" in names and "compared" in output:
        terms["matching"] = _correspondence(output["match_map"], output, batch, pixels, random)
    if "retrieval" in names:
        positive, negative = overlapping(batch)
        values = losses.retrieval(output["descriptor"].flatten(0, 1), positive, negative)
        judged = positive.any(1) & negative.any(1)
        terms["retrieval"] = _mean(values, judged)
    if "correction" in names:
        true = true_correction(batch["prior_from_window"], batch["camera_from_window"])[:, 1:]
        values = losses.correction(output["correction"], true)
        terms["correction"] = _mean(values, torch.ones_like(values, dtype=torch.bool))
    return terms


def overlapping(batch: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
    """Which pairs of the batch's B K frames see common ground, and which surely do not, both [B K, B K].

    Windows of one scene may overlap each other by an unknown amount: such pairs are neither. Two frames of a window
    that share nothing are the hardest negatives: the same landscape in the same light.
    """
    same = repeated(batch)
    common, apart = (batch["overlaps"] > 0) & ~same, (batch["overlaps"] <= 0) & ~same
    positive, elsewhere = (torch.block_diag(*x.to(torch.uint8)).bool() for x in (common, apart))
    frame_scene = batch["scene"].repeat_interleave(common.shape[1])
    return positive, (frame_scene[:, None] != frame_scene[None]) | elsewhere


def repeated(batch: Mapping[str, Tensor]) -> Tensor:
    """Which pairs of a window's frames are the same image [B, K, K]; the diagonal is.

    A window repeats a frame where the flight has too few neighbours: matching an image with itself teaches nothing.
    """
    poses = batch["camera_from_window"].flatten(2)
    return (poses[:, :, None] - poses[:, None]).abs().amax(-1) < 1e-6


def matching_counts(output: Mapping[str, Tensor], batch: Mapping[str, Tensor], count: int) -> tuple[int, int]:
    """Key points whose nearest neighbour in an overlapping frame is within 2 px of the truth, and all that are visible.

    Args:
        output: of the network: ``match_map`` [B, K, C, h, w], and whose images it belongs to.
        batch: of windows.
        count: key points per frame.

    Returns:
        Both numbers, over all ordered pairs of frames of the windows.
    """
    match_map, cameras = output["match_map"].detach(), match_cameras(output, batch)
    b, k, _, h, w = match_map.shape
    places = cell_pixels(h, w, MATCH_STRIDE, match_map.device)
    cells, score = (x.unflatten(0, (b, k)) for x in keypoints(match_map.flatten(0, 1), count))
    same = repeated(batch)
    right = visible = 0
    for i in range(k):
        pixels = places[cells[:, i]]  # [B, M, 2]
        queries = match_map[:, i].flatten(2).transpose(1, 2)
        queries = queries.gather(1, cells[:, i, :, None].expand(-1, -1, queries.shape[2]))
        for j in range(k):
            if i != j:
                true, seen = true_correspondences(pixels, *cameras[i], *cameras[j])
                seen = seen & torch.isfinite(score[:, i]) & ~same[:, i, j, None]
                found, _ = nearest(queries, match_map[:, j])
                right += int((seen & ((found - true).norm(dim=-1) <= RIGHT_PX)).sum())
                visible += int(seen.sum())
    return right, visible


def correction_errors(output: Mapping[str, Tensor], batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Mean errors of the relative poses before (``prior_``) and after (``corrected_``) the correction."""
    true = relative(batch["camera_from_window"])[:, 1:]
    prior = relative(batch["prior_from_window"])[:, 1:]
    metres = batch["scale"][:, None]
    errors = {}
    for name, poses in (("prior", prior), ("corrected", transform_from(output["correction"]) @ prior)):
        rotation = motion(true @ inverse(poses))[..., :3].norm(dim=-1)
        position = (inverse(true)[..., :3, 3] - inverse(poses)[..., :3, 3]).norm(dim=-1)
        errors[f"{name}_rotation_deg"] = rotation.mean() * (180 / math.pi)
        errors[f"{name}_position_m"] = (position * metres).mean()
    return errors


def _correspondence(
    match_map: Tensor, output: Mapping[str, Tensor], batch: Mapping[str, Tensor], count: int, random: torch.Generator
) -> Tensor:
    cameras = match_cameras(output, batch)
    b, k, _, h, w = match_map.shape
    places = cell_pixels(h, w, MATCH_STRIDE, match_map.device).expand(b, -1, -1)
    same = repeated(batch)
    values, judged = [], []
    for i in range(k):
        for j in range(i + 1, k):
            first, second = (i, j) if int(torch.randint(2, (1,), generator=random)) else (j, i)
            true, visible = true_correspondences(places, *cameras[first], *cameras[second])
            order = torch.rand(b, h * w, generator=random).to(visible.device)
            chosen = torch.where(visible, order, order - 1).topk(min(count, h * w), dim=1).indices  # visible ones first
            queries = match_map[:, first].flatten(2).transpose(1, 2)
            queries = queries.gather(1, chosen[..., None].expand(-1, -1, queries.shape[2]))
            at = true.gather(1, chosen[..., None].expand(-1, -1, 2)) / MATCH_STRIDE
            values.append(losses.correspondence(queries, match_map[:, second], at))
            judged.append(visible.gather(1, chosen) & ~same[:, i, j, None])
    if not values:
        return match_map.sum() * 0
    return _mean(torch.stack(values), torch.stack(judged))


Cameras = tuple[Tensor, Tensor, Tensor]


def match_cameras(output: Mapping[str, Tensor], batch: Mapping[str, Tensor]) -> list[Cameras]:
    """Depth, intrinsics and pose of the images that each frame's match map belongs to: its own, or aligned ones."""
    depth, intrinsics = output.get("match_depth", batch["depth"]), output.get("match_intrinsics", batch["intrinsics"])
    poses = batch["camera_from_window"]
    return [(depth[:, k], intrinsics[:, k], poses[:, k]) for k in range(poses.shape[1])]


def _mean(values: Tensor, judged: Tensor) -> Tensor:
    """The mean of the values that are judged; 0, but still part of the graph, if none is."""
    return torch.where(judged, values, torch.zeros_like(values)).sum() / judged.sum().clamp(min=1)
