"""Losses: pure, differentiable, one value per sample (unreduced over the batch); their weights stand in conf/loss.

Distances follow the unit of the points: in windows, half the footprint's width.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from torch import Tensor


def chamfer(predicted: Tensor, target: Tensor) -> Tensor:
    """Mean squared distance to the nearest neighbour, both directions summed.

    The paper's Eq. 2 is the sum over N = 1024 points of each cloud, thus 1024 times this value. Neighbours are found
    exactly by a KD-tree on the CPU; gradients flow through the distances to the neighbours chosen, as is usual.

    Args:
        predicted: [B, N, 3].
        target: [B, M, 3].

    Returns:
        [B], square units.

    Raises:
        ValueError: shapes do not match, a cloud is empty or a coordinate is not finite.
    """
    _check(predicted, target)
    nearest = [_neighbours(p, t) for p, t in zip(_numpy(predicted), _numpy(target), strict=True)]
    to_target = _index([forward for forward, _ in nearest], predicted)
    to_predicted = _index([backward for _, backward in nearest], predicted)
    forward = (predicted - _gather(target, to_target)).square().sum(-1).mean(1)
    return forward + (target - _gather(predicted, to_predicted)).square().sum(-1).mean(1)


def emd(predicted: Tensor, target: Tensor) -> Tensor:
    """Earth mover's distance: mean distance over the best one-to-one assignment (exact; not squared).

    The paper's Eq. 3 is the sum over N = 1024 points, thus 1024 times this value. The assignment takes about 0.08 s per
    sample at N = 1024: as a training loss give it a subset. Where a pair coincides its gradient is 0.

    Args:
        predicted, target: [B, N, 3].

    Returns:
        [B], units of the points.

    Raises:
        ValueError: shapes do not match, the clouds have unequal numbers of points, or as in :func:`chamfer`.
    """
    _check(predicted, target)
    if predicted.shape[1] != target.shape[1]:
        raise ValueError(
            f"EMD needs equally many points in both clouds, not {predicted.shape[1]} and {target.shape[1]}: "
            "take a random subset of the larger one."
        )
    pairs = zip(_numpy(predicted), _numpy(target), strict=True)
    partner = _index([linear_sum_assignment(cdist(p, t))[1] for p, t in pairs], predicted)
    squared = (predicted - _gather(target, partner)).square().sum(-1)
    apart = squared > 0  # the root has no finite derivative at 0
    return torch.where(apart, torch.where(apart, squared, 1.0).sqrt(), 0.0).mean(1)


def correspondence(queries: Tensor, match_map: Tensor, places: Tensor, temperature: float = 0.07) -> Tensor:
    """InfoNCE (van den Oord et al. 2018) of descriptors against every cell of the other image's match map.

    The true place lies between cells, so the right answer is shared by the four cells around it by bilinear weights:
    the best map has its maximum where a parabola finds it again below the cell.

    Args:
        queries: descriptors [P, M, C] of points of one image, unit vectors.
        match_map: descriptors of the other image, unit vectors [P, C, h, w].
        places: where the points truly are, in cells of that map, cell centres at + 0.5 [P, M, 2]; outside it, the
            nearest cell counts.
        temperature: by which similarities are divided.

    Returns:
        [P, M], nats; log(h w) for a map that knows nothing.
    """
    h, w = match_map.shape[2:]
    queries = queries / temperature  # [P, M, C]
    cells = match_map.flatten(2).transpose(1, 2)  # [P, h w, C]
    u = (places[..., 0] - 0.5).clamp(0, w - 1)
    v = (places[..., 1] - 0.5).clamp(0, h - 1)
    left, top = u.floor().clamp(max=max(w - 2, 0)).long(), v.floor().clamp(max=max(h - 2, 0)).long()
    fu, fv = u - left, v - top
    expected = torch.zeros_like(queries)  # the mean of the right cells' descriptors: its logit is theirs, weighted
    for dx, wx in ((0, 1 - fu), (1, fu)):
        for dy, wy in ((0, 1 - fv), (1, fv)):
            cell = (top + dy).clamp(max=h - 1) * w + (left + dx).clamp(max=w - 1)
            expected = expected + (wx * wy)[..., None] * cells.gather(1, cell[..., None].expand_as(queries))
    # One pair at a time: its logits [M, h w] stay in the cache, those of all pairs do not.
    every = torch.stack([(q @ c.T).logsumexp(1) for q, c in zip(queries, cells, strict=True)])
    return every - (queries * expected).sum(2)


def retrieval(descriptors: Tensor, positive: Tensor, negative: Tensor, temperature: float = 0.1) -> Tensor:
    """InfoNCE with several right answers: an image's descriptor must be nearer to those that see the same ground.

    Args:
        descriptors: unit vectors [M, D].
        positive: [M, M] bool, the images overlap on the ground; the diagonal is ignored.
        negative: [M, M] bool, they surely do not; pairs that are neither do not count.
        temperature: by which similarities are divided.

    Returns:
        [M], nats; 0 for images without a positive.
    """
    others = ~torch.eye(len(descriptors), dtype=torch.bool, device=descriptors.device)
    positive = positive & others
    logits = descriptors @ descriptors.T / temperature
    lowest = torch.finfo(logits.dtype).min
    against = torch.where(positive | (negative & others), logits, lowest).logsumexp(1)
    right = torch.where(positive, logits, lowest).logsumexp(1)
    return torch.where(positive.any(1), against - right, torch.zeros_like(right))


def correction(predicted: Tensor, true: Tensor, beta: float = 0.01) -> Tensor:
    """Smooth L1 between motions [..., 6] (rotation vector in radians, translation in window units) -> [...].

    Quadratic below ``beta``, which is about one pixel of the network's image in either unit.
    """
    return torch.nn.functional.smooth_l1_loss(predicted, true, beta=beta, reduction="none").sum(-1)


def height(predicted: Tensor, true: Tensor, beta: Tensor) -> Tensor:
    """Smooth L1 between heights in window units, elementwise; quadratic below ``beta`` (Girshick 2015).

    Args:
        predicted, true: of one shape.
        beta: above 0, broadcast against them: about half the spacing of the hypotheses, or finer sweeps would be
            taught to be no better than coarse ones.
    """
    error = (predicted - true).abs()
    return torch.where(error < beta, error.square() / (2 * beta), error - beta / 2)


def hypotheses(logits: Tensor, heights: Tensor, true: Tensor) -> Tensor:
    """Cross-entropy of the hypotheses' probabilities; the two heights around the truth share the right answer.

    Args:
        logits, heights: [B, D, ...], evenly spaced along D.
        true: [B, ...]; beyond the first or last height that one is right.

    Returns:
        [B, ...], nats.
    """
    step = heights[:, 1] - heights[:, 0]
    place = ((true - heights[:, 0]) / step).clamp(0, heights.shape[1] - 1)
    index = torch.arange(heights.shape[1], device=logits.device).reshape(-1, *[1] * (true.ndim - 1))
    share = (1 - (index - place[:, None]).abs()).clamp(min=0)
    return -(share * logits.log_softmax(1)).sum(1)


def sigma(log_sigma: Tensor, error: Tensor) -> Tensor:
    """Negative log-likelihood of absolute errors under a Laplace distribution of expected error exp(log_sigma)."""
    return log_sigma + error.abs() * (-log_sigma).exp()


def confidence(logits: Tensor, right: Tensor) -> Tensor:
    """Binary cross-entropy of the probability that a point is right (``right`` bool), elementwise."""
    return torch.nn.functional.binary_cross_entropy_with_logits(logits, right.to(logits.dtype), reduction="none")


def adversarial(generated: Tensor) -> Tensor:
    """The generator's non-saturating loss -log D(G) (Goodfellow et al. 2014) from logits [B] -> [B]."""
    return torch.nn.functional.softplus(-generated)


