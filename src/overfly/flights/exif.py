"""What image files say about themselves: EXIF and DJI's XMP, read and written."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from overfly.flights.flight import Gps
from overfly.geometry import Camera, invertible

MAKE, MODEL, ORIENTATION, DATE_TIME, SOFTWARE, XMP = 0x010F, 0x0110, 0x0112, 0x0132, 0x0131, 0x02BC
EXIF_IFD, GPS_IFD = 0x8769, 0x8825
DATE_TIME_ORIGINAL, SUBSEC_ORIGINAL, FOCAL, FOCAL_35 = 0x9003, 0x9291, 0x920A, 0xA405
PLANE_X, PLANE_UNIT, PIXELS_X, PIXELS_Y = 0xA20E, 0xA210, 0xA002, 0xA003
PLANE_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
SHAPE = 0.01
"""Share by which the shape of an image may differ from the calibrated one: sizes are rounded."""

DJI_NAMESPACE = "http://www.dji.com/drone-dji/1.0/"


@dataclass
class Facts:
    """What one file says; ``notes`` are its oddities, in words shared by all files so that they can be counted."""

    width: int
    height: int
    make: str | None = None
    model: str | None = None
    time: datetime | None = None
    focal_mm: float | None = None
    focal35_mm: float | None = None
    focal_px: float | None = None
    orientation: int = 1
    gps: Gps | None = None
    relative_altitude: float | None = None
    absolute_altitude: float | None = None
    gimbal: tuple[float, float, float] | None = None
    lens: Camera | None = None
    notes: list[str] = field(default_factory=list)


def text(value: Any) -> str | None:
    """A tag as text without the NUL and blank padding of fixed-length fields; None when empty."""
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    if not isinstance(value, str):
        return None
    return value.split("\0")[0].strip() or None


def number(value: Any) -> float | None:
    """A tag as a finite float; None for 0/0, a zero denominator or anything else."""
    try:
        result = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return result if math.isfinite(result) else None


def positive(value: Any) -> float | None:
    result = number(value)
    return result if result is not None and result > 0 else None


def read_facts(path: Path) -> Facts:
    """Read the header of an image file; its pixels are not decoded.

    Raises:
        OSError: not an image, or a broken header.
    """
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # PIL's remarks on broken EXIF: missing tags are noted below
        with Image.open(path) as image:
            facts = Facts(*image.size)
            try:
                exif = image.getexif()
                details, position = dict(exif.get_ifd(EXIF_IFD)), dict(exif.get_ifd(GPS_IFD))
                main = dict(exif)
            except (SyntaxError, ValueError, TypeError, KeyError, OSError, IndexError):
                facts.notes.append("unreadable EXIF")
                main, details, position = {}, {}, {}
            xmp = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp") or main.get(XMP) or b""
    facts.make, facts.model = text(main.get(MAKE)), text(main.get(MODEL))
    facts.time = _time(details, main)
    facts.focal_mm, facts.focal35_mm = positive(details.get(FOCAL)), positive(details.get(FOCAL_35))
    facts.orientation = int(number(main.get(ORIENTATION)) or 1)
    per_unit = positive(details.get(PLANE_X))
    unit_mm = PLANE_UNIT_MM.get(int(number(details.get(PLANE_UNIT)) or 2))
    if facts.focal_mm and per_unit and unit_mm:
        # The tag refers to the image's original width, which editors that resample do not always keep up.
        original = positive(details.get(PIXELS_X)) or facts.width
        facts.focal_px = facts.focal_mm * per_unit / unit_mm * facts.width / original
    _read_gps(position, facts)
    _read_xmp(xmp if isinstance(xmp, str) else bytes(xmp).decode("utf-8", "replace"), facts,
              (positive(details.get(PIXELS_X)), positive(details.get(PIXELS_Y))))  # fmt: skip
    return facts


def _time(details: dict, main: dict) -> datetime | None:
    stamp = text(details.get(DATE_TIME_ORIGINAL)) or text(main.get(DATE_TIME))
    if stamp is None:
        return None
    try:
        time = datetime.strptime(stamp[:19], "%Y:%m:%d %H:%M:%S")
    except ValueError:
        return None
    fraction = text(details.get(SUBSEC_ORIGINAL)) or ""
    return time.replace(microsecond=int((fraction + "000000")[:6])) if fraction.isdigit() else time


def _degrees(value: Any, reference: Any, negative: str) -> float | None:
    """Degrees from (degrees, minutes, seconds) and the letter of the hemisphere."""
    parts = list(value) if isinstance(value, list | tuple) else [value]
    numbers = [number(part) for part in parts]
    if not numbers or any(n is None for n in numbers):
        return None
    size = sum(n / 60**i for i, n in enumerate(numbers[:3]) if n is not None)
    return -size if (text(reference) or "").upper().startswith(negative) else size


def _read_gps(tags: dict, facts: Facts) -> None:
    if not tags or (tags.get(2) is None and tags.get(4) is None):
        return
    latitude, longitude = _degrees(tags.get(2), tags.get(1), "S"), _degrees(tags.get(4), tags.get(3), "W")
    if latitude is None or longitude is None or not (abs(latitude) <= 90 and abs(longitude) <= 180):
        facts.notes.append("unreadable GPS")
        return
    if latitude == 0 and longitude == 0:
        facts.notes.append("GPS 0, 0")
        return
    altitude = number(tags.get(6))
    if altitude is not None:
        below = tags.get(5)
        below = below[0] if isinstance(below, bytes) and below else below
        if below in (1, "1"):
            altitude = -altitude
    facts.gps = Gps(latitude, longitude, altitude)


def _read_xmp(packet: str, facts: Facts, original: tuple[float | None, float | None]) -> None:
    """DJI's tags, as attributes or as elements."""

    def value(name: str) -> float | None:
        found = re.search(rf'drone-dji:{name}\s*(?:=\s*["\']|>)\s*([+-]*[0-9.]+(?:[eE][+-]?\d+)?)', packet)
        return number(found.group(1).replace("+-", "-").lstrip("+")) if found else None

    if "drone-dji:" not in packet:
        return
    facts.relative_altitude, facts.absolute_altitude = value("RelativeAltitude"), value("AbsoluteAltitude")
    yaw, pitch, roll = (value(f"Gimbal{axis}Degree") for axis in ("Yaw", "Pitch", "Roll"))
    if yaw is not None and pitch is not None:
        facts.gimbal = (yaw, pitch, roll or 0.0)
    _read_lens(packet, value, facts, original)
    stds = [value(f"RtkStd{axis}") for axis in ("Lat", "Lon", "Hgt")]
    if facts.gps is not None and all(stds):
        gps = facts.gps
        facts.gps = Gps(gps.latitude, gps.longitude, gps.altitude, max(stds[0] or 0, stds[1] or 0), stds[2])


