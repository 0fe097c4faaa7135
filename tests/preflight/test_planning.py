"""Plans fly what was asked, and their files say the same."""

from __future__ import annotations

import csv
import json
from xml.etree import ElementTree

import numpy as np
import pytest
import shapely

from overfly import cli
from overfly.errors import InputError
from overfly.flights import camera_preset
from overfly.geodesy import Origin, enu_from_geodetic
from overfly.preflight.area import read_area
from overfly.preflight.plan import LOOKED_AT, plan_area
from overfly.preflight.waypoints import LITCHI_COLUMNS, MOST_WAYPOINTS, Waypoint, write_litchi

KML = "{http://www.opengis.net/kml/2.2}"
ZURICH = Origin(47.37, 8.54)
CORNERS = [[8.0, 46.0], [8.004, 46.001], [8.003, 46.0025], [8.0015, 46.002], [8.0, 46.0]]


def test_height_is_that_of_the_ground_sampling_distance():
    planned = plan_area("300x200", camera="p4p", gsd_cm=2.5)
    assert planned.plan.gsd_m == pytest.approx(0.025)
    assert planned.plan.altitude == pytest.approx(0.025 * camera_preset("p4p").fx)
    assert plan_area("300x200", camera="p4p", altitude=80).plan.altitude == 80


@pytest.mark.parametrize("path", ["grid", "double_grid", "circular"])
def test_the_whole_area_is_seen_three_times(path):
    planned = plan_area("260x180", camera="mavic3e", altitude=70, path=path)
    assert planned.shares is not None
    assert planned.shares[2] > 0.99
    assert planned.remarks() == []


def test_overlaps_sigma_and_lines_of_a_grid():
    planned = plan_area("300x200", camera="p4p", gsd_cm=3)
    seen, camera = planned.seen, planned.plan.camera
    assert np.median(seen.forward) == pytest.approx(0.8, abs=0.005)
    assert np.median(seen.side) == pytest.approx(0.6, abs=0.005)
    base = planned.plan.line_spacing_m / planned.plan.altitude
    # Maps match images at 1600 pixels, whatever the camera has.
    assert seen.sigma_z_m == pytest.approx(0.3 * 0.03 * camera.width / 1600 / base, rel=0.02)
    # Lines along the longer side, from border to border: 200 m across at 40 % of the width.
    width = 0.03 * camera.width
    assert planned.lines == 1 + np.ceil(200 / (0.4 * width) - 0.1)
    east = planned.plan.world_from_camera[:, 0, 3]
    assert np.ptp(east) >= 300
    assert planned.length_m == pytest.approx(planned.lines * np.ptp(east) + np.ptp(
        planned.plan.world_from_camera[:, 1, 3]), rel=1e-6)  # fmt: skip
    assert planned.seconds == pytest.approx(planned.length_m / planned.speed + 4 * (planned.lines - 1))


def test_a_slanted_polygon_is_flown_along_its_longer_side_and_no_more(tmp_path):
    file = tmp_path / "area.geojson"
    file.write_text(json.dumps({"type": "Feature", "geometry": {"type": "Polygon", "coordinates": [CORNERS]}}))
    planned = plan_area(str(file), camera="mavic2pro", altitude=60)
    assert planned.shares is not None
    assert planned.shares[2] > 0.995
    first = np.diff(planned.plan.world_from_camera[:2, :2, 3], axis=0)[0]
    assert abs(np.degrees(np.arctan2(*first)) % 180 - 70.2) < 3
    positions = shapely.points(planned.plan.world_from_camera[:, :2, 3])
    assert shapely.distance(positions, planned.area.polygon).max() < 60


