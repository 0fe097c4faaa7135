"""Image metadata: what is written is read, and odd files are read as what they mean."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from overfly.flights.exif import exif_bytes, read_facts, text, xmp_bytes
from overfly.flights.flight import Gps
from overfly.flights.images import defect, natural_key

TIME = datetime(2024, 5, 6, 7, 8, 9, 500_000)


def save(path: Path, exif: bytes | Image.Exif = b"", xmp: bytes = b"") -> Path:
    pixels = np.random.default_rng(0).integers(0, 255, (40, 60, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path, exif=exif, xmp=xmp)
    return path


def block(gps: Gps | None) -> bytes:
    return exif_bytes(
        make="DJI", model="FC6310", time=TIME, focal_mm=8.8, focal35_mm=24.0, focal_px=40.0, size=(60, 40), gps=gps
    )


def with_gps(tags: dict) -> Image.Exif:
    exif = Image.Exif()
    exif.get_ifd(0x8825).update(tags)
    return exif


@pytest.mark.parametrize("place", [(46.123456789, 8.987654321, 512.25), (-33.5, -70.25, -12.5), (0.0, 12.0, 0.0)])
def test_round_trip(tmp_path, place):
    xmp = xmp_bytes(gimbal=(271.5, -62.25, 1.5), relative_altitude=80.125, absolute_altitude=512.25)
    facts = read_facts(save(tmp_path / "a.jpg", block(Gps(*place)), xmp))
    assert (facts.width, facts.height, facts.make, facts.model) == (60, 40, "DJI", "FC6310")
    assert facts.time == TIME
    assert (facts.focal_mm, facts.focal35_mm) == (8.8, 24.0)
    assert facts.focal_px == pytest.approx(40)
    assert (facts.gps.latitude, facts.gps.longitude) == pytest.approx(place[:2], abs=1e-9)
    assert facts.gps.altitude == pytest.approx(place[2], abs=1e-4)
    assert facts.gimbal == pytest.approx((-88.5, -62.25, 1.5))
    assert facts.relative_altitude == pytest.approx(80.125)
    assert facts.notes == []


def test_no_metadata_at_all(tmp_path):
    for name in ("a.jpg", "b.png", "c.tif"):
        facts = read_facts(save(tmp_path / name))
        assert (facts.width, facts.gps, facts.time, facts.gimbal, facts.make) == (60, None, None, None, None)


def test_metadata_of_png_and_tiff(tmp_path):
    for name in ("b.png", "c.tif"):
        facts = read_facts(save(tmp_path / name, block(Gps(46.5, 8.5, 500.0))))
        assert facts.time == TIME
        assert facts.gps == Gps(pytest.approx(46.5), pytest.approx(8.5), pytest.approx(500.0))


def test_missing_altitude_is_none_and_below_sea_level_is_negative(tmp_path):
    angle = (IFDRational(10, 1), IFDRational(30, 1), IFDRational(0, 1))
    tags = {1: "S", 2: angle, 3: "W", 4: angle}
    assert read_facts(save(tmp_path / "a.jpg", with_gps(tags))).gps == Gps(-10.5, -10.5, None)
    tags |= {5: b"\x01", 6: IFDRational(55, 10)}
    assert read_facts(save(tmp_path / "b.jpg", with_gps(tags))).gps == Gps(-10.5, -10.5, -5.5)
    tags |= {6: IFDRational(0, 0)}
    assert read_facts(save(tmp_path / "c.jpg", with_gps(tags))).gps == Gps(-10.5, -10.5, None)


def test_zero_over_zero_and_zero_zero_are_no_gps(tmp_path):
    nothing, zero = (IFDRational(0, 0),) * 3, (IFDRational(0, 1),) * 3
    for angle, note in ((nothing, "unreadable GPS"), (zero, "GPS 0, 0")):
        facts = read_facts(save(tmp_path / "a.jpg", with_gps({1: "N", 2: angle, 3: "E", 4: angle})))
        assert facts.gps is None
        assert facts.notes == [note]


def test_padding_is_stripped():
    assert text("DJI\0\0\0") == "DJI"
    assert text(b"FC300S \0\0") == "FC300S"
    assert text("   ") is None
    assert text(7) is None


def test_xmp_as_elements(tmp_path):
    packet = b"<x:xmpmeta><drone-dji:RelativeAltitude>+41.5</drone-dji:RelativeAltitude></x:xmpmeta>"
    assert read_facts(save(tmp_path / "a.jpg", xmp=packet)).relative_altitude == 41.5


def test_natural_order():
    names = ["img_10.jpg", "img_9.jpg", "IMG_1.jpg", "a2b10.jpg", "a2b9.jpg"]
    assert sorted(names, key=natural_key) == ["a2b9.jpg", "a2b10.jpg", "IMG_1.jpg", "img_9.jpg", "img_10.jpg"]


def test_defects(tmp_path):
    for name in ("a.jpg", "b.png", "c.tif"):
        good = save(tmp_path / name, block(None))
        assert defect(good) is None
        for share in (0.9, 0.5, 0.05):
            broken = tmp_path / f"x{good.suffix}"
            broken.write_bytes(good.read_bytes()[: int(share * good.stat().st_size)])
            assert defect(broken)
    empty = tmp_path / "empty.jpg"
    empty.write_bytes(b"")
    assert defect(empty) == "empty file"
    lie = tmp_path / "lie.jpg"
    lie.write_text("this is no image")
    assert defect(lie) == "not a JPG file"


def test_a_truncated_jpeg_with_a_thumbnail_is_found_and_trailing_bytes_are_no_defect(tmp_path):
    whole = save(tmp_path / "a.jpg", block(None)).read_bytes()
    thumbnail = b"\xff\xd8 a thumbnail's end \xff\xd9"
    segment = b"\xff\xe3" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail
    (tmp_path / "b.jpg").write_bytes((whole[:2] + segment + whole[2:])[:-600])
    assert defect(tmp_path / "b.jpg")
    (tmp_path / "c.jpg").write_bytes(whole + bytes(1000))
    assert defect(tmp_path / "c.jpg") is None


DEWARP = "2018-09-06;3684.48,3677.57,2.24,22.05,-0.263482,0.106788,0.0000371107,-0.000327247,-0.0300783"


def dewarp(data: str, flag: int = 0, middle: tuple[float, float] = (2736, 1824)) -> bytes:
    """A survey drone's packet."""
    return (
        f'<x:xmpmeta drone-dji:CalibratedOpticalCenterX="{middle[0]}" drone-dji:CalibratedOpticalCenterY="{middle[1]}" '
        f'drone-dji:DewarpData=" {data}" drone-dji:DewarpFlag="{flag}" drone-dji:RtkFlag="50"/>'
    ).encode()


