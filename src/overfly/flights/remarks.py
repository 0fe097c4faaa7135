"""Sentences about what is odd in the metadata of a flight; nothing is mended silently."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from overfly.flights.exif import Facts
from overfly.flights.flight import Frame

ALTITUDE_TOLERANCE_M = 10.0


def listed(names: Sequence[str], limit: int = 5) -> str:
    """The first names, and how many more there are."""
    more = len(names) - limit
    return ", ".join(names[:limit]) + (f" and {more} more" if more > 0 else "")


def metadata_remarks(frames: list[Frame], facts: list[Facts]) -> list[str]:
    """Missing or broken GPS, orientation tags, several cameras. The lists run in parallel."""
    remarks, total = [], len(frames)
    notes = Counter(note for f in facts for note in f.notes)
    if notes["unreadable EXIF"]:
        remarks.append(f"The EXIF of {notes['unreadable EXIF']} of {total} images cannot be read and is left out.")
    if notes["unreadable DewarpData"]:
        remarks.append(
            f"The lens in {notes['unreadable DewarpData']} of {total} images (DewarpData) is unreadable and left out."
        )
    for note, what in (("unreadable GPS", "cannot be read (0/0)"), ("GPS 0, 0", "is latitude 0, longitude 0 (no fix)")):
        names = [fr.name for fr, fa in zip(frames, facts, strict=True) if note in fa.notes and fr.gps is None]
        if names:
            remarks.append(f"The GPS of {len(names)} of {total} images {what}; they count as without: {listed(names)}.")
    without = [f.name for f in frames if f.gps is None]
    if 0 < len(without) < total:
        remarks.append(f"{len(without)} of {total} images have no GPS position: {listed(without)}.")
    flat = [f.name for f in frames if f.gps is not None and f.gps.altitude is None]
    if flat:
        remarks.append(f"The GPS of {len(flat)} of {total} images has no altitude: {listed(flat)}.")
    turned = Counter(f.orientation for f in frames if f.orientation != 1)
    if turned:
        tags = ", ".join(str(tag) for tag in sorted(turned))
        remarks.append(
            f"{sum(turned.values())} of {total} images carry an EXIF Orientation tag ({tags}); the pixels are used as "
            "stored and not turned."
        )
    return remarks


def altitude_remarks(frames: list[Frame], facts: list[Facts]) -> list[str]:
    """Altitudes that cannot be trusted: below sea level, or at odds with the drone's own."""
    remarks = []
    altitudes = [f.gps.altitude for f in frames if f.gps is not None and f.gps.altitude is not None]
    below = [a for a in altitudes if a < 0]
    if below:
        remarks.append(
            f"The GPS altitude of {len(below)} of {len(frames)} images is below sea level ({min(below):.1f} to "
            f"{max(below):.1f} m, GPSAltitudeRef): it is used as stated, but the flight's absolute height is probably "
            "wrong by tens of metres; only differences of heights can be trusted."
        )
    differences = [
        abs(fa.absolute_altitude - fr.gps.altitude)
        for fr, fa in zip(frames, facts, strict=True)
        if fr.gps is not None and fr.gps.altitude is not None and fa.absolute_altitude is not None
    ]
    if differences and max(differences) > ALTITUDE_TOLERANCE_M:
        remarks.append(
            f"GPS altitude and the drone's AbsoluteAltitude differ by up to {max(differences):.0f} m: the absolute "
            "height is doubtful."
        )
    takeoff = [
        fr.gps.altitude - fr.relative_altitude
        for fr in frames
        if fr.gps is not None and fr.gps.altitude is not None and fr.relative_altitude is not None
    ]
    if takeoff and max(takeoff) - min(takeoff) > 2 * ALTITUDE_TOLERANCE_M:
        remarks.append(
            f"GPS altitude minus RelativeAltitude, which is the height of the take-off, varies by "
            f"{max(takeoff) - min(takeoff):.0f} m within the flight: one of the two is wrong."
        )
    elif takeoff and min(takeoff) < -450:
        remarks.append(
            f"The take-off would lie {-min(takeoff):.0f} m below sea level by GPS altitude minus RelativeAltitude: "
            "the absolute height is wrong."
        )
    return remarks
