"""What a check says about flights whose faults are known."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from flown import ALTITUDE, CAMERA, GSD, ORIGIN, SPACING, STEP, grid, write

from overfly import cli
from overfly.errors import InputError
from overfly.flights import Gps, camera_preset, read_flight
from overfly.geodesy import enu_from_geodetic
from overfly.geometry import project
from overfly.preflight.accuracy import sigma_z_m
from overfly.preflight.check import check_flight
from overfly.preflight.coverage import cover
from overfly.preflight.findings import Finding, ranked
from overfly.preflight.gaps import gaps_of
from overfly.preflight.ground import lines_of, place
from overfly.preflight.images import look, look_at_all
from overfly.preflight.positions import position_findings
from overfly.preflight.quality import camera_findings, image_findings
from overfly.preflight.track import off_track


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return write(tmp_path_factory.mktemp("good") / "flight", grid())


@pytest.fixture(scope="module")
def flight(good):
    return read_flight(good)


@pytest.fixture(scope="module")
def looks(flight):
    return look_at_all([f.path for f in flight.frames])


def about(findings, topic):
    return [f for f in findings if f.topic == topic]


def test_a_good_flight_has_no_findings(good):
    found = check_flight(good)
    assert found.findings == []
    assert found.mappable
    facts = found.to_dict()["overlap"]
    assert facts["forward"] == pytest.approx(0.8, abs=0.01)
    assert facts["side"] == pytest.approx(0.6, abs=0.01)
    assert facts["gsd"] == pytest.approx(GSD, rel=1e-3)
    assert facts["seen_by"]["3+"] == 1
    assert facts["measured_altitude_m"] == pytest.approx(ALTITUDE, rel=0.05)
    # The longest base with half of the picture in common is from line to line: one step more shares 48 %.
    assert facts["base_to_height"] == pytest.approx(SPACING / ALTITUDE, rel=0.02)
    assert facts["sigma_z"] == pytest.approx(GSD * 0.3 / (SPACING / ALTITUDE), rel=0.02)


def test_sigma_is_the_normal_case():
    # 100 m over ground, base 50 m, 2 cm per pixel, 0.5 px: 100 / 50 * 0.02 * 0.5.
    assert sigma_z_m(0.02, 0.5, 0.5) == pytest.approx(0.02)
    assert sigma_z_m(0.02, 0.0) == np.inf


def test_views_are_those_of_projected_points(flight, looks):
    placed = place(flight, looks, None)
    seen = cover(placed)
    rng = np.random.default_rng(1)
    rows, columns = rng.integers(0, seen.grid.rows, 300), rng.integers(0, seen.grid.columns, 300)
    points = np.column_stack([seen.grid.centres()[rows, columns], np.zeros(300)])
    counted = np.zeros(300, int)
    for camera, where in zip(placed.cameras, placed.poses, strict=True):
        pixels, _ = project(points, camera, where)
        counted += ((pixels >= 0) & (pixels <= [camera.width, camera.height])).all(1)
    assert (counted == seen.views[rows, columns]).mean() > 0.99


@pytest.mark.parametrize(("lines", "extra"), [((0, 2), 1), ((0, 3), 2), ((0, 1, 4), 2)])
def test_missing_lines_are_found_where_they_were(tmp_path, lines, extra):
    root = write(tmp_path / "flight", grid(lines))
    found = check_flight(root)
    (finding,) = about(found.findings, "gaps")
    (gap,) = found.gaps
    assert f"fly {extra} more line{'s' if extra > 1 else ''} between lines" in str(finding)
    assert (gap.count, gap.between) == (extra, (len(lines) - 1, len(lines)))
    assert gap.spacing == pytest.approx(SPACING, rel=0.03)
    assert min(gap.heading, 180 - gap.heading) < 1
    told = np.array(gap.to_dict(found.placed.origin)["starts_latitude_longitude"])
    east = enu_from_geodetic(np.column_stack([told, np.full(extra, ORIGIN.height)]), ORIGIN)[:, 0]
    expected = (np.array(range(lines[-2] + 1, lines[-1])) - 1) * SPACING
    assert sorted(east) == pytest.approx(expected, abs=0.5)
    assert found.mappable


def test_unseen_ground_inside_the_flight_is_worse_than_a_wide_gap(tmp_path):
    wide, unseen = (
        about(check_flight(write(tmp_path / name, grid(lines))).findings, "gaps")[0]
        for name, lines in (("wide", (0, 2)), ("unseen", (0, 1, 4, 5)))
    )
    assert (wide.level, unseen.level) == ("warn", "bad")
    assert "seen by less than two images" in str(unseen)


def test_without_overlap_no_map_and_exit_code_1(tmp_path, monkeypatch, capsys):
    root = write(tmp_path / "flight", grid((0, 1), count=4, step=50, spacing=66))
    found = check_flight(root)
    assert not found.mappable
    assert found.findings[0].level == "stop"
    assert "photograph every 9 m" in str(found.findings[0])
    monkeypatch.setattr("sys.argv", ["overfly", "check", str(root)])
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    assert stopped.value.code == 1
    assert "cannot give a map" in capsys.readouterr().out


def test_little_forward_overlap_asks_for_denser_images_not_for_lines(tmp_path):
    found = check_flight(write(tmp_path / "flight", grid(step=2.9 * STEP)))
    sentence = str(about(found.findings, "overlap")[0])
    assert sentence == "Images of a line overlap by 42%: photograph every 9 m along the lines for 80%."
    assert found.gaps == []


def test_two_blocks_and_an_image_apart(tmp_path):
    places = np.concatenate([grid((0, 1)), grid((0, 1)) + np.array([0, 140]), [[100, -60]]])
    found = check_flight(write(tmp_path / "flight", places))
    sentences = " ".join(map(str, about(found.findings, "overlap")))
    assert "falls into 2 blocks of 16, 16 images" in sentences
    assert "1 image shares less than 20%" in sentences


def test_height_comes_from_the_shift_of_the_pictures_where_nothing_tells_it(flight, looks):
    silent = replace(flight, frames=[replace(f, relative_altitude=None, gimbal=None) for f in flight.frames])
    placed = place(silent, looks, None)
    assert placed.heights == pytest.approx(ALTITUDE, rel=0.05)
    assert "shift of reduced" in placed.assumed
    assert "look straight down" in placed.assumed
    assert np.median(cover(placed).forward) == pytest.approx(0.8, abs=0.02)
    assert place(silent, looks, 30.0).heights == pytest.approx(30.0, abs=0.01)
    blind = [replace(one, thumbnail=None) for one in looks]
    assert place(silent, blind, None) is None


def test_a_told_altitude_at_odds_with_the_pictures_is_said(flight, looks):
    wrong = replace(flight, frames=[replace(f, relative_altitude=ALTITUDE + 60) for f in flight.frames])
    (finding,) = about(position_findings(wrong, place(wrong, looks, None)), "altitude")
    assert "108 m" in str(finding)
    assert "48 m below" in str(finding)


def moved(frame, east=0.0, up=0.0):
    gps = frame.gps
    return replace(frame, gps=Gps(gps.latitude, gps.longitude + east / 77_400, gps.altitude + up))


def faulty(flight, changes):
    frames = [changes[i](f) if i in changes else f for i, f in enumerate(flight.frames)]
    return list(position_findings(replace(flight, frames=frames), None))


@pytest.mark.parametrize("i", [0, 3, 6, 8, 12, 23])
def test_one_gps_position_15_m_off(flight, i):
    """At a corner of the track (7) an error towards the next line is a possible track and is not told."""
    (finding,) = faulty(flight, {i: lambda f: moved(f, east=15)})
    assert finding.images == (flight.frames[i].name,)
    assert finding.topic == "gps"


@pytest.mark.parametrize("i", [0, 5, 23])
def test_one_altitude_60_m_off(flight, i):
    (finding,) = faulty(flight, {i: lambda f: moved(f, up=60)})
    assert finding.images == (flight.frames[i].name,)
    assert "60 m" in str(finding)


def test_missing_and_stuck_gps(flight):
    (missing,) = faulty(flight, {4: lambda f: replace(f, gps=None)})
    assert missing.images == (flight.frames[4].name,)
    findings = faulty(flight, {5: lambda f: replace(f, gps=flight.frames[4].gps)})
    assert [f.images for f in findings if "exactly the position" in str(f)] == [(flight.frames[5].name,)]
    everywhere = {i: lambda f: replace(f, gps=flight.frames[0].gps) for i in range(len(flight))}
    assert faulty(flight, everywhere)[0].level == "stop"
    nowhere = {i: lambda f: replace(f, gps=None) for i in range(len(flight))}
    assert "no metric scale" in str(faulty(flight, nowhere)[0])


def test_positions_in_the_images_are_no_fault_where_cameras_are_given(flight):
    here = flight.frames[0].gps
    stuck = [replace(f, gps=here) for f in flight.frames]
    jumping = [moved(replace(f, relative_altitude=ALTITUDE + 90 * (i == 5)), up=90 * (i == 9)) for i, f in
               enumerate(flight.frames)]  # fmt: skip
    for frames in (stuck, jumping):
        assert list(position_findings(replace(flight, frames=frames), None))
        assert list(position_findings(replace(flight, frames=frames, cameras_from="transforms.json"), None)) == []


def test_corners_of_the_track_are_no_faults():
    assert off_track(grid()) == pytest.approx(0)


def test_lines_end_at_corners():
    assert [len(line) for line in lines_of(grid())] == [8, 8, 8]
    around = np.radians(np.arange(0, 360, 10))
    assert len(lines_of(100 * np.column_stack([np.sin(around), np.cos(around)]))) == 1


def test_a_hexagon_has_no_lines_to_fly_between(flight, looks):
    placed = place(flight, looks, None)
    around = np.radians(np.arange(0, 360, 60))
    xy = 12 * np.column_stack([np.sin(around), np.cos(around)])
    poses = placed.poses[:6].copy()
    poses[:, :2, 3] = xy
    seen = cover(replace(placed, frames=placed.frames[:6], cameras=placed.cameras[:6], poses=poses))
    assert seen.direction is None
    assert len(seen.side) == 0
    assert gaps_of(seen, xy) == []


def test_gaps_of_a_circle_get_lines_without_numbers(flight, looks):
    placed = place(flight, looks, None)
    around = np.radians(np.arange(0, 360, 15))
    poses = placed.poses.copy()
    poses[:, :2, 3] = 60 * np.column_stack([np.sin(around), np.cos(around)])
    circle = replace(placed, poses=poses)
    (gap,) = gaps_of(cover(circle), poses[:, :2, 3])
    assert gap.between is None
    assert gap.count >= 2
    assert np.linalg.norm(gap.centre) < 5


def test_image_faults_are_named(tmp_path):
    def change(i, image):
        if i == 3:
            return cv2.GaussianBlur(image, (0, 0), 1.5)
        if i == 6:
            return cv2.blur(image, (1, 5))
        if i == 10:
            return np.clip(image.astype(float) * 2.2, 0, 255).astype(np.uint8)
        if i == 14:
            return np.full_like(image, 120)
        return image

    root = write(tmp_path / "flight", grid(), change=change)
    shutil.copy(root / "frame_0018.jpg", root / "zz_copy.jpg")
    (root / "broken.jpg").write_bytes((root / "frame_0001.jpg").read_bytes()[:900])
    found = check_flight(root)
    assert about(found.findings, "blur")[0].images == ("frame_0004.jpg", "frame_0007.jpg")
    exposure = about(found.findings, "exposure")
    assert all(f.images == ("frame_0011.jpg",) for f in exposure)
    assert {f.cause.split()[0] for f in exposure} == {"1", "The"}
    assert about(found.findings, "texture")[0].images == ("frame_0015.jpg",)
    (copies,) = about(found.findings, "duplicates")
    assert len(copies.images) == 1
    assert "broken.jpg" in str(about(found.findings, "files")[0])


@pytest.mark.parametrize(("whole", "level"), [(0, "stop"), (1, "stop"), (2, "bad")])
def test_less_than_two_images_that_can_be_decoded_give_no_map(flight, looks, tmp_path, whole, level):
    absent = look(tmp_path / "absent.jpg")
    some_looks = [one if i < whole else absent for i, one in enumerate(looks)]
    (finding,) = about(image_findings(flight, some_looks, None), "files")
    assert finding.level == level
    assert len(finding.images) == len(flight) - whole


def test_images_of_which_none_can_be_decoded_give_no_map(tmp_path):
    root = write(tmp_path / "flight", grid((0,)))
    for path in root.glob("*.jpg"):
        path.write_bytes(path.read_bytes().replace(b"\xff\xdb", b"\xff\xee"))  # no quantisation tables
    assert not check_flight(root).mappable


@pytest.mark.parametrize(("blank", "level"), [(range(2, 24, 5), "bad"), (range(7, 9), "warn")])
def test_images_without_any_texture_are_told_apart_from_those_with_some(flight, looks, blank, level):
    """Half of a picture without texture is a hole; an image without any is lost, and many of them are the worst."""
    lost = [replace(one, flat=0.97) if i in blank else replace(one, flat=0.6 * (i < 2)) for i, one in enumerate(looks)]
    first, second = about(image_findings(flight, lost, None), "texture")
    assert (first.level, second.level) == (level, "warn")
    assert first.images == tuple(flight.frames[i].name for i in blank)
    assert second.images == tuple(f.name for f in flight.frames[:2])


def test_copies_of_one_image_and_water_give_no_map(tmp_path):
    root = tmp_path / "flight"
    write(root, grid()[:1])
    shutil.copy(root / "frame_0001.jpg", root / "frame_0002.jpg")
    assert not check_flight(root).mappable
    water = write(tmp_path / "water", grid((0,)), change=lambda i, image: np.full_like(image, 90 + i))
    found = check_flight(water)
    assert [f.level for f in about(found.findings, "texture")] == ["stop"]


def test_sharpness_falls_with_blur_and_not_with_content(tmp_path, looks):
    sharp = np.array([one.sharpness for one in looks])
    assert sharp.min() > 0.85 * np.median(sharp)
    assert look(tmp_path / "absent.jpg").error


def test_mixed_cameras_focal_lengths_and_orientation(tmp_path, flight):
    mixed = write(tmp_path / "flight", grid(), model=lambda i: "other" if i == 5 else "synthetic")
    assert about(check_flight(mixed).findings, "cameras")[0].images == ("frame_0006.jpg",)

    def findings(**change):
        return list(camera_findings(replace(flight, frames=[replace(f, **change) for f in flight.frames])))

    (unknown,) = findings(focal_mm=None, focal35_mm=None, focal_px=None)
    assert "not known" in str(unknown)
    expected = camera_preset("p4p", CAMERA.width, CAMERA.height).fx
    assert findings(model="FC6310", focal_mm=8.8, focal_px=expected) == []
    (off,) = findings(model="FC6310", focal_mm=8.8, focal_px=0.92 * expected)
    assert "8%" in str(off)
    assert [f.level for f in findings(orientation=6)] == ["note"]


def test_motion_during_the_exposure():
    class Empty:
        frames: tuple = ()
        skipped: tuple = ()

    (finding,) = image_findings(Empty(), [], 2.0)  # type: ignore[arg-type]
    assert str(finding).endswith("fly at 50% of the speed, or expose 2.0 times shorter.")


def test_findings_are_sentences_worst_first():
    note, stop = Finding("note", "a", "A", "b"), Finding("stop", "a", "C", "d")
    assert ranked([note, stop]) == [stop, note]
    assert str(note) == "A: b."


def test_given_cameras_are_used(tmp_path, good, looks):
    from overfly.flights.transforms import write_transforms

    root = tmp_path / "flight"
    shutil.copytree(good, root)
    frames = [
        replace(f, camera=CAMERA, world_from_camera=p, path=root / f.name)
        for f, p in zip(read_flight(root).frames, place(read_flight(root), looks, 1.0).poses, strict=True)
    ]
    for frame in frames:
        frame.world_from_camera[2, 3] = 500.0
    write_transforms(root / "transforms.json", frames, ORIGIN, {"ground_height": 500.0 - ALTITUDE})
    found = check_flight(root)
    assert "transforms.json" in found.placed.assumed
    assert found.to_dict()["overlap"]["forward"] == pytest.approx(0.8, abs=0.01)


def test_an_altitude_without_use_is_said(flight, looks):
    down = place(flight, looks, None).poses
    frames = [replace(f, camera=CAMERA, world_from_camera=p, gps=None) for f, p in zip(flight.frames, down)]
    facts = {"scale": "unknown", "ground_height": 0.0}
    unscaled = replace(flight, frames=frames, cameras_from="sparse/0", origin=None, facts=facts)
    placed = place(unscaled, looks, 30.0)
    assert placed.heights == pytest.approx(ALTITUDE, abs=0.01)
    assert placed.assumed.endswith(" --altitude is not used, because the scale of these cameras is unknown.")
    assert "--altitude" not in place(unscaled, looks, None).assumed


def test_cameras_that_see_no_ground_are_not_asked_for_their_height(good, flight, monkeypatch):
    up = replace(flight, frames=[replace(f, gimbal=(0.0, 40.0, 0.0)) for f in flight.frames])
    monkeypatch.setattr("overfly.preflight.check.read_flight", lambda folder: up)
    found = check_flight(good)
    assert found.placed is not None
    assert found.seen is None
    (finding,) = about(found.findings, "overlap")
    assert str(finding).startswith("No camera sees the ground, so overlap on level ground cannot be told: ")
    assert not any("--altitude" in str(f) for f in found.findings)
    with pytest.raises(InputError, match="no camera sees the ground"):
        found.picture()


def test_command_writes_json_and_picture(tmp_path, good, monkeypatch, capsys):
    figures, picture = tmp_path / "out" / "check.json", tmp_path / "overlap.png"
    arguments = ["overfly", "check", str(good), "--json", str(figures), "--picture", str(picture)]
    monkeypatch.setattr("sys.argv", arguments)
    with pytest.raises(SystemExit) as done:
        cli.main()
    assert not done.value.code
    assert "This flight can be mapped." in capsys.readouterr().out
    content = json.loads(figures.read_text())
    assert content["mappable"] is True
    assert len(content["files"]) == 24
    assert content["estimate"]["memory_gb"] == pytest.approx(1.64)  # program and network; the images are small
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_picture_that_cannot_be_drawn_is_a_note(tmp_path, monkeypatch, capsys):
    nowhere, picture = write(tmp_path / "flight", grid((0,)), gps=False), tmp_path / "overlap.png"
    monkeypatch.setattr("sys.argv", ["overfly", "check", str(nowhere), "--picture", str(picture)])
    with pytest.raises(SystemExit) as done:
        cli.main()
    said = capsys.readouterr()
    assert not done.value.code
    assert "This flight can be mapped" in said.out
    assert "overlap.png was not written: There is no overlap map without positions" in " ".join(said.err.split())
    assert not picture.exists()


def test_two_processes_see_the_same(flight, looks):
    twice = look_at_all([f.path for f in flight.frames[:3]], processes=2)
    assert [one.digest for one in twice] == [one.digest for one in looks[:3]]
    assert [one.sharpness for one in twice] == [one.sharpness for one in looks[:3]]


def test_bad_values_are_sentences(tmp_path, good):
    with pytest.raises(InputError, match="metres over ground"):
        check_flight(good, altitude=-1)
    with pytest.raises(InputError, match="--processes 0"):
        check_flight(good, processes=0)
    nowhere = write(tmp_path / "flight", grid((0,)), gps=False)
    with pytest.raises(InputError, match="There is no overlap map without positions"):
        check_flight(nowhere).picture()