def test_the_lens_that_the_maker_measured_is_scaled_to_the_image(tmp_path: Path) -> None:
    lens = read_facts(save(tmp_path / "a.jpg", xmp=dewarp(DEWARP))).lens
    assert lens is not None
    scale = 60 / 5472
    assert (lens.width, lens.height) == (60, 40)
    assert lens.fx == pytest.approx(3684.48 * scale)
    assert lens.fy == pytest.approx(3677.57 * 40 / 3648)
    assert (lens.cx, lens.cy) == pytest.approx(((2736 + 2.24) * scale, (1824 + 22.05) * 40 / 3648))
    assert (lens.k1, lens.k2, lens.k3) == (-0.263482, 0.106788, -0.0300783)
    assert (lens.p1, lens.p2) == (0.0000371107, -0.000327247)


@pytest.mark.parametrize(
    ("packet", "note"),
    [
        (dewarp(DEWARP, flag=1), None),  # the camera has straightened the image itself
        (dewarp("2022-06-08;" + ",".join(["0.0"] * 9)), None),
        (dewarp(DEWARP, middle=(1824, 2736)), None),  # another shape: a part of the image, or turned
        (dewarp("2018-09-06;3684.48,3677.57"), "unreadable DewarpData"),
        (dewarp("2018-09-06;3684,3677,2,22,-9,0,0,0,0"), "unreadable DewarpData"),
    ],
)
def test_a_lens_that_cannot_be_used_is_none(tmp_path: Path, packet: bytes, note: str | None) -> None:
    facts = read_facts(save(tmp_path / "a.jpg", xmp=packet))
    assert facts.lens is None
    assert facts.notes == ([note] if note else [])