def adversarial_eq1(generated: Tensor) -> Tensor:
    """The generator's share of the paper's Eq. 1, log(1 - D(G)), from logits [B] -> [B]; nearly flat while D wins."""
    return -torch.nn.functional.softplus(generated)


def discriminator(real: Tensor, generated: Tensor) -> Tensor:
    """What the discriminator minimises, half the negative of Eq. 1, from logits [B] -> [B].

    (-log D(real) - log(1 - D(G))) / 2 is its cross-entropy per cloud; log 2 = 0.693 if it cannot tell them apart.
    """
    return (torch.nn.functional.softplus(-real) + torch.nn.functional.softplus(generated)) / 2


def _check(predicted: Tensor, target: Tensor) -> None:
    shapes = f"{tuple(predicted.shape)} and {tuple(target.shape)}"
    if predicted.ndim != 3 or target.ndim != 3 or predicted.shape[::2] != target.shape[::2]:
        raise ValueError(f"Two batches of clouds [B, N, 3] and [B, M, 3] are compared, not {shapes}.")
    if not predicted.shape[1] or not target.shape[1]:
        raise ValueError(f"An empty cloud has no distance to another: the shapes are {shapes}.")
    if not (torch.isfinite(predicted).all() and torch.isfinite(target).all()):
        raise ValueError("A cloud holds NaN or infinite coordinates: the training has diverged or its input is broken.")


def _numpy(points: Tensor) -> np.ndarray:
    return points.detach().cpu().double().numpy()


def _neighbours(predicted: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index of the nearest point: of each predicted point in the target [N], and the reverse [M]."""
    return np.asarray(cKDTree(target).query(predicted)[1]), np.asarray(cKDTree(predicted).query(target)[1])


def _index(rows: list[np.ndarray], like: Tensor) -> Tensor:
    """[B, N] indices on the device of ``like``."""
    return torch.from_numpy(np.stack(rows).astype(np.int64)).to(like.device) if rows else like.new_zeros(0, 1).long()


def _gather(points: Tensor, index: Tensor) -> Tensor:
    """Points [B, N, 3] at indices [B, M] -> [B, M, 3]."""
    return points.gather(1, index[..., None].expand(-1, -1, points.shape[-1]))
