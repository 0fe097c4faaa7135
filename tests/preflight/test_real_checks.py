"""Checks of the real image sets: what is known of them is found, and good flights raise no alarm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from overfly.flights import Gps, read_flight
from overfly.geodesy import enu_from_geodetic
from overfly.preflight.check import check_flight
from overfly.preflight.coverage import cover
from overfly.preflight.gaps import gaps_of
from overfly.preflight.ground import place
from overfly.preflight.images import Look, look
from overfly.preflight.positions import position_findings


@pytest.fixture(scope="module")
def brighton(shared_data):
    return check_flight(shared_data("brighton_beach"))


def test_brighton_is_as_its_readme_says(brighton):
    assert brighton.findings == []
    facts = brighton.to_dict()["overlap"]
    assert facts["forward"] == pytest.approx(0.64, abs=0.02)
    assert facts["side"] == pytest.approx(0.61, abs=0.03)
    assert facts["height_over_ground"] == pytest.approx(40, abs=0.5)
    assert facts["lines"] == 3
    # Independent of the barometer: GPS and the shift of the pictures.
    assert facts["measured_altitude_m"] == pytest.approx(40, rel=0.1)
    assert facts["seen_by"]["3+"] > 0.99


def test_the_middle_line_of_brighton_is_missed_where_it_was(brighton):
    """The new line lies within 1.5 m of the one that was really flown."""
    flight = brighton.flight
    kept = [i for i in range(18) if not 6 <= i < 12]
    outer = replace(flight, frames=[flight.frames[i] for i in kept])
    placed = place(outer, [brighton.looks[i] for i in kept], None)
    (gap,) = gaps_of(cover(placed), placed.poses[:, :2, 3])
    assert (gap.count, gap.between) == (1, (1, 2))
    told = [(f.gps.latitude, f.gps.longitude, placed.origin.height) for f in flight.frames[6:12]]
    middle = enu_from_geodetic(told, placed.origin)[:, :2]
    along = (gap.ends[0] - gap.starts[0]) / np.linalg.norm(gap.ends[0] - gap.starts[0])
    away = np.abs((middle - gap.starts[0]) @ [-along[1], along[0]])
    assert away.max() < 1.5


@pytest.mark.parametrize("i", [2, 9, 15])
def test_a_brighton_position_15_m_off_is_named(brighton, i):
    frames = list(brighton.flight.frames)
    gps = frames[i].gps
    frames[i] = replace(frames[i], gps=Gps(gps.latitude + 15 / 111_200, gps.longitude, gps.altitude))
    (finding,) = position_findings(replace(brighton.flight, frames=frames), None)
    assert finding.images == (frames[i].name,)


def test_every_third_image_of_brighton_is_too_few(brighton):
    from overfly.preflight.overlap import overlap_findings

    flight = replace(brighton.flight, frames=brighton.flight.frames[::3])
    placed = place(flight, brighton.looks[::3], None)
    seen = cover(placed)
    first = next(iter(overlap_findings(placed, seen, gaps_of(seen, placed.poses[:, :2, 3]))))
    assert first.level == "bad"
    assert "photograph every 8 m" in str(first)


def test_tampa_has_no_height_and_gets_one_from_its_pictures(shared_data):
    found = check_flight(shared_data("tampa_sheffield_cross"))
    assert found.placed.heights == pytest.approx(62, rel=0.2)  # about 60 m up, looking 16 degrees off straight down
    assert [f.topic for f in found.findings] == ["altitude"]
    assert "below sea level" in str(found.findings[0])
    assert np.median(found.seen.forward) == pytest.approx(0.93, abs=0.04)


@pytest.mark.parametrize("name", ["warsaw_ochota_low", "boruszyn_kap"])
def test_kites_without_gps_are_checked_for_their_images_alone(shared_data, name):
    root = shared_data(name)
    flight = read_flight(root)
    looks = [look(f.path) if i < 4 else Look() for i, f in enumerate(flight.frames)]
    assert place(flight, looks, None) is None
    assert "None of the" in str(next(iter(position_findings(flight, None))))
    assert all(one.flat < 0.3 for one in looks[:4])


def test_cameras_of_a_frame_of_their_own_give_way_to_gps(shared_data, tmp_path):
    root = shared_data("brighton_beach")
    (tmp_path / "images").symlink_to(root / "images")
    (tmp_path / "sparse").symlink_to(root / "reference_colmap")
    flight = read_flight(tmp_path)
    assert flight.cameras_from == "sparse"
    placed = place(flight, [Look()] * len(flight), None)
    assert placed.metric
    assert placed.heights == pytest.approx(40, abs=0.5)
