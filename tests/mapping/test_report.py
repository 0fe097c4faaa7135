"""The report says what the map is, warns where it should, and holds all its pictures."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from overfly.mapping.cautions import cautions
from overfly.mapping.pictures import png
from overfly.mapping.report import (
    Caution,
    Picture,
    area_text,
    count_text,
    density_text,
    duration,
    length_text,
    verdict,
    write_report,
)


def summary(**changes: Any) -> dict[str, Any]:
    base: dict[str, Any] = {
        "images": 18, "registered": 18, "points": 1_234_567, "measured": 1_234_567, "predicted": 0, "gsd_m": 0.0183,
        "crs": "EPSG:32615", "cameras_from": "estimated", "seconds": {"cameras": 61.0, "dense": 130.5},
        "heights": "EPSG:5773",
        "metric": True, "peak_memory_mb": 2048.0, "warnings": [], "area": 12_345.0, "points_per_area": 100.0,
        "height_range": [1.0, 9.0], "median_sigma": 0.03, "seen_once_share": 0.0, "unmatched_share": 0.0,
        "reprojection_px": 0.61,
        "unregistered": [], "skipped": {}, "gps_rms": {"horizontal_m": 0.4, "vertical_m": 0.2}, "reused": ["cameras"],
    }  # fmt: skip
    return base | changes


class Page(HTMLParser):
    """Tags that are open or missing, and everything that is loaded from elsewhere."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.loads: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)
        self.loads += [v for k, v in attrs if k in ("src", "href") and v and not v.startswith("data:")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def page_of(path: Path) -> Page:
    page = Page()
    page.feed(path.read_text())
    assert page.open == []
    assert page.loads == []
    return page


def write(tmp_path: Path, facts: dict[str, Any], found: list[Caution]) -> Page:
    shot = png(np.zeros((4, 4, 3), np.uint8))
    pictures = [Picture("The map", "From above", "north is up", shot), Picture("The map", "Heights", "", shot)]
    write_report(
        tmp_path / "report.html", title="a <b>flight</b> & more", summary=facts, pictures=pictures, cautions=found,
        settings={"dense": "stereo", "network": None}, written=["cloud.laz"],
    )  # fmt: skip
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
    return page_of(tmp_path / "report.html")


def test_report_is_one_file_with_the_numbers(tmp_path: Path) -> None:
    page = write(tmp_path, summary(), [])
    for words in ("18 of 18", "1.23 ha", "1.8 cm", "EPSG:32615", "0.61 px", "0.40 m", "cloud.laz", "Nothing to warn",
                  "a <b>flight</b> & more", "2.0 GB", "(kept)", "3 min 11 s"):  # fmt: skip
        assert words in page.text, words
    html = (tmp_path / "report.html").read_text()
    assert "<b>flight</b>" not in html  # a folder's name is text, never markup
    assert len(re.findall(r"data:image/png;base64,", html)) == 2


@pytest.mark.parametrize(
    ("heights", "words"),
    [
        ("ellipsoidal", "coordinates in EPSG:32615, ellipsoidal heights"),
        ("EPSG:5773", "coordinates in EPSG:32615, heights in EPSG:5773"),
        ("controls", "coordinates in EPSG:32615, heights as the ground control has them"),
    ],
)
def test_the_report_says_what_heights_refer_to(heights: str, words: str, tmp_path: Path) -> None:
    assert words in write(tmp_path, summary(heights=heights), []).text


def test_unknown_scale_is_said_everywhere(tmp_path: Path) -> None:
    facts = summary(metric=False, crs=None, gps_rms=None, gsd_m=None)
    found = cautions(facts, altitudes={}, has_gps=False)
    assert found[0].what.startswith("Metric scale unknown")
    page = write(tmp_path, facts, found)
    assert "Metric scale unknown" in page.text
    assert "units of unknown length" in page.text
    assert "cm per pixel" not in page.text
    assert " ha" not in page.text


def test_every_caution_has_its_cause() -> None:
    assert cautions(summary(), altitudes={"a": (40.0, 41.0)}, has_gps=True) == []
    cases: dict[str, dict[str, Any]] = {
        "2 of 18 images could not be placed: DJI_7.JPG, DJI_8.JPG": {"unregistered": ["DJI_7.JPG", "DJI_8.JPG"]},
        "1 file was skipped: x.jpg": {"skipped": {"x.jpg": "truncated"}},
        "altitude is wrong": {"height_range": [-70.0, -60.0]},
        "12% of the mapped ground (1 481 m²) is seen by one image": {"seen_once_share": 0.12},
        "41% of the ground that two images or more see has no point": {"unmatched_share": 0.41},
        "10% of the points are predicted": {"points": 100, "predicted": 10},
        "disagree with the images by 9.0 m": {"gps_rms": {"horizontal_m": 9.0, "vertical_m": None}},
        "no place on the Earth": {"crs": None, "cameras_from": "transforms.json"},
        "reprojection error is 2.1 px": {"reprojection_px": 2.1},
        "no geoid is applied": {"heights": "ellipsoidal", "settings": {"heights": None}},
    }
    for words, change in cases.items():
        found = cautions(summary(**change), altitudes={}, has_gps=True)
        assert len(found) == 1, (words, found)
        assert words in found[0].what
        assert found[0].advice
    meant = summary(heights="ellipsoidal", settings={"heights": "ellipsoidal"})
    assert cautions(meant, altitudes={}, has_gps=True) == []
    wrong = cautions(summary(), altitudes={"a": (120.0, 60.0), "b": (118.0, 60.0), "c": (None, 60.0)}, has_gps=True)
    assert "119 m above the mapped ground" in wrong[0].what
    assert str(cautions(summary(), altitudes={}, has_gps=True, from_readers=["one thing"])[0]).strip() == "one thing"


def test_verdict_counts_and_names_what_is_predicted() -> None:
    assert verdict(summary()).startswith(
        "All 18 images were placed and 1.23 ha mapped with 1.23 million points at 1.8 cm"
    )
    text = verdict(summary(registered=17, points=1000, predicted=250))
    assert text.startswith("17 of 18 images")
    assert "25% of the points are predicted" in text


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (duration(3.21), "3.2 s"), (duration(59.6), "60 s"), (duration(185), "3 min 05 s"),
        (duration(7800), "2 h 10 min"),
        (count_text(56_789), "56 789"), (length_text(0.183), "18.3 cm"), (length_text(1.5), "1.50 m"),
        (area_text(9_999), "9 999 m²"), (area_text(2e6), "2.00 km²"),
        (density_text(0.407), "0.41"), (density_text(1234.5), "1 234"),
    ],
)  # fmt: skip
def test_numbers_for_people(text: str, expected: str) -> None:
    assert text == expected
