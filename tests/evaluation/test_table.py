"""The table by hand values: cells, summaries, intervals, and the picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from overfly.evaluation.answers import FLAT, FLOOR
from overfly.evaluation.chart import draw
from overfly.evaluation.table import tabulate, write_table


def window(scene: int, chamfer: float, **changes: Any) -> dict[str, Any]:
    clouds = {
        name: {"chamfer_sum_1024": (value, 1.0), "chamfer_m2": (value * 10, 1.0), "height_median_m": (0.5, 1.0)}
        for name, value in ((FLAT, 10.0), (FLOOR, 2.0), ("network", chamfer))
    }
    cell = {"split": "seen", "overlap": 30, "altitude": 100, "path": "grid"}
    return {"scene": scene, "clouds": clouds, "calibration": {}, **cell, **changes}


def of(rows: list[dict[str, Any]], **wanted: Any) -> list[dict[str, Any]]:
    return [row for row in rows if all(row[key] == value for key, value in wanted.items())]


def test_cells_and_summaries_hold_the_means_of_their_windows() -> None:
    windows = [
        window(scene, chamfer, overlap=overlap, split=split)
        for scene, (overlap, split, chamfer) in enumerate(
            [(30, "seen", 4.0), (30, "unseen", 8.0), (50, "seen", 2.0), (50, "unseen", 6.0)]
        )
    ]
    rows = of(tabulate(windows, draws=10, seed=0), cloud="network")
    found = {(r["styles"], r["overlap"]): r["chamfer_sum_1024"] for r in rows}
    assert found == {
        ("all", "all"): 5, ("seen", "all"): 3, ("unseen", "all"): 7, ("all", 30): 6, ("all", 50): 4,
        ("seen", 30): 4, ("seen", 50): 2, ("unseen", 30): 8, ("unseen", 50): 6,
    }  # fmt: skip
    assert rows[0]["excess_removed"] == pytest.approx(1 - (5 - 2) / (10 - 2))
    assert (rows[0]["windows"], rows[0]["scenes"]) == (4, 4)
    every = tabulate(windows, draws=10, seed=0)
    assert {r["excess_removed"] for r in of(every, cloud=FLAT)} == {0}
    assert {r["excess_removed"] for r in of(every, cloud=FLOOR)} == {1}


def test_axes_with_one_value_and_single_groups_are_not_repeated() -> None:
    rows = tabulate([window(0, 3.0), window(1, 5.0)], draws=10, seed=0)
    assert [(r["styles"], r["overlap"], r["cloud"]) for r in rows] == [
        ("seen", "all", name) for name in (FLAT, FLOOR, "network")
    ]


def test_values_weigh_as_they_say_and_what_nobody_measured_is_left_out() -> None:
    windows = [window(0, 3.0), window(1, 3.0), window(2, 3.0)]
    for part, pair in zip(windows, [(0.9, 30.0), (0.5, 10.0)]):
        part["clouds"]["network"]["match_top1"] = pair
    row = of(tabulate(windows, draws=50, seed=0), cloud="network")[0]
    assert row["match_top1"] == pytest.approx((27 + 5) / 40)
    assert 0.5 <= row["match_top1_low"] <= row["match_top1"] <= row["match_top1_high"] <= 0.9
    assert "retrieval_top1" not in row
    assert "match_top1" not in of(tabulate(windows, draws=50, seed=0), cloud=FLAT)[0]


def test_intervals_are_drawn_over_scenes_not_over_windows() -> None:
    rng = np.random.default_rng(0)
    level = rng.normal(5, 1, 20)
    windows = [window(scene, level[scene] + 0.01 * rng.normal()) for scene in range(20) for _ in range(50)]
    row = of(tabulate(windows, draws=2000, seed=0), cloud="network")[0]
    half = (row["chamfer_sum_1024_high"] - row["chamfer_sum_1024_low"]) / 2
    assert half == pytest.approx(1.96 * level.std() / np.sqrt(20), rel=0.15)
    again = of(tabulate(windows, draws=2000, seed=0), cloud="network")[0]
    assert again == row
    two = of(tabulate([window(0, 3.0), window(1, 5.0)], draws=10, seed=0), cloud="network")[0]
    assert "chamfer_sum_1024_low" not in two


def test_calibration_is_the_mean_gap_over_the_bins() -> None:
    bins = [[0.0, 0.0, 0.0] for _ in range(10)]
    bins[2], bins[9] = [30.0, 7.5, 15.0], [10.0, 9.5, 9.0]  # 0.25 stated, 0.5 right; 0.95 stated, 0.9 right
    windows = [window(scene, 3.0, calibration={"network": bins}) for scene in range(3)]
    rows = tabulate(windows, draws=10, seed=0)
    assert of(rows, cloud="network")[0]["calibration_error"] == pytest.approx((7.5 + 0.5) / 40)
    assert "calibration_error" not in of(rows, cloud=FLAT)[0]


def test_files_for_people_and_programs(tmp_path: Path) -> None:
    windows = [
        window(scene, 3.0 + scene % 3, overlap=(30, 50)[scene % 2], split=("seen", "unseen")[scene // 4])
        for scene in range(8)
    ]
    rows = tabulate(windows, draws=20, seed=0)
    write_table(rows, tmp_path)
    draw(rows, tmp_path / "evaluation.png", networks=["network"])
    lines = (tmp_path / "evaluation.csv").read_text().splitlines()
    assert len(lines) == 1 + len(rows)
    assert "excess_removed_low" in lines[0]
    text = (tmp_path / "evaluation.md").read_text()
    assert text.count("\n| ") == 2 + len(rows)
    assert "| seen | 30 | all | all | network |" in text
    assert (tmp_path / "evaluation.png").stat().st_size > 10_000