def _read_lens(
    packet: str, value: Callable[[str], float | None], facts: Facts, original: tuple[float | None, float | None]
) -> None:
    """DJI's DewarpData, "date;fx,fy,cx,cy,k1,k2,p1,p2,k3" in pixels of the full image, cx and cy from its middle.

    How large the full image was, twice the optical centre tells, else EXIF (``original``); else the lens is not used.

    Images that the camera has straightened itself have another lens, of which nothing is told.
    """
    found = re.search(r'drone-dji:DewarpData\s*(?:=\s*["\']|>)\s*[^;"\'<]*;([^"\'<]*)', packet)
    if found is None or value("DewarpFlag") == 1:
        return
    numbers = [number(part) for part in found.group(1).split(",")]
    if len(numbers) < 9 or any(n is None for n in numbers[:9]):
        facts.notes.append("unreadable DewarpData")
        return
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = (float(n or 0) for n in numbers[:9])
    middle = value("CalibratedOpticalCenterX"), value("CalibratedOpticalCenterY")
    width, height = (2 * m if m else side or 0.0 for m, side in zip(middle, original, strict=True))
    if min(fx, fy, width, height) <= 0 or abs(width * facts.height / (height * facts.width) - 1) > SHAPE:
        return  # zeros of a camera that was never calibrated, or a part of the image
    lens = Camera(round(width), round(height), fx, fy, width / 2 + cx, height / 2 + cy, k1, k2, p1, p2, k3)
    if invertible(lens):
        facts.lens = lens.resized(facts.width, facts.height)
    else:
        facts.notes.append("unreadable DewarpData")


