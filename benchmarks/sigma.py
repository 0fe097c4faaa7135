"""Fits the standard deviation that points state (``overfly.mapping.point_sigma``) and tells how well it holds.

    python benchmarks/sigma.py --work outputs/sigma

Twelve rendered flights of all styles and paths, 80 to 300 m high, with exact cameras are measured as ``overfly map``
does. Of every point of the cloud it is kept what its standard deviation is made from, and its error: in height where
the surface at the nearest place rises less than 60 degrees; else, of predicted points, the distance to it. Constants
are fitted to the 68.3 % quantile of the logarithm of errors (pinball loss); the table tells what share of each
flight's points lies within one and two standard deviations by the constants in the source, and by constants that were
fitted to the eleven other flights. What is in --work is kept: a second call only fits (those of moved points
follow the power in the source: put the new one in and call again).
"""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from truth.case import CELLS, STEEP, Case

from overfly.mapping import point_sigma as source
from overfly.mapping.depth_map import ONE_SIGMA
from overfly.mapping.map import DENSE_FORM, measure_flight
from overfly.mapping.walls import CONFIDENCE
from overfly.shipped import load_network
from overfly.tables import markdown

CELLS |= {"double_grid-50": ("double_grid", 50), "random-50": ("random", 50)}
FLIGHTS = (
    ("campus", "grid-50", 300), ("campus", "circular-80", 120), ("blocks", "grid-30", 80), ("blocks", "random-50", 120),
    ("suburb", "grid-50", 200), ("suburb", "circular-50", 100), ("village", "grid-80", 80), ("village", "grid-30", 150),
    ("industrial", "circular-50", 250), ("industrial", "double_grid-50", 120), ("vegetation", "grid-50", 100),
    ("vegetation", "grid-80", 200),
)  # fmt: skip
DRAWN = 120_000
"""Points of a cloud."""

Facts = dict[str, NDArray]


def facts_of(case: Case, network: Any) -> Facts:
    """Of points of a flight's cloud: everything that ``point_sigmas`` is given, and their errors."""
    kept = case.folder / f"sigma-{DENSE_FORM}.npz"
    if kept.is_file():
        return dict(np.load(kept))
    given: list[Facts] = []

    def numbered(rough, agree, score, confidence, word, depth, focal, *, second, alone, once):  # type: ignore[no-untyped-def]
        """In place of standard deviations the points' numbers, by which they are found again in the cloud."""
        arrays = {"rough": rough, "agree": agree, "score": score, "confidence": confidence, "word": word}
        masks = {"second": second, "alone": alone, "once": once}
        given.append({**arrays, **masks, "depth": depth, "focal": np.full(len(depth), focal)})
        before = sum(len(part["depth"]) for part in given[:-1])
        assert before + len(depth) < 2**24  # of which float32 holds every number
        return np.arange(before, before + len(depth), dtype=np.float32)

    module = importlib.import_module("overfly.mapping.frame_points")
    as_it_is = module.point_sigmas
    module.point_sigmas = numbered  # type: ignore[attr-defined]
    try:
        _, _, tiles = measure_flight(
            case.flight.root, out=case.folder / "map", cameras="given", resume=False, network=network,
            network_name="shipped", progress=False,
        )  # fmt: skip
    finally:
        module.point_sigmas = as_it_is  # type: ignore[attr-defined]
    points, numbers = [], []
    for cloud in tiles:
        assert cloud.sigma_m is not None
        assert cloud.confidence is not None
        assert cloud.predicted is not None
        wall = cloud.predicted & (cloud.confidence == np.float32(CONFIDENCE))
        points.append(cloud.points[~wall])
        numbers.append(cloud.sigma_m[~wall].astype(np.intp))
    chosen = np.random.default_rng(0).permutation(sum(map(len, points)))[:DRAWN]
    number = np.concatenate(numbers)[chosen]
    near = case.surface.nearest(np.concatenate(points)[chosen])
    facts = {name: np.concatenate([part[name] for part in given])[number] for name in given[0]}
    level = near.upward > STEEP
    facts |= {"level": level, "error": np.where(level, np.abs(near.rise), near.distance)}
    np.savez(kept, **facts)
    return facts


def surface_term(facts: Facts) -> NDArray:
    return np.log(source.SMOOTHEST + np.clip(facts["rough"], 0, source.ROUGHEST))


