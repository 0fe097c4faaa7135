"""A network's surface beside pairs, much as maps take the two: pairs decide where they match, correlation the rest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from overfly.evaluation.answers import Answer, on_grid
from overfly.evaluation.semi_global import one_window, pair_depth, rise, shots
from overfly.mapping.depth_map import Opinion, contradicted
from overfly.mapping.frame_points import WORST_SCORE
from overfly.mapping.stereo import SURE
from overfly.mapping.subpixel import refine

PAIR_STEPS, NETWORK_STEPS = (-1, -0.5, 0, 0.5, 1), (-2, -1, 0, 1, 2)
"""Pixels around each depth that are tried; the network may be off by more than a pair."""


def paired(answer: Answer, batch: Mapping[str, Tensor]) -> Answer:
    """The answer of a network that tells a surface with sigma, corrected by pairs and by correlation.

    Much as :mod:`overfly.mapping.stereo` and :func:`overfly.mapping.frame_points.cleaned` do it for one frame: where
    pairs have matched and all frames correlate there, their refined depth stands unless the network contradicts it;
    else the network's does, refined where it correlates. What the reference image alone sees is laid on what was
    measured around it (:mod:`overfly.mapping.anchor`), with its sigma and confidence; the others stay the network's.

    Args:
        answer: of the network.
        batch: the windows.
    """
    assert answer.sigma is not None
    assert answer.confidence is not None
    heights, sigmas, confidences = [], [], []
    for number in range(len(answer.height)):
        window = one_window(batch, number)
        frames = shots(window)
        said, sigma, sure = (
            maps[number].double().cpu().numpy() for maps in (answer.height, answer.sigma, answer.confidence)
        )
        low, high = (float(x) for x in batch["height_range"][number])
        slope, base = rise(frames[0]), frames[0].world_from_camera[2, 3]
        matched, support = pair_depth(frames, window, (low, high))
        height = said.copy()
        for depth, steps in ((((said - base) / slope).astype(np.float32), NETWORK_STEPS), (matched, PAIR_STEPS)):
            found = refine(frames[0], frames[1:], depth, steps=steps)
            better = found.depth * slope + base
            stands = (found.score >= WORST_SCORE[False]) & (better >= low) & (better <= high)
            if depth is matched:
                stands &= ~contradicted(better - said, support, sigma, sure)
            height[stands] = better[stands]
        # The last of the two, the pairs', is what is measured.
        measured = np.where(stands & (found.score >= SURE) & (support >= 1), found.depth, np.float32(np.nan))
        if answer.views is not None and answer.alone is not None:
            once = answer.views[number].cpu().numpy() < 2
            alone = answer.alone[number].double().cpu().numpy()
            depths = (np.stack([said, alone]) - base) / slope
            word = _opinion(depths, np.abs(sigma / slope), sure, once)
            settled = word.settled(measured, frames[0].camera, frames[0].world_from_camera)
            told = once & ~stands & np.isfinite(settled.depth)
            height[told] = np.clip(settled.depth * slope + base, low, high)[told]
            sigma = np.where(told, settled.sigma * np.abs(slope), sigma)
            sure = np.where(told, settled.confidence, sure)
        heights.append(height)
        sigmas.append(sigma)
        confidences.append(sure)
    surface, spreads, sure_of = (
        torch.from_numpy(np.stack(maps)).to(answer.height) for maps in (heights, sigmas, confidences)
    )
    points = on_grid(surface, batch, answer.points.shape[1])
    return replace(answer, points=points, height=surface, sigma=spreads, confidence=sure_of)


def _opinion(depths: NDArray, sigma: NDArray, confidence: NDArray, once: NDArray) -> Opinion:
    """What maps would keep of a network's word: depths of all frames and of the reference alone [2, H, W]."""
    together, alone, spread, sure = (maps.astype(np.float32) for maps in (*depths, sigma, confidence))
    return Opinion(together, spread, sure, np.where(once, 1, 2).astype(np.uint8), alone)
