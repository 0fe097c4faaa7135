from __future__ import annotations

from pathlib import Path

from overfly.callbacks import MetricsCsv
from overfly.callbacks.curves import plot_curves
from overfly.tables import markdown, read_rows, write_rows


def test_one_line_an_epoch_holds_the_metrics_of_training_and_validation(tmp_path: Path) -> None:
    logger = MetricsCsv(folder=tmp_path)
    logger.log_metrics({"train/loss": 2.0, "epoch": 0}, step=3)
    logger.log_metrics({"val/loss": 1.5, "epoch": 0}, step=3)
    logger.log_metrics({"train/loss": 1.0, "epoch": 1}, step=6)
    assert read_rows(tmp_path / "metrics.csv") == [
        {"epoch": 0.0, "train/loss": 2.0, "val/loss": 1.5},
        {"epoch": 1.0, "train/loss": 1.0},
    ]


def test_a_resumed_run_goes_on_in_the_same_file(tmp_path: Path) -> None:
    first = MetricsCsv(folder=tmp_path)
    for epoch in range(3):
        first.log_metrics({"train/loss": 3.0 - epoch, "epoch": epoch})
    again = MetricsCsv(folder=tmp_path)
    again.log_metrics({"train/loss": 0.9, "epoch": 2})  # the killed epoch is trained again
    again.log_metrics({"train/loss": 0.5, "epoch": 3})
    assert [row["train/loss"] for row in read_rows(tmp_path / "metrics.csv")] == [3.0, 2.0, 0.9, 0.5]


def test_missing_metrics_file_has_no_rows(tmp_path: Path) -> None:
    assert read_rows(tmp_path / "metrics.csv") == []


def test_curves_are_drawn_for_every_stage(tmp_path: Path) -> None:
    rows = [{"epoch": float(e), "train/loss": 1 / (e + 1), "val/loss": 1.1 / (e + 1)} for e in range(4)]
    with_accuracy = [{**row, "val/accuracy": 0.1 * row["epoch"], "val/chamfer_m2": 3.0} for row in rows]
    plot_curves({"encoder": rows}, tmp_path / "one.png")
    plot_curves({"encoder": rows, "gan": with_accuracy}, tmp_path / "two.png")
    from PIL import Image

    with Image.open(tmp_path / "one.png") as one, Image.open(tmp_path / "two.png") as two:
        assert two.height > 1.8 * one.height
        assert one.width == two.width


def test_markdown_shows_missing_values_as_a_dash() -> None:
    table = markdown([{"a": 1.23456, "b": None}, {"a": 2.0}])
    assert table == "| a | b |\n| --- | --- |\n| 1.235 | - |\n| 2 | - |\n"


def test_rows_with_different_columns_share_one_header(tmp_path: Path) -> None:
    write_rows(tmp_path / "t.csv", [{"a": 1}, {"b": 2}])
    assert (tmp_path / "t.csv").read_text().splitlines() == ["a,b", "1,", ",2"]