def test_areas_can_be_given_in_three_ways(tmp_path):
    assert np.ptp(read_area("300x200", None).outline, axis=0).tolist() == [300, 200]
    placed = read_area("47.37,8.54,120,80", None)
    assert placed.origin == ZURICH
    assert placed.polygon.area == pytest.approx(9600)
    assert read_area("300 x 200 m", "47.37,8.54").origin == ZURICH
    kml, geojson = tmp_path / "a.kml", tmp_path / "a.json"
    text = " ".join(f"{lon},{lat},0" for lon, lat in CORNERS)
    kml.write_text(
        '<kml xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark><Polygon><outerBoundaryIs><LinearRing>'
        f"<coordinates>{text}</coordinates></LinearRing></outerBoundaryIs></Polygon></Placemark></Document></kml>"
    )
    polygon = {"type": "MultiPolygon", "coordinates": [[CORNERS]]}
    geojson.write_text(json.dumps({"type": "FeatureCollection", "features": [{"geometry": polygon}]}))
    one, other = read_area(str(kml), None), read_area(str(geojson), None)
    assert one.outline == pytest.approx(other.outline)
    assert one.origin == other.origin
    assert (one.origin.latitude, one.origin.longitude) == pytest.approx((46.00125, 8.002))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"area": "big"}, "is not understood"),
        ({"area": "0x50"}, "sides from 1 to"),
        ({"area": "a,b,c,d"}, "is not understood"),
        ({"area": "nowhere.kml"}, "does not exist"),
        ({"at": "47"}, "is not a place"),
        ({"at": "147,8"}, "are not on the Earth"),
        ({"area": "47,8,100,100", "at": "47,8"}, "leave --at out"),
        ({"camera": "mavic3"}, "did you mean 'mavic3e'"),
        ({"gsd_cm": None}, "Give either --gsd"),
        ({"altitude": 50}, "Give either --gsd"),
        ({"gsd_cm": 0.1}, "give 0.5"),
        ({"overlap": 99}, "overlap"),
        ({"path": "random"}, "circular, double_grid, grid"),
        ({"speed": 100}, "metres a second"),
    ],
)
def test_bad_values_are_sentences(change, sentence):
    with pytest.raises(InputError, match=sentence):
        plan_area(**({"area": "200x200", "camera": "p4p", "gsd_cm": 3} | change))


def test_bad_files_are_sentences(tmp_path):
    for name, text, sentence in (
        ("a.kml", "<kml", "no KML"),
        ("b.kml", "<kml/>", "no polygon"),
        ("a.json", "{", "no GeoJSON"),
        ("b.json", '{"type": "Point", "coordinates": [1, 2]}', "no polygon"),
        ("c.json", '{"type": "Polygon", "coordinates": [[[1, 2], [1, 3]]]}', "less than three corners"),
        ("d.json", '{"type": "Polygon", "coordinates": [[[7, 500], [8, 500], [8, 501]]]}', "not in degrees"),
        ("e.json", '{"type": "Polygon", "coordinates": [[[7, 46], [9, 46], [9, 48]]]}', "km wide"),
        ("f.json", json.dumps({"type": "Polygon", "coordinates": [[CORNERS[i] for i in (0, 2, 1, 3)]]}), "crosses"),
    ):
        (tmp_path / name).write_text(text)
        with pytest.raises(InputError, match=sentence):
            read_area(str(tmp_path / name), None)
    planned = plan_area("100x100", camera="p4p", gsd_cm=3)
    with pytest.raises(InputError, match="give --at"):
        planned.write(tmp_path / "a.kml", None)
    with pytest.raises(InputError, match=r"ends in \.csv"):
        planned.write(None, tmp_path / "a.txt")


