"""From measured windows to one table: cells, summaries over each axis, and how sure the numbers are."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from overfly.evaluation.answers import FLAT, FLOOR
from overfly.evaluation.measure import BINS
from overfly.tables import markdown, write_rows

Row = dict[str, Any]
Window = Mapping[str, Any]

AXES = ("overlap", "altitude", "path")
ALL = "all"

METRICS = (
    "chamfer_sum_1024", "chamfer_m2", "emd_sum_1024", "fscore_1pct", "fscore_2pct", "fscore_dense_2pct",
    "height_median_gsd", "height_median_m", "height_mean_m", "height_mean_percent",
    "height_mean_m_1_view", "height_mean_m_2_views", "height_mean_m_3_views",
    "height_mean_percent_1_view", "height_mean_percent_2_views", "height_mean_percent_3_views",
    "area_1_view", "area_2_views", "area_3_views",
    "fscore_once_2pct", "fscore_once_interpolated_2pct", "measured",
    "cameras_placed", "cameras_px", "within_sigma", "within_2sigma",
    "match_top1", "retrieval_top1", "retrieval_verified_top1",
)  # fmt: skip
"""Weighted means over windows; see :mod:`overfly.evaluation.measure`."""

COLUMNS = (
    "chamfer_sum_1024", "chamfer_m2", "excess_removed", *METRICS[2:-3], "calibration_error", *METRICS[-3:],
)  # fmt: skip

SURE = ("chamfer_sum_1024", "excess_removed", "height_median_gsd", "height_median_m", "fscore_dense_2pct")
"""Columns whose intervals are shown to people, too; the CSV has all."""

LEAST_SCENES = 3
"""Fewer scenes than this say nothing about how much scenes differ."""

EXPLANATION = """\
# Evaluation

One row for each cloud in each cell (styles that the networks have seen or not, overlap, altitude, flight path); rows
with `all` summarise. Numbers are means over windows; [low, high] is the 95 % confidence interval of a bootstrap over
scenes (one scene is one flight), given from {least} scenes on; evaluation.csv holds it for every column.

- `NETWORK, with pairs`: its surface, where semi-global pairs do not know better, and correlated in all frames.
- `chamfer_sum_1024`: the paper's Eq. 2 in the frame where the footprint spans [-1, 1]; `chamfer_m2`: both mean squared
  distances added, m²; `excess_removed`: the removed share of flat ground's Chamfer excess over the exact heights.
- `emd_sum_1024`: the paper's Eq. 3, on some of the windows. `fscore_*pct`: of the 1024 points at a percentage of the
  footprint's width; `fscore_dense_2pct`: of the surface of all pixels.
- `height_median_*`: median absolute height error where two frames or more see the place, in ground pixels of the images
  and in metres; `height_mean_*`: mean over all pixels, in metres and in percent of the altitude, and by the number of
  frames that truly see the place (`3_views`: three or more), whose shares of the image are `area_*`.
- `fscore_once_2pct`: F-score of the places that one frame sees alone; `fscore_once_interpolated_2pct`: the same with
  heights interpolated from the method's own answer where more frames see the ground.
- `measured`: share of the pixels that a classical method measured; it fills in the others.
- with `cameras=estimated`, `cameras_placed`: share of a window's frames that were placed (the others are left out);
  `cameras_px`: how far from the truth their poses put what the reference frame sees, pixels (median).
- `within_sigma`, `within_2sigma`: shares of errors below the stated sigma, ideally 0.68 and 0.95;
  `calibration_error`: expected difference between the stated confidence and the share that is right.
- `match_top1`: key points whose match is within 2 px of the truth; `retrieval_top1`: frames whose most similar other
  frame, among all scenes of the group, sees common ground, by descriptor alone; `retrieval_verified_top1`: by the
  correspondences with the nearest of these, each frame seen from above by its own prior pose.