def matched(facts: Facts) -> tuple[NDArray, NDArray, list[NDArray]]:
    """Which points, the logarithm of the unit of their errors, and the terms of the logarithm of sigma."""
    unit = np.log(facts["depth"] / facts["focal"])
    return ~facts["second"] & facts["level"], unit, [surface_term(facts), facts["agree"] == 0, facts["score"]]


def moved(facts: Facts) -> tuple[NDArray, NDArray, list[NDArray]]:
    unit = np.log(facts["depth"] / facts["focal"]) + source.ROUGHNESS_POWER * surface_term(facts)
    return facts["second"] & ~facts["alone"] & facts["level"], unit, [facts["confidence"]]


def carried_on(facts: Facts) -> tuple[NDArray, NDArray, list[NDArray]]:
    doubt = np.log(1 - np.minimum(facts["confidence"], source.SUREST))
    return facts["alone"] & facts["once"], np.log(facts["depth"]), [doubt]


CLASSES = {
    "matched": (matched, "MATCHED, ROUGHNESS_POWER, CONFIRMED_BY_NONE, CORRELATED"),
    "moved": (moved, "MOVED, MOVED_SURE"),
    "carried on": (carried_on, "log CARRIED_ON, DOUBT_POWER"),
}
FEWEST, FITTED = 150, 6000
"""Points of a class that a flight must have to count, and so many of each are fitted to."""


def terms(facts: Facts, which: Any) -> tuple[NDArray, NDArray]:
    """Design matrix [n, t] and the logarithm [n] of errors in their unit, of some points of a class."""
    among, unit, columns = which(facts)
    chosen = np.random.default_rng(1).permutation(np.flatnonzero(among))[:FITTED]
    design = np.stack([np.ones(len(chosen)), *(np.asarray(c, float)[chosen] for c in columns)], axis=1)
    return design, np.log(np.clip(np.nan_to_num(facts["error"][chosen], posinf=1e3), 1e-4, 1e3)) - unit[chosen]


def fitted(parts: list[tuple[NDArray, NDArray]], steps: int = 800) -> NDArray:
    """The constants whose linear combination is the quantile of the errors."""
    design, target = (torch.from_numpy(np.concatenate(values)) for values in zip(*parts, strict=True))
    constants = torch.linalg.lstsq(design, target[:, None]).solution[:, 0].clone().requires_grad_()
    optimizer = torch.optim.Adam([constants], lr=0.05)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        over = target - design @ constants
        optimizer.zero_grad()
        torch.maximum(ONE_SIGMA * over, (ONE_SIGMA - 1) * over).mean().backward()
        optimizer.step()
        falling.step()
    return np.asarray(constants.detach().numpy())


def shares(over: NDArray) -> str:
    return f"{(over < 0).mean():.2f} / {(over < np.log(2)).mean():.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("outputs/sigma"))
    options = parser.parse_args()
    network = load_network()
    flights = {}
    for style, cell, altitude in FLIGHTS:
        case = Case(style, cell, float(altitude), options.work)
        flights[case.name] = facts_of(case, network)
        print(case.name, len(flights[case.name]["error"]), flush=True)
    rows = {name: {"flight": name} for name in flights}
    for label, (which, names) in CLASSES.items():
        parts = {name: terms(facts, which) for name, facts in flights.items()}
        parts = {name: part for name, part in parts.items() if len(part[1]) >= FEWEST}
        if len(parts) < 2:
            continue
        print(f"{names} = {', '.join(f'{c:.3f}' for c in fitted(list(parts.values())))}")
        for name, (design, target) in parts.items():
            others = fitted([part for other, part in parts.items() if other != name])
            rows[name][f"{label}: fitted to the others"] = shares(target - design @ others)
    for name, facts in flights.items():
        sigma = source.point_sigmas(
            **{key: facts[key] for key in ("rough", "agree", "score", "confidence", "word", "depth", "focal")},
            **{key: facts[key] for key in ("second", "alone", "once")},
        )  # fmt: skip
        over = np.log(np.maximum(facts["error"], 1e-4)) - np.log(sigma)
        for label, among in (("matched", ~facts["second"] & facts["level"]), ("predicted", facts["alone"])):
            rows[name][f"{label}, within 1 / 2 sigma"] = shares(over[among])
    print(markdown(list(rows.values())))


if __name__ == "__main__":
    main()