def exif_bytes(
    *,
    make: str,
    model: str,
    time: datetime,
    focal_mm: float,
    focal35_mm: float,
    focal_px: float,
    size: tuple[int, int],
    gps: Gps | None,
) -> bytes:
    """An EXIF block. Positions keep 1e-9 degrees (0.1 mm)."""
    from PIL import Image
    from PIL.TiffImagePlugin import IFDRational

    def dms(value: float) -> tuple[IFDRational, IFDRational, IFDRational]:
        seconds = round(abs(value) * 3600 * 1_000_000)
        degrees, rest = divmod(seconds, 3600 * 1_000_000)
        minutes, rest = divmod(rest, 60 * 1_000_000)
        return IFDRational(degrees, 1), IFDRational(minutes, 1), IFDRational(rest, 1_000_000)

    stamp = time.strftime("%Y:%m:%d %H:%M:%S")
    exif = Image.Exif()
    exif[MAKE], exif[MODEL], exif[SOFTWARE], exif[DATE_TIME], exif[ORIENTATION] = make, model, "Overfly", stamp, 1
    details = exif.get_ifd(EXIF_IFD)
    details[DATE_TIME_ORIGINAL], details[SUBSEC_ORIGINAL] = stamp, f"{time.microsecond // 1000:03d}"
    details[FOCAL], details[FOCAL_35] = IFDRational(round(focal_mm * 1000), 1000), round(focal35_mm)
    details[PLANE_X] = IFDRational(round(focal_px / focal_mm * 10 * 100_000), 100_000)
    details[PLANE_UNIT], details[PIXELS_X], details[PIXELS_Y] = 3, *size  # 3: per cm
    if gps is not None:
        position = exif.get_ifd(GPS_IFD)
        position[0] = b"\x02\x03\x00\x00"
        position[1], position[2] = "S" if gps.latitude < 0 else "N", dms(gps.latitude)
        position[3], position[4] = "W" if gps.longitude < 0 else "E", dms(gps.longitude)
        if gps.altitude is not None:
            position[5] = b"\x01" if gps.altitude < 0 else b"\x00"
            position[6] = IFDRational(round(abs(gps.altitude) * 10_000), 10_000)
    return exif.tobytes()


def xmp_bytes(
    *, gimbal: tuple[float, float, float], relative_altitude: float, absolute_altitude: float | None
) -> bytes:
    """An XMP packet with DJI's names: gimbal yaw, pitch, roll in degrees (yaw -180 to 180), altitudes in metres."""
    yaw = (gimbal[0] + 180) % 360 - 180
    values = {"RelativeAltitude": relative_altitude, "GimbalYawDegree": yaw, "GimbalPitchDegree": gimbal[1]}
    values |= {"GimbalRollDegree": gimbal[2], "FlightYawDegree": yaw, "FlightPitchDegree": 0.0, "FlightRollDegree": 0.0}
    if absolute_altitude is not None:
        values["AbsoluteAltitude"] = absolute_altitude
    attributes = "\n".join(f'   drone-dji:{name}="{value:+.4f}"' for name, value in values.items())
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n<x:xmpmeta xmlns:x="adobe:ns:meta/">\n'
        ' <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n'
        f'  <rdf:Description rdf:about="DJI Meta Data"\n    xmlns:drone-dji="{DJI_NAMESPACE}"\n{attributes}/>\n'
        ' </rdf:RDF>\n</x:xmpmeta>\n<?xpacket end="w"?>'
    ).encode()