"""


def tabulate(windows: Sequence[Window], *, draws: int, seed: int) -> list[Row]:
    """The rows: first the summaries, then the cells; columns ``<metric>``, ``<metric>_low``, ``<metric>_high``.

    Args:
        windows: as :func:`overfly.evaluation.evaluate.measure` gives them, with their cells.
        draws: of the bootstrap over scenes.
        seed: of the bootstrap; every cloud sees the same draws.
    """
    names = list(dict.fromkeys(name for window in windows for name in window["clouds"]))
    rows = []
    for cell, chosen in _cells(windows):
        rng = np.random.default_rng(seed)
        scenes = np.unique([window["scene"] for window in chosen])
        counts = rng.multinomial(len(scenes), np.full(len(scenes), 1 / len(scenes)), draws).astype(float)
        counts = np.concatenate([np.ones((1, len(scenes))), counts])  # the first draw is the data itself
        found = {name: _drawn(chosen, name, scenes, counts) for name in names}
        _excess(found)
        for name, values in found.items():
            row: Row = {**cell, "cloud": name, "windows": len(chosen), "scenes": len(scenes)}
            for column in COLUMNS:
                row |= _estimate(column, values.get(column), len(scenes))
            rows.append(row)
    return rows


def write_table(rows: list[Row], folder: Path) -> None:
    """Write ``evaluation.csv`` with every column and ``evaluation.md`` for people into a folder."""
    write_rows(folder / "evaluation.csv", rows)
    shown = []
    for row in rows:
        kept = {key: value for key, value in row.items() if not key.endswith(("_low", "_high"))}
        for column in SURE:
            if f"{column}_low" in row:
                kept[column] = f"{row[column]:.3g} [{row[f'{column}_low']:.3g}, {row[f'{column}_high']:.3g}]"
        shown.append(kept)
    columns = [c for c in ("styles", *AXES, "cloud", "windows", "scenes", *COLUMNS) if any(c in row for row in rows)]
    (folder / "evaluation.md").write_text(EXPLANATION.format(least=LEAST_SCENES) + markdown(shown, columns))


def _cells(windows: Sequence[Window]) -> Iterator[tuple[Row, list[Window]]]:
    """Summaries and cells with their windows; a set of windows is listed once, under its first name."""
    splits = list(dict.fromkeys(window["split"] for window in windows))
    groups = [ALL, *splits] if len(splits) > 1 else splits
    values = {axis: sorted({window[axis] for window in windows}, key=_order) for axis in AXES}
    wanted = [{"styles": group} for group in groups]
    wanted += [{"styles": group, axis: value} for group in groups for axis in AXES for value in values[axis]]
    wanted += [
        {"styles": group, "overlap": overlap, "altitude": altitude, "path": path}
        for group in splits
        for overlap in values["overlap"]
        for altitude in values["altitude"]
        for path in values["path"]
    ]
    listed = set()
    for choice in wanted:
        chosen = [
            window
            for window in windows
            if choice["styles"] in (ALL, window["split"])
            and all(window[axis] == choice[axis] for axis in AXES if axis in choice)
        ]
        key = frozenset(id(window) for window in chosen)
        if chosen and key not in listed:
            listed.add(key)
            yield {"styles": choice["styles"], **{axis: choice.get(axis, ALL) for axis in AXES}}, chosen


def _order(value: Any) -> tuple[bool, Any]:
    return isinstance(value, str), value


def _drawn(
    windows: Sequence[Window], name: str, scenes: NDArray, counts: NDArray[np.float64]
) -> dict[str, NDArray[np.float64]]:
    """Each metric of one cloud in every draw [draws + 1]; NaN where a draw holds nothing to judge."""
    place = np.searchsorted(scenes, [window["scene"] for window in windows])
    pairs = np.array([[window["clouds"][name].get(metric, (0.0, 0.0)) for metric in METRICS] for window in windows])
    sums = np.zeros((2, len(scenes), len(METRICS)))  # of weighted values and of weights, by scene
    np.add.at(sums[0], place, pairs[..., 0] * pairs[..., 1])
    np.add.at(sums[1], place, pairs[..., 1])
    values, weights = counts @ sums[0], counts @ sums[1]
    means = np.divide(values, weights, out=np.full_like(values, np.nan), where=weights > 0)
    found = dict(zip(METRICS, means.T, strict=True))
    empty = np.zeros((BINS, 3))
    bins = np.zeros((len(scenes), BINS, 3))
    np.add.at(bins, place, np.array([window["calibration"].get(name, empty) for window in windows]))
    if bins.any():
        number, stated, right = np.moveaxis(np.tensordot(counts, bins, 1), -1, 0)  # each [draws + 1, BINS]
        found["calibration_error"] = np.abs(stated - right).sum(1) / np.maximum(number.sum(1), 1)
    return found


def _excess(found: Mapping[str, dict[str, NDArray[np.float64]]]) -> None:
    """Add the share of flat ground's Chamfer excess over the exact heights that each cloud removes."""
    flat, floor = (found[name]["chamfer_sum_1024"] for name in (FLAT, FLOOR))
    excess = flat - floor
    for values in found.values():
        left = values["chamfer_sum_1024"] - floor
        share = np.divide(left, excess, out=np.full_like(left, np.nan), where=excess > 0)
        values["excess_removed"] = 1 - share


def _estimate(column: str, draws: NDArray[np.float64] | None, scenes: int) -> Row:
    """The value and its interval; nothing where nothing was judged."""
    if draws is None or not np.isfinite(draws[0]):
        return {}
    row: Row = {column: float(draws[0])}
    sure = draws[1:][np.isfinite(draws[1:])]
    if scenes >= LEAST_SCENES and len(sure):
        low, high = np.quantile(sure, [0.025, 0.975])
        row |= {f"{column}_low": float(low), f"{column}_high": float(high)}
    return row
