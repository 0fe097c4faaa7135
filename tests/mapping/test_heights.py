"""Heights of the products above the ellipsoid, above the sea, or as ground control has them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio
from test_map import GROUND, ORIGIN, make_flight, mapped

from conftest import bar
from overfly.cloud import read_cloud
from overfly.errors import InputError
from overfly.flights import ControlPoint, read_flight
from overfly.geodesy import Origin, crs_from_enu
from overfly.mapping.align import align
from overfly.mapping.control import control_crs, control_origin, control_places
from overfly.mapping.controlled import Controlled
from overfly.mapping.map import align_flight
from overfly.mapping.settings import MapSettings
from overfly.metrics.evaluate import evaluate

ELLIPSOIDAL = Origin(46.84, -91.99, 150.0)


@pytest.fixture(autouse=True)
def quick_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("overfly.mapping.pictures._drawn", lambda figure: np.zeros((8, 8, 3), np.uint8))


def test_products_above_the_sea(geoid, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    flight = make_flight(tmp_path / "flight", block={"altitude": 55.0, "origin": ORIGIN})
    plain = mapped(flight, tmp_path / "plain", ply=True)
    sea = mapped(flight, tmp_path / "sea", heights="egm96", ply=True)
    assert (plain["crs"], plain["heights"]) == ("EPSG:32615", "ellipsoidal")
    assert (sea["crs"], sea["heights"]) == ("EPSG:32615+5773", "EPSG:5773")
    assert any("no geoid is applied" in words for words in plain["warnings"])
    assert not any("geoid" in words for words in sea["warnings"])
    level = crs_from_enu([[0, 0, GROUND]], ELLIPSOIDAL)[0, 2] - geoid(-91.99)
    for name in ("cloud.laz", "cloud.ply"):
        cloud = read_cloud(tmp_path / "sea" / name)
        assert (cloud.epsg, cloud.vertical_epsg) == (32615, 5773)
        assert np.abs(cloud.points[:, 2] - level).max() < 0.02
    with rasterio.open(tmp_path / "sea" / "dsm.tif") as dsm:
        heights = dsm.read(1, masked=True)
        assert dsm.crs.to_string() == "EPSG:32615+5773" or "EGM96" in dsm.crs.to_wkt()
        assert np.abs(heights.compressed() - level).max() < 0.02
    with (
        rasterio.open(tmp_path / "sea" / "orthophoto.tif") as photo,
        rasterio.open(tmp_path / "plain" / "orthophoto.tif") as other,
    ):
        assert photo.crs == other.crs == "EPSG:32615"
        np.testing.assert_array_equal(photo.read(), other.read())  # the painter goes back to the cameras' frame
    found = evaluate(tmp_path / "sea" / "cloud.laz", tmp_path / "plain" / "cloud.laz")
    assert any("differ by up to 100 m" in words for words in found["warnings"])
    assert found["accuracy_median_m"] == pytest.approx(geoid(-91.99), abs=0.05)


def test_without_the_grid_it_is_refused_before_anything_is_computed(no_geoid: None, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="need the geoid grid"):
        MapSettings(dense="stereo", heights="egm96")
    assert MapSettings(dense="stereo", heights="ellipsoidal").heights == "ellipsoidal"


def test_cameras_whose_origin_asks_for_heights_are_refused_without_the_grid(no_geoid: None, tmp_path: Path) -> None:
    flight = make_flight(tmp_path / "flight", block={"altitude": 55.0, "origin": {**ORIGIN, "vertical_epsg": 5773}})
    with pytest.raises(InputError, match="need the geoid grid"):
        mapped(flight, tmp_path / "out")
    assert not list((tmp_path / "out" / "work").glob("dense-*"))
    align_flight(flight, out=tmp_path / "out", dense="stereo", progress=False)  # without products none is needed
    assert mapped(flight, tmp_path / "out", heights="ellipsoidal")["crs"] == "EPSG:32615"


def test_other_heights_reuse_the_steps_and_leave_nothing_of_the_ones_before(geoid, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    flight, out = make_flight(tmp_path / "flight", block={"altitude": 55.0, "origin": ORIGIN}), tmp_path / "out"
    mapped(flight, out, ply=True)
    sea = mapped(flight, out, heights="egm96")
    assert (sea["reused"], sea["crs"]) == (["cameras", "dense"], "EPSG:32615+5773")
    assert not (out / "cloud.ply").exists()
    assert read_cloud(out / "cloud.laz").vertical_epsg == 5773


@pytest.mark.parametrize(
    ("cameras", "advice"),
    [
        ("given", "cameras of transforms.json do not tell: give ground control"),
        ("estimate", "does not tell: give GPS in"),
    ],
)
def test_a_flight_without_a_place_on_the_earth_has_no_such_heights(  # type: ignore[no-untyped-def]
    geoid, cameras: str, advice: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("overfly.mapping.map.estimated_block", lambda *_: pytest.fail("the long step began"))
    with pytest.raises(InputError, match=f"needs a place on the Earth, which .*{advice}"):
        mapped(make_flight(tmp_path / "flight"), tmp_path / "out", heights="egm96", cameras=cameras)


def points(crs: str, height: float) -> list[ControlPoint]:
    places = crs_from_enu([[0, 0, 0], [50, 0, 0], [0, 50, 0]], ELLIPSOIDAL)[:, :2]
    return [ControlPoint(f"p{i}", (x, y, height), crs, {}) for i, (x, y) in enumerate(places)]


def test_heights_of_ground_control_go_through_the_geoid_if_their_crs_says_so(geoid) -> None:  # type: ignore[no-untyped-def]
    flat, sea = control_origin(points("EPSG:32615", 110.0)), control_origin(points("EPSG:32615+5773", 110.0))
    assert flat is not None
    assert sea is not None
    assert (flat.height, flat.epsg, flat.vertical_epsg) == (110.0, 32615, None)
    assert (sea.epsg, sea.vertical_epsg) == (32615, 5773)
    assert sea.height == pytest.approx(110.0 + geoid(-91.99), abs=1e-3)
    assert (sea.latitude, sea.longitude) == pytest.approx((flat.latitude, flat.longitude))


@pytest.mark.parametrize(
    ("crs", "expected"),
    [
        ("EPSG:32615+5773", (32615, 5773)),
        ("EPSG:4326+5773", (32616, 5773)),
        ("EPSG:32615", (32615, None)),
        ("EPSG:4326", (32616, None)),
    ],
)
def test_products_have_the_heights_of_the_controls_that_hold_them(crs: str, expected: tuple[int, int | None]) -> None:
    held = Controlled(SimpleNamespace(), SimpleNamespace(), used=True, crs=control_crs(crs))  # type: ignore[arg-type]
    origin = held.in_their_crs(replace(ELLIPSOIDAL, epsg=32616, vertical_epsg=3855))
    assert (origin.epsg, origin.vertical_epsg) == expected
    unused = replace(held, used=False)
    assert unused.in_their_crs(ELLIPSOIDAL) == ELLIPSOIDAL


def test_ground_control_above_the_sea_needs_the_grid_before_the_long_steps(no_geoid: None, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="need the geoid grid us_nga_egm96_15"):
        control_origin(points("EPSG:32615+5773", 110.0))
    flight = replace(read_flight(make_flight(tmp_path / "flight")), gcps=points("EPSG:32615+5773", 110.0))
    with pytest.raises(InputError, match="need the geoid grid us_nga_egm96_15"):
        align(flight, workdir=tmp_path / "work", seed=0, bar=bar)
    assert not (tmp_path / "work").exists()


def test_the_way_through_the_geoid_is_found_once_for_all_controls(geoid, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
    asked: list[str] = []
    monkeypatch.setattr("overfly.mapping.control.vertical_crs", asked.append)
    control_places(points("EPSG:32615+5773", 110.0))
    assert asked == ["5773"]


def test_controls_that_do_not_say_what_their_heights_refer_to_cannot_be_moved(geoid) -> None:  # type: ignore[no-untyped-def]
    from overfly.mapping.heights import heights_of, with_heights

    survey = SimpleNamespace(sigma_m=(0.1, 0.1))
    block = SimpleNamespace(origin=replace(ELLIPSOIDAL, epsg=32615), metric=True, survey=survey)
    assert heights_of(block) == "controls"  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"write EPSG:32615\+5773"):
        with_heights(block, "egm96")  # type: ignore[arg-type]
