"""The numbers of one window's answer. Each comes with a weight; tables take weighted means over windows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from overfly.evaluation.answers import Answer, as_true
from overfly.metrics.functional import harmonic
from overfly.networks.baselines import interpolated
from overfly.networks.ground import Rays, pixel_centres, rays
from overfly.stages.clouds import FOOTPRINT, SHARE, window_emd, window_metrics
from overfly.stages.supervision import repeated
from overfly.stages.surfaces import true_heights

Values = dict[str, tuple[float, float]]
"""Value and weight by name."""

VIEWS = {"1_view": (1, 1), "2_views": (2, 2), "3_views": (3, 99)}
"""Classes of places by the number of frames that see them; the last one holds more than three, too."""

LEAST_PIXELS = 50
"""A class of fewer pixels than this says nothing about a window."""

ASKED = 3
"""One in so many pixels asks how near the other surface is: a third of the time, the same figures."""

BINS = 10
"""Of confidence, for its calibration."""

HIDDEN = 0.01
"""A point is hidden in a frame where the surface there is nearer by more than this share of its depth."""


@dataclass(frozen=True)
class Truth:
    """What is known about one window.

    Attributes:
        cast: rays of the reference image's pixels, [1, H W].
        height: true height of the pixels [H W], window units; ``known`` says where it is one.
        known: [H W].
        views: frames that see the place of each pixel [H W], the reference frame included.
        reference: points of the true surface [N, 3], window units.
        tree: of the true dense surface, one point a known pixel.
        scale, gsd, altitude: metres per window unit, metres per pixel, metres.
    """

    cast: Rays
    height: NDArray[np.float64]
    known: NDArray[np.bool_]
    views: NDArray[np.int64]
    reference: NDArray[np.float32]
    tree: cKDTree
    scale: float
    gsd: float
    altitude: float

    def surface(self, height: NDArray) -> NDArray[np.float64]:
        """The points [M, 3] of heights [H W] over the known pixels."""
        points = self.cast.foot[0].double().numpy() + height[:, None] * self.cast.rise[0].double().numpy()
        kept: NDArray[np.float64] = points[self.known]
        return kept


def truths(batch: Mapping[str, Tensor]) -> list[Truth]:
    """The truth about every window of a batch."""
    batch = {name: value.cpu() for name, value in as_true(batch).items()}
    height, width = batch["images"].shape[-2:]
    cells = pixel_centres(width, height, width, height, torch.device("cpu"))
    cast = rays(cells, batch["intrinsics"][:, 0], batch["camera_from_window"][:, 0])
    heights, known = true_heights(batch, width, height)
    counts = count_views(batch, cast.at(heights.flatten(1)))
    found = []
    for b in range(len(heights)):
        own = Rays(cast.foot[b : b + 1], cast.rise[b : b + 1])
        flat, sure = heights[b].flatten().double().numpy(), known[b].flatten().numpy()
        points = own.at(heights[b : b + 1].flatten(1))[0].double().numpy()[sure]
        scalars = (float(batch[name][b]) for name in ("scale", "gsd", "altitude"))
        reference = batch["reference"][b].numpy()
        found.append(Truth(own, flat, sure, counts[b].numpy(), reference, cKDTree(points), *scalars))
    return found


def count_views(batch: Mapping[str, Tensor], points: Tensor) -> Tensor:
    """How many different frames have points [B, N, 3] inside their image and not hidden, the reference included."""
    poses, depth = batch["camera_from_window"], batch["depth"]
    height, width = depth.shape[-2:]
    again = repeated(batch)
    count = torch.ones(points.shape[:2], dtype=torch.int64)
    for k in range(1, poses.shape[1]):
        local = points @ poses[:, k, :3, :3].transpose(1, 2) + poses[:, k, None, :3, 3]
        z = local[..., 2]
        at = local @ batch["intrinsics"][:, k].transpose(1, 2)
        pixels = at[..., :2] / at[..., 2:].clamp(min=1e-6)
        u, v = (
            pixels[..., 0] * (width / batch["images"].shape[-1]),
            pixels[..., 1] * (height / batch["images"].shape[-2]),
        )
        inside = (z > 1e-6) & (u > 0) & (u < width) & (v > 0) & (v < height)
        left, top = (u - 0.5).floor().clamp(0, width - 2).long(), (v - 0.5).floor().clamp(0, height - 2).long()
        flat = depth[:, k].flatten(1)
        around = torch.stack([flat.gather(1, (top + y) * width + left + x) for y in (0, 1) for x in (0, 1)])
        shown = inside & (z <= (1 + HIDDEN) * around.amax(0))
        new = ~again[:, k, :k].any(1)
        count += (shown & new[:, None]).long()
    return count


def camera_values(batch: Mapping[str, Tensor], number: int) -> Values:
    """How good the estimated cameras of a window of a batch are: nothing where methods were given the true ones.

    ``cameras_placed`` is the share of its frames that were placed, ``cameras_px`` the median distance, in pixels of the
    other frames, between where the estimated and the true poses put what the reference frame sees.
    """
    if "placed" not in batch:
        return {}
    values: Values = {"cameras_placed": (float(batch["placed"][number].double().mean()), 1.0)}
    depth = batch["depth"][number, 0].flatten().double()
    height, width = batch["depth"].shape[-2:]
    pixels = pixel_centres(width, height, width, height, depth.device).double()
    intrinsics = batch["intrinsics"][number].double()
    ones = torch.ones_like(pixels[:, :1])
    local = torch.cat([torch.cat([pixels, ones], 1) @ intrinsics[0].inverse().T * depth[:, None], ones], 1)[depth > 0]
    off = []
    for k in range(1, len(intrinsics)):
        if repeated(batch)[number, k, :k].any():
            continue
        shown = []
        for name in ("camera_from_window", "true_camera_from_window"):
            poses = batch[name][number].double()
            there = (local @ (poses[k] @ poses[0].inverse()).T)[:, :3] @ intrinsics[k].T
            shown.append(torch.where(there[:, 2:] > 0, there[:, :2] / there[:, 2:], torch.nan))
        inside = ((shown[1] > 0) & (shown[1] < shown[1].new_tensor([width, height]))).all(1)
        off.append((shown[0] - shown[1]).norm(dim=1)[inside])
    if off and len(every := torch.cat(off)) >= LEAST_PIXELS:
        values["cameras_px"] = (float(every.nanmedian()), 1.0)
    return values


def cloud_values(answer: Answer, number: int, truth: Truth, *, emd: bool) -> Values:
    """Metrics of the cloud of one window of a batch; the EMD, if asked for, takes 0.08 s."""
    points = answer.points[number].cpu().numpy()
    values = window_metrics(points, truth.reference, truth.scale)
    if emd and len(points) == len(truth.reference):
        values["emd_sum_1024"] = window_emd(points, truth.reference)
    return {name: (value, 1.0) for name, value in values.items()}


def surface_values(answer: Answer, number: int, truth: Truth) -> tuple[Values, list[list[float]] | None]:
    """Metrics of the surface of one window of a batch, over the pixels whose true height is known.

    Returns:
        The values, and for methods with a confidence its calibration: for each of ``BINS`` bins the number of pixels,
        the sum of their confidence and the number of those that are right.
    """
    height = answer.height[number].double().cpu().numpy().ravel()
    known = truth.known
    error, views = np.abs(height - truth.height)[known], truth.views[known]
    metres, percent = error * truth.scale, error * truth.scale / truth.altitude * 100
    values: Values = {"height_mean_m": _mean(metres), "height_mean_percent": _mean(percent)}
    again = views >= 2
    if again.sum() >= LEAST_PIXELS:
        middle = float(np.median(metres[again]))
        values |= {"height_median_gsd": (middle / truth.gsd, 1.0), "height_median_m": (middle, 1.0)}
    for name, (least, most) in VIEWS.items():
        chosen = (views >= least) & (views <= most)
        if chosen.sum() >= LEAST_PIXELS:
            values[f"height_mean_m_{name}"] = _mean(metres[chosen], chosen.sum())
            values[f"height_mean_percent_{name}"] = _mean(percent[chosen], chosen.sum())
        values[f"area_{name}"] = (float(chosen.mean()) if len(chosen) else 0.0, 1.0)
    values |= _shares(answer, number, truth, height, views)
    calibration = None
    if answer.sigma is not None:
        sigma = answer.sigma[number].double().cpu().numpy().ravel()[known]
        values |= {"within_sigma": _mean(error <= sigma), "within_2sigma": _mean(error <= 2 * sigma)}
    if answer.confidence is not None:
        confidence = answer.confidence[number].double().cpu().numpy().ravel()[known]
        calibration = _calibration(confidence, error <= answer.right_within)
    if answer.measured is not None:
        values["measured"] = _mean(answer.measured[number].cpu().numpy().ravel()[known])
    return values, calibration


def _shares(answer: Answer, number: int, truth: Truth, height: NDArray, views: NDArray) -> Values:
    """F-scores of the dense surface, of all of it and of what one frame sees alone."""
    once = views == 1
    near, found = _both_near(truth, height, np.ones_like(once))
    asked = once[::ASKED]
    values: Values = {"fscore_dense_2pct": (_fscore(near, found), 1.0)}
    if min(once.sum(), (~once).sum()) < LEAST_PIXELS or not asked.any():
        return values
    values["fscore_once_2pct"] = (_fscore(near[asked], found[asked]), 1.0)
    if answer.confidence is not None or answer.measured is not None:
        closed = height.copy()
        feet = truth.cast.foot[0, :, :2].double().numpy()
        seen_once, seen_again = (np.flatnonzero(truth.known)[x] for x in (once, ~once))
        points = np.column_stack([feet[seen_again], height[seen_again]])
        closed[seen_once] = interpolated(feet[seen_once], points, neighbours=8)
        values["fscore_once_interpolated_2pct"] = (_fscore(*_both_near(truth, closed, once)), 1.0)
    return values


def _both_near(truth: Truth, height: NDArray, chosen: NDArray[np.bool_]) -> tuple[NDArray, NDArray]:
    """Whether points of a surface are near the true one, and the reverse, for some of the chosen known pixels."""
    surface, true = truth.surface(height), truth.surface(truth.height)
    asked = np.flatnonzero(chosen[::ASKED]) * ASKED
    tree = cKDTree(surface, balanced_tree=False, compact_nodes=False)
    return _near(truth.tree, surface[asked]), _near(tree, true[asked])


def _fscore(near: NDArray[np.bool_], found: NDArray[np.bool_]) -> float:
    return harmonic(float(near.mean()), float(found.mean()))


def _near(tree: cKDTree, points: NDArray) -> NDArray[np.bool_]:
    """Which points [M, 3] lie within 2 % of the footprint's width of the tree's."""
    distance, _ = tree.query(points, distance_upper_bound=SHARE * FOOTPRINT)
    return np.isfinite(distance)


def _calibration(confidence: NDArray, right: NDArray[np.bool_]) -> list[list[float]]:
    place = np.clip((confidence * BINS).astype(int), 0, BINS - 1)
    sums = (np.bincount(place, weight, BINS) for weight in (np.ones_like(confidence), confidence, right))
    return np.stack(list(sums), 1).tolist()


def _mean(values: NDArray, weight: float = 1.0) -> tuple[float, float]:
    """Their mean; weight 0 where there are none."""
    return (float(values.mean()), float(weight)) if len(values) else (0.0, 0.0)
