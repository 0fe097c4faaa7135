"""Chamfer distance and EMD beside the plain calls of scipy, in one run on the same points.

    python benchmarks/metrics.py [--points 1000000] [--repeat 3]

Both sides are timed alternately and the best of the repetitions counts, because other programs only ever add time.
Targets: Chamfer of 2 x 1 M points in at most 10 s and 1.2 times a plain pair of cKDTree queries; exact EMD of 1024
points in at most 1.2 times `linear_sum_assignment` on a ready distance matrix.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from overfly.losses import chamfer
from overfly.metrics.functional import chamfer_m2, emd_m


def city(n: int, seed: int) -> np.ndarray:
    """Points on streets and flat roofs of a 400 m town, with 5 cm noise."""
    rng = np.random.default_rng(seed)
    plan = rng.uniform(0, 400, (n, 2))
    heights = np.random.default_rng(0).uniform(3, 25, (14, 14))
    block, within = np.divmod(plan, 30)
    roof = heights[tuple(block.astype(int).T)] * (within > 8).all(1)
    return np.column_stack([plan, roof + rng.normal(0, 0.05, n)])


def plain_chamfer(a: np.ndarray, b: np.ndarray) -> float:
    return float((cKDTree(b).query(a)[0] ** 2).mean() + (cKDTree(a).query(b)[0] ** 2).mean())


def best_of(repeat: int, *calls: Callable[[], float]) -> tuple[list[float], list[float]]:
    """The shortest time of each call, and their values."""
    times, values = [np.inf] * len(calls), [0.0] * len(calls)
    for _ in range(repeat):
        for i, call in enumerate(calls):
            begin = time.perf_counter()
            values[i] = call()
            times[i] = min(times[i], time.perf_counter() - begin)
    return times, values


def report(what: str, repeat: int, ours: Callable[[], float], plain: Callable[[], float], limit: float = 1.2) -> None:
    (mine, theirs), values = best_of(repeat, ours, plain)
    ratio = mine / theirs
    print(
        f"{what:34s} overfly {mine:8.4f} s   plain {theirs:8.4f} s   ratio {ratio:5.2f} "
        f"({'within' if ratio <= limit else 'ABOVE'} {limit:g})   difference {abs(values[0] / values[1] - 1):.0e}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--repeat", type=int, default=3)
    options = parser.parse_args()
    for n in sorted({1024, 16_000, options.points}):
        a, b = city(n, 1), city(n, 2)
        repeat = options.repeat * (10 if n < 100_000 else 1)
        report(f"Chamfer 2 x {n}", repeat, lambda a=a, b=b: chamfer_m2(a, b), lambda a=a, b=b: plain_chamfer(a, b))
    a, b = city(1024, 1), city(1024, 2)
    cost = cdist(a, b)
    report(
        "EMD 1024 (plain: matrix ready)",
        options.repeat * 3,
        lambda: emd_m(a, b),
        lambda: float(cost[linear_sum_assignment(cost)].mean()),
    )
    points = torch.from_numpy(np.stack([city(1024, i) for i in range(40)])).float().view(2, 20, 1024, 3)

    def step(loss: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]) -> float:
        predicted = points[0].clone().requires_grad_()
        value = loss(predicted, points[1]).sum()
        value.backward()
        return float(value.detach())

    def by_cdist(predicted: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        # the default mode of cdist multiplies matrices and is wrong by centimetres at this size
        squared = torch.cdist(predicted, target, compute_mode="donot_use_mm_for_euclid_dist").square()
        return squared.amin(2).mean(1) + squared.amin(1).mean(1)

    report("Chamfer loss 20 x 1024, backward", options.repeat, lambda: step(chamfer), lambda: step(by_cdist), 1.0)


if __name__ == "__main__":
    main()
