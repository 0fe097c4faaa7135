"""The table that sets a trained network beside answers without insight and beside the limit of sampling."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from overfly.networks.baselines import NearestWindow, lifted, mean_heights
from overfly.networks.ground import initial_cloud
from overfly.stages.clouds import window_emd, window_metrics
from overfly.tables import markdown, write_rows

Row = dict[str, str | float | int]
Batches = Iterable[Mapping[str, Tensor]]

COLUMNS = (
    "split", "cloud", "chamfer_sum_1024", "emd_sum_1024", "chamfer_m2", "chamfer_m", "height_error_m",
    "fscore_2pct", "windows",
)  # fmt: skip


@torch.no_grad()
def compare(
    network: nn.Module,
    name: str,
    train: Batches,
    splits: Mapping[str, Batches],
    *,
    points: int,
    second_sample: Callable[[str, Mapping[str, Tensor]], Tensor] | None = None,
    emd_windows: int = 40,
) -> list[Row]:
    """Measure a network and the baselines on the same windows.

    Args:
        network: takes a batch, gives ``points`` [B, N, 3] and ``descriptor`` [B, K, D]; put into evaluation mode.
        name: its name in the table.
        train: batches of the training windows, for the baselines.
        splits: batches to measure on, by name (``test``, ``unseen``).
        points: number of points of the baselines' initial cloud.
        second_sample: (split, batch) -> an independent sample of the same surfaces [B, N, 3]; with it the table
            gets the row *sampling floor*.
        emd_windows: windows of each split on which the exact EMD is measured (0.08 s each and row).

    Returns:
        One row for each split and cloud, with the means of :func:`overfly.stages.clouds.window_metrics`.
    """
    network.eval()
    nearest = NearestWindow()
    for batch in train:
        nearest.add(network(batch), batch)
    mean = mean_heights(train, points)
    rows: list[Row] = []
    for split, batches in splits.items():
        found: dict[str, list[dict[str, float]]] = {}
        for batch in batches:
            output, flat = network(batch), initial_cloud(points, batch)
            answers = {
                "flat ground": flat,
                "mean training cloud": lifted(flat, mean),
                "nearest training window": nearest(output),
                name: output["points"],
            }
            if second_sample is not None:
                answers["sampling floor"] = second_sample(split, batch)
            for answer, clouds in answers.items():
                measured = found.setdefault(answer, [])
                measured += _measure(clouds, batch, emd_windows - len(measured))
        rows += [{"split": split, "cloud": answer, **_means(values)} for answer, values in found.items()]
    return [{column: row[column] for column in COLUMNS if column in row} for row in rows]


def write_comparison(rows: list[Row], folder: Path) -> tuple[Path, Path]:
    """Write ``comparison.csv`` and ``comparison.md`` into a folder and return their paths."""
    table, text = folder / "comparison.csv", folder / "comparison.md"
    write_rows(table, rows)
    text.write_text(markdown(rows))
    return table, text


def _measure(clouds: Tensor, batch: Mapping[str, Tensor], emd_windows: int) -> list[dict[str, float]]:
    measured = []
    arrays = (x.cpu().numpy() for x in (clouds, batch["reference"], batch["scale"]))
    for number, (cloud, reference, scale) in enumerate(zip(*arrays, strict=True)):
        row = window_metrics(cloud, reference, float(scale))
        if number < emd_windows and len(cloud) == len(reference):
            row["emd_sum_1024"] = window_emd(cloud, reference)
        measured.append(row)
    return measured


def _means(rows: list[dict[str, float]]) -> Row:
    means: Row = {}
    for key in dict.fromkeys(key for row in rows for key in row):
        values = [row[key] for row in rows if key in row]
        means[key] = sum(values) / len(values)
    means["windows"] = len(rows)
    return means
