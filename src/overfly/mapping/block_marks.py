"""What a picture of the block shows beside cameras and footprints: how they hang together and what holds them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from overfly.geometry import Array
from overfly.mapping.block import Block
from overfly.mapping.survey import Survey

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LONGEST = 0.06
"""Length of the longest residual in the picture, as a share of the block's size."""

FACTORS = tuple(m * 10**k for k in range(-1, 5) for m in (1, 2, 5))


@dataclass(frozen=True, eq=False)
class Marks:
    """Links of images i < j with their number of common points; GPS residuals [n, 2], NaN where there is no GPS, and
    standard deviations [n, 2] of the positions, or None; ground control."""

    links: Sequence[tuple[int, int, int]] = ()
    gps: Array | None = None
    sigmas: Array | None = None
    survey: Survey | None = None


def marks_of(block: Block) -> Marks:
    """The marks of a block."""
    gps = block.gps_residuals()[:, :2]
    positions = None if block.precision is None else block.precision.position_m
    sigmas = None if positions is None else positions[:, :2]
    return Marks(block.links, gps if np.isfinite(gps).any() else None, sigmas, block.survey)


def scale_of(marks: Marks, size: float) -> float:
    """The round factor by which residuals are drawn longer, so that the longest is well seen in a block of a size."""
    lengths = [np.linalg.norm(marks.gps, axis=1)] if marks.gps is not None else []
    if marks.sigmas is not None:
        lengths.append(marks.sigmas.max(1))
    if marks.survey is not None:
        lengths.append(np.array([np.hypot(*p.residual[:2]) for p in marks.survey.points if p.residual is not None]))
    values = np.concatenate(lengths) if lengths else np.zeros(0)
    values = values[np.isfinite(values) & (values > 0)]
    if not len(values):
        return 1.0
    return max((f for f in FACTORS if f * float(np.percentile(values, 90)) <= LONGEST * size), default=FACTORS[0])


def draw_links(axes: Axes, points: Array, links: Sequence[tuple[int, int, int]]) -> None:
    """Lines between images with common points, the darker the more; ``points`` are their positions [n, 2]."""
    from matplotlib.collections import LineCollection

    if not links:
        return
    strength = np.array([count for *_, count in links], float)
    share = np.clip(np.log1p(strength) / np.log1p(np.percentile(strength, 95)), 0.05, 1)
    lines = [points[[i, j]] for i, j, _ in links]
    colours = np.column_stack([np.tile([0.20, 0.36, 0.62], (len(links), 1)), 0.55 * share**2])
    axes.add_collection(LineCollection(lines, colors=colours, linewidths=0.3 + 1.1 * share))


def draw_residuals(axes: Axes, points: Array, marks: Marks, factor: float) -> None:
    """GPS residuals, ellipses of one standard deviation, controls (triangles), checks (circles), residuals ``factor``
    times as long."""
    from matplotlib.collections import EllipseCollection, LineCollection

    if marks.sigmas is not None:
        width, height = 2 * factor * marks.sigmas.T
        axes.add_collection(
            EllipseCollection(
                width, height, np.zeros(len(points)), units="xy", offsets=points, offset_transform=axes.transData,
                facecolors="none", edgecolors="#7b1fa2", linewidths=0.6, alpha=0.7,
            )
        )  # fmt: skip
        axes.plot([], [], "o", mfc="none", color="#7b1fa2", markersize=6, label="1 sigma of a position")
    if marks.gps is not None:
        known = np.isfinite(marks.gps).all(1)
        ends = points[known] + factor * marks.gps[known]
        axes.add_collection(LineCollection(list(np.stack([points[known], ends], 1)), colors="#d9822b", linewidths=1.2))
        axes.plot([], [], "-", color="#d9822b", label="to the GPS position")
    for role, marker, colour in (("control", "^", "#c23030"), ("check", "o", "#1565c0"), ("unused", "x", "#7b8794")):
        chosen = [p for p in marks.survey.points if p.role == role] if marks.survey is not None else []
        if not chosen:
            continue
        places = np.array([p.place[:2] for p in chosen])
        axes.plot(*places.T, marker, color=colour, mfc="white", mew=1.6, markersize=7, label=f"{role} points")
        for point in chosen:
            if point.residual is not None:
                tip = (point.place[0] + factor * point.residual[0], point.place[1] + factor * point.residual[1])
                axes.annotate(
                    "", tip, point.place[:2], arrowprops={"arrowstyle": "-|>", "color": colour, "linewidth": 1.4}
                )
            axes.annotate(
                point.name, point.place[:2], textcoords="offset points", xytext=(6, -9), fontsize=6.5, color=colour
            )
