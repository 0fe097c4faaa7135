"""The table as one picture: how much every method gains, and how exact it is, along each axis."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from overfly.evaluation.answers import FLAT
from overfly.evaluation.table import ALL, AXES, Row

LINES = (
    ("excess_removed", "share of flat ground's\nChamfer excess removed"),
    ("height_median_m", "median height error, m\n(2 frames or more)"),
)
TITLES = {"overlap": "overlap, %", "altitude": "altitude, m", "path": "flight path"}
COLORS = ("#9a9a9a", "#c2a878", "#8fae8b", "#d1603d", "#4878a8", "#2b2b2b", "#7b5ea7", "#3a9188", "#b8417c")
LOWEST = -1.0
"""Shares below this are drawn at the lower edge."""


def draw(rows: Sequence[Row], path: Path, *, networks: Sequence[str]) -> None:
    """Write the picture: two measures for each group of styles, over overlap, altitude and flight path.

    Args:
        rows: of :func:`overfly.evaluation.table.tabulate`.
        path: the PNG to write.
        networks: names of the clouds that are networks, which are drawn with thicker lines.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    rows = [row for row in rows if not row["cloud"].startswith("floor")]
    groups = [g for g in dict.fromkeys(row["styles"] for row in rows) if g != ALL] or [ALL]
    names = list(dict.fromkeys(row["cloud"] for row in rows))
    several = [axis for axis in AXES if len({row[axis] for row in rows} - {ALL}) > 1] or list(AXES[:1])
    figure = Figure(figsize=(4 * len(several), 2.6 * len(groups) * len(LINES) + 0.8), layout="constrained")
    axes = figure.subplots(len(groups) * len(LINES), len(several), squeeze=False, sharey="row")
    panels = [(metric, title, group) for metric, title in LINES for group in groups]
    for line, (metric, title, group) in enumerate(panels):
        for column, axis_name in enumerate(several):
            axis = axes[line][column]
            places = _places(rows, group, axis_name)
            for number, name in enumerate(names):
                if metric == "excess_removed" and name == FLAT:
                    continue
                color = COLORS[number % len(COLORS)]
                _line(axis, places, name, metric, (number - len(names) / 2) * 0.05, color, name in networks)
            axis.set_xticks(range(len(places)), [str(place) for place in places])
            axis.set_xlim(-0.5, max(len(places), 1) - 0.5)
            axis.grid(alpha=0.3)
            axis.set_title(f"{group} styles", fontsize=9)
            if metric == "excess_removed":
                axis.axhline(0, color=COLORS[0], linewidth=1)
                axis.set_ylim(LOWEST, 1.05)
            else:
                axis.set_yscale("log")
                axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
                axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
                axis.yaxis.set_minor_formatter(NullFormatter())
            if column == 0:
                axis.set_ylabel(title, fontsize=9)
            if line == len(panels) - 1:
                axis.set_xlabel(TITLES[axis_name])
    shown = {label: line for row in axes for a in row for line, label in zip(*a.get_legend_handles_labels())}
    ordered = [name for name in names if name in shown]
    if ordered:
        figure.legend(
            [shown[n] for n in ordered],
            ordered,
            loc="outside lower center",
            ncols=len(several) + (len(several) > 1),
            frameon=False,
        )
    figure.savefig(path, dpi=110)


def _places(rows: Sequence[Row], group: str, axis: str) -> dict[object, dict[str, Row]]:
    """For each value of an axis the rows of all clouds, summed up over the other axes.

    An axis with one value only is summed up by the row over everything.
    """
    found: dict[object, dict[str, Row]] = {}
    for row in rows:
        if row["styles"] == group and row[axis] != ALL and all(row[a] == ALL for a in AXES if a != axis):
            found.setdefault(row[axis], {})[row["cloud"]] = row
    return found or {ALL: {r["cloud"]: r for r in rows if r["styles"] == group and all(r[a] == ALL for a in AXES)}}


def _line(axis, places: dict[object, dict[str, Row]], name: str, metric: str, shift: float, color: str, thick: bool):
    """One method in one panel: a line through its values, with the confidence intervals where there are any."""
    lowest = LOWEST if metric == "excess_removed" else 1e-3
    points = [(i, by_name[name]) for i, by_name in enumerate(places.values()) if metric in by_name.get(name, {})]
    if not points:
        return
    x = [i + shift for i, _ in points]
    y = [max(row[metric], lowest) for _, row in points]
    axis.plot(x, y, color=color, marker="o", markersize=4, linewidth=2.2 if thick else 1.1, label=name)
    for place, (_, row) in zip(x, points, strict=True):
        if f"{metric}_low" in row:
            ends = [max(row[f"{metric}_{end}"], lowest) for end in ("low", "high")]
            axis.plot([place, place], ends, color=color, linewidth=1, alpha=0.6)
