from __future__ import annotations

import csv
import json
from pathlib import Path

from overfly.summary import read_jobs, swept, write_summary


def job(folder: Path, number: int, overrides: list[str], value: float | None, error: str | None = None) -> None:
    place = folder / str(number)
    place.mkdir()
    (place / "job.json").write_text(
        json.dumps(
            {
                "number": number,
                "folder": place.name,
                "overrides": overrides,
                "monitor": "val/chamfer_m2",
                "value": value,
                "status": "failed" if error else "completed",
                "error": error,
            }
        )
    )


def test_the_summary_holds_every_job_and_the_error_of_the_failed_one(tmp_path: Path) -> None:
    for number, altitude in enumerate((100, 200, 10, 300)):
        failed = "InputError: altitude=10 is not possible" if altitude == 10 else None
        value = None if failed else altitude / 10
        job(tmp_path, number, ["stage=gan", f"altitude={altitude}"], value, failed)
    table = write_summary(read_jobs(tmp_path), tmp_path)
    rows = list(csv.DictReader((tmp_path / "summary.csv").read_text().splitlines()))
    assert [row["altitude"] for row in rows] == ["100", "200", "10", "300"]
    assert [row["status"] for row in rows] == ["completed", "completed", "failed", "completed"]
    assert rows[2]["error"] == "InputError: altitude=10 is not possible"
    assert rows[1]["val/chamfer_m2"] == "20.0"
    assert "stage" not in rows[0]
    assert "Failed: `2`: InputError" in table
    assert (tmp_path / "summary.png").stat().st_size > 5000


def test_swept_keys_are_those_that_differ(tmp_path: Path) -> None:
    for number, (a, o) in enumerate(((100, 30), (100, 50), (200, 30))):
        job(tmp_path, number, [f"altitude={a}", f"overlap={o}", "stage=gan"], 1.0)
    assert swept(read_jobs(tmp_path)) == ["altitude", "overlap"]


def test_jobs_are_in_order_of_their_number(tmp_path: Path) -> None:
    for number in (10, 2, 1):
        job(tmp_path, number, ["overlap=30"], 0.0)
    assert [j["number"] for j in read_jobs(tmp_path)] == [1, 2, 10]
