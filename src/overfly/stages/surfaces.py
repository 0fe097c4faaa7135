"""What depth teaches a network that predicts surfaces: its loss terms, and how good the surface is."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from overfly import losses
from overfly.networks.ground import REACH, pixel_centres, rays
from overfly.networks.sweep_generator import Surface

TERMS = ("height", "hypotheses", "sigma", "confidence")

METRICS = (
    "height_median_gsd", "height_mean_m", "height_mean_percent", "height_mean_m_seen_once", "within_sigma",
    "within_2sigma",
)  # fmt: skip
"""What :func:`surface_metrics` may return."""

RIGHT_PX = 2.0
"""A height counts as right within this number of ground pixels of the octave: what ``confidence`` is about."""


def true_heights(batch: Mapping[str, Tensor], width: int, height: int) -> tuple[Tensor, Tensor]:
    """Height of the surface at the pixels of the reference image, ``width`` x ``height`` of them.

    Returns:
        Heights [B, height, width], window units, and whether they are known; rays towards the horizon are not.
    """
    depth = batch["depth"][:, 0]
    factor = depth.shape[2] // width
    depth = depth[:, factor // 2 :: factor, factor // 2 :: factor]
    full = (batch["depth"].shape[3], batch["depth"].shape[2])
    cells = pixel_centres(*full, width, height, depth.device)
    pose, intrinsics = batch["camera_from_window"][:, 0], batch["intrinsics"][:, 0]
    ahead = torch.cat([cells, torch.ones_like(cells[:, :1])], 1) @ torch.linalg.inv(intrinsics).transpose(1, 2)
    points = (ahead * depth.flatten(1)[..., None] - pose[:, None, :3, 3]) @ pose[:, :3, :3]
    towards = rays(cells, intrinsics, pose).rise[..., :2].norm(dim=-1)
    known = (depth.flatten(1) > 0) & (towards < 0.99 * REACH)
    shape = (-1, height, width)
    return points[..., 2].reshape(shape), known.reshape(shape)


def surface_terms(surfaces: Sequence[Surface], batch: Mapping[str, Tensor], names: Iterable[str]) -> dict[str, Tensor]:
    """The loss terms of all sweeps, each the mean over known pixels and sweeps."""
    names = set(names)
    found: dict[str, list[Tensor]] = {}
    for surface in surfaces:
        true, known = true_heights(batch, surface.height.shape[2], surface.height.shape[1])
        error = (surface.height - true).detach()
        if "height" in names:
            half_step = surface.step[:, None, None] / 2
            found.setdefault("height", []).append(_mean(losses.height(surface.height, true, half_step), known))
        if "sigma" in names:
            scaled = error / surface.step[:, None, None]
            found.setdefault("sigma", []).append(_mean(losses.sigma(surface.log_sigma.clamp(-6, 6), scaled), known))
        if "confidence" in names:
            right = error.abs() <= right_within(surface)
            found.setdefault("confidence", []).append(_mean(losses.confidence(surface.confidence, right), known))
        if "hypotheses" in names:
            stride = true.shape[1] // surface.logits.shape[2]
            at, sure = (x[:, stride // 2 :: stride, stride // 2 :: stride] for x in (true, known))
            low, high = surface.hypotheses[:, 0], surface.hypotheses[:, -1]
            sure = sure & (at >= low) & (at <= high)
            value = losses.hypotheses(surface.logits, surface.hypotheses, at)
            found.setdefault("hypotheses", []).append(_mean(value, sure))
    return {name: torch.stack(values).mean() for name, values in found.items()}


def right_within(surface: Surface) -> float:
    """The error up to which a height is right, window units."""
    return RIGHT_PX * 2 / surface.height.shape[2]


@torch.no_grad()
def surface_metrics(output: Mapping[str, Any], batch: Mapping[str, Tensor]) -> tuple[dict[str, float], int]:
    """How good the last surface is over the pixels of the reference image.

    Returns:
        ``height_median_gsd``, ``height_mean_m``: absolute height error where two frames or more see the point;
        ``height_mean_m_seen_once`` elsewhere; ``within_sigma``, ``within_2sigma``: shares, ideally 0.68 and 0.95;
        and the number of windows.
    """
    height = output["height"]
    true, known = true_heights(batch, height.shape[2], height.shape[1])
    error = (height - true).abs()
    measured = known & (output["views"] >= 2)
    scale, gsd = batch["scale"][:, None, None], batch["gsd"][:, None, None]
    values = {}
    if measured.any():
        values["height_median_gsd"] = float((error * scale / gsd)[measured].median())
        values["height_mean_m"] = float((error * scale)[measured].mean())
        values["height_mean_percent"] = float((error * scale / batch["altitude"][:, None, None])[measured].mean() * 100)
    once = known & (output["views"] < 2)
    if once.any():
        values["height_mean_m_seen_once"] = float((error * scale)[once].mean())
    values["within_sigma"] = float((error <= output["sigma"])[known].float().mean())
    values["within_2sigma"] = float((error <= 2 * output["sigma"])[known].float().mean())
    return values, len(height)


def _mean(values: Tensor, known: Tensor) -> Tensor:
    return torch.where(known, values, torch.zeros_like(values)).sum() / known.sum().clamp(min=1)