def read_litchi(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_files_hold_the_planned_places(tmp_path):
    planned = plan_area("47.37,8.54,160,90", camera="mavic3e", altitude=60)
    kml, litchi = tmp_path / "flight.kml", tmp_path / "flight.csv"
    assert planned.write(kml, litchi) == [kml, litchi]
    poses = planned.plan.world_from_camera
    root = ElementTree.parse(kml).getroot()
    (line,) = root.iter(f"{KML}LineString")
    assert line.find(f"{KML}altitudeMode").text == "relativeToGround"
    told = np.array([[float(v) for v in p.split(",")] for p in line.find(f"{KML}coordinates").text.split()])
    there = enu_from_geodetic(np.column_stack([told[:, 1], told[:, 0], np.zeros(len(told))]), ZURICH)
    assert there[:, :2] == pytest.approx(poses[:, :2, 3], abs=0.01)
    assert told[:, 2] == pytest.approx(60)
    assert len(list(root.iter(f"{KML}Point"))) == len(planned.plan)
    rows = read_litchi(litchi)
    assert len(rows) == len(planned.plan) <= MOST_WAYPOINTS
    assert [float(r["latitude"]) for r in rows] == pytest.approx(told[:, 1].tolist(), abs=1e-7)
    assert {r["actiontype1"] for r in rows} == {"1"}
    assert {r["actiontype2"] for r in rows} == {"-1"}
    assert {(r["altitudemode"], r["gimbalpitchangle"], r["gimbalmode"]) for r in rows} == {("1", "-90", "2")}
    assert {float(r["heading(deg)"]) for r in rows} == {90.0, 270.0}


def test_litchi_has_its_46_columns():
    assert len(LITCHI_COLUMNS) == 46
    text = ",".join(LITCHI_COLUMNS)
    assert text.startswith("latitude,longitude,altitude(m),heading(deg),curvesize(m),rotationdir,gimbalmode,")
    assert "gimbalpitchangle,actiontype1,actionparam1,actiontype2," in text
    assert text.endswith(
        "actionparam15,altitudemode,speed(m/s),poi_latitude,poi_longitude,poi_altitude(m),poi_altitudemode,"
        "photo_timeinterval,photo_distinterval"
    )


def test_long_missions_take_photographs_by_distance(tmp_path):
    planned = plan_area("47.37,8.54,600,400", camera="mavic3e", altitude=60)
    assert len(planned.plan) > MOST_WAYPOINTS
    (file,) = planned.write(None, tmp_path / "long.csv")
    rows = read_litchi(file)
    assert len(rows) == 2 * planned.lines
    assert {r["actiontype1"] for r in rows} == {"-1"}
    intervals = [float(r["photo_distinterval"]) for r in rows]
    assert intervals[::2] == pytest.approx([planned.plan.step_m] * planned.lines, abs=0.01)
    assert set(intervals[1::2]) == {-1}


def test_every_line_of_a_long_mission_is_photographed(tmp_path):
    """Lines of one image take it at their only waypoint, and no cut parts the two ends of a line."""
    counts = [3, 1, *[4] * 48, 1, 1, 2, *[5] * 60]
    points = [
        Waypoint(46 + i * 1e-4, 8 + line * 1e-4, 60, 0, -90, line) for line, n in enumerate(counts) for i in range(n)
    ]
    files = write_litchi(tmp_path / "long.csv", points, speed=5, step_m=12)
    assert [f.name for f in files] == ["long_1.csv", "long_2.csv", "long_3.csv"]
    flown = []
    for file in files:
        rows = read_litchi(file)
        assert len(rows) <= MOST_WAYPOINTS
        lines = [round((float(row["longitude"]) - 8) * 1e4) for row in rows]
        for line in dict.fromkeys(lines):
            own = [(row["actiontype1"], row["photo_distinterval"]) for row, of in zip(rows, lines) if of == line]
            assert own == ([("1", "-1")] if counts[line] == 1 else [("-1", "12.00"), ("-1", "-1")])
            flown.append(line)
    assert flown == list(range(len(counts)))


def test_long_orbits_become_several_missions(tmp_path):
    planned = plan_area("47.37,8.54,300,300", camera="mavic3e", altitude=40, path="circular")
    files = planned.write(None, tmp_path / "round.csv")
    assert [f.name for f in files] == [f"round_{k + 1}.csv" for k in range(len(files))]
    assert len(files) > 1
    assert sum(len(read_litchi(f)) for f in files) == len(planned.plan)
    assert max(len(read_litchi(f)) for f in files) <= MOST_WAYPOINTS


def test_large_plans_do_not_count_every_image():
    planned = plan_area("900x700", camera="p4p", gsd_cm=1.4)
    assert len(planned.plan) > LOOKED_AT
    assert planned.shares is None
    assert f"not counted beyond {LOOKED_AT} photographs" in list(planned.table().columns[1].cells)


def test_command(tmp_path, monkeypatch, capsys):
    kml = tmp_path / "a.kml"
    arguments = ["overfly", "plan", "--area", "500x400", "--camera", "p4p", "--gsd", "3.6", "--at", "46,8"]
    monkeypatch.setattr("sys.argv", [*arguments, "--kml", str(kml)])
    with pytest.raises(SystemExit) as done:
        cli.main()
    assert not done.value.code
    said = capsys.readouterr().out
    assert "expected sigma in height" in said
    assert "in images of at most 1600 px" in " ".join(said.split())
    assert "131 m are above the 120 m" in said
    assert kml.is_file()
    monkeypatch.setattr("sys.argv", [*arguments, "--overlap", "200"])
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    assert stopped.value.code == 2
