"""What the user should know before trusting a map, each sentence with what to do about it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from overfly.mapping.report import Caution, area_text

LOWEST_LAND = -50.0
"""Metres: ellipsoidal heights below this are rarer than cameras that write a wrong altitude."""

Altitudes = Mapping[str, tuple[float | None, float | None]]


def cautions(
    summary: Mapping[str, Any], *, altitudes: Altitudes, has_gps: bool, from_readers: Sequence[str] = ()
) -> list[Caution]:
    """All warnings about a map.

    Args:
        summary: the content of ``map.json`` so far.
        altitudes: per registered frame its height above the mapped ground and the relative altitude that its metadata
            tell (metres; None where unknown). Empty without metric scale.
        has_gps: whether any image has a usable GPS position.
        from_readers: sentences of the flight's readers, which are passed on.
    """
    told = " ".join(from_readers)
    found = [*_about_place(summary, has_gps), *_about_images(summary)]
    found += [c for c in _about_heights(summary, altitudes) if "below" not in c.what or "below sea level" not in told]
    found += [*_about_far_off(summary.get("gps_far_off", []), told), *_about_points(summary), *_about_geoid(summary)]
    # The readers' sentences on left-out images are covered above, with what to do.
    covered = ("are skipped", "have no camera")
    return found + [Caution(text, "") for text in from_readers if not any(words in text for words in covered)]


def _about_place(summary: Mapping[str, Any], has_gps: bool) -> Iterator[Caution]:
    if not summary["metric"]:
        yield Caution(
            "Metric scale unknown: lengths and heights are in units, not in metres, and the files carry no CRS.",
            "Give GPS in the images or a geo.txt, or measure one known distance in the cloud and scale by it.",
        )
    elif not summary["crs"]:
        yield Caution(
            "The map has no place on the Earth: it is in the cameras' own frame and the files carry no CRS.",
            "Give the origin in transforms.json (key overfly.origin) if it should lie in a GIS.",
        )
    if not has_gps and summary["cameras_from"] == "estimated" and not summary["metric"]:
        yield Caution(
            "No image carries a usable GPS position.",
            "Which way is up is guessed from the cameras and north is unknown; look for a tilt in the heights.",
        )


def _about_images(summary: Mapping[str, Any]) -> Iterator[Caution]:
    if lost := summary["unregistered"]:
        yield Caution(
            f"{len(lost)} of {summary['images']} images could not be placed: {names_text(lost)}.",
            "Where they lie the map has gaps or is weak; fly with more overlap, or add the images between them.",
        )
    if skipped := summary["skipped"]:
        files = "file was" if len(skipped) == 1 else "files were"
        yield Caution(
            f"{len(skipped)} {files} skipped: {names_text([f'{name} ({why})' for name, why in skipped.items()])}.",
            "Copy broken files again from the card.",
        )
    if (pixels := summary.get("reprojection_px")) is not None and pixels > 1.5:
        yield Caution(
            f"The reprojection error is {pixels:.1f} px, which is high.",
            "Look for blurred images, a rolling shutter at speed, or images of several cameras.",
        )


def _about_heights(summary: Mapping[str, Any], altitudes: Altitudes) -> Iterator[Caution]:
    low, high = summary["height_range"]
    if summary["crs"] and low < LOWEST_LAND:
        yield Caution(
            f"The map's heights are {low:.0f} to {high:.0f} m, below any land here: the images' altitude is wrong.",
            "Shape and height differences are right; for absolute heights use ground control or shift the cloud.",
        )
    pairs = np.array([p for p in altitudes.values() if None not in p], float).reshape(-1, 2)
    pairs = pairs[pairs[:, 1] > 5]
    if len(pairs) and not 0.6 < np.median(pairs[:, 0] / pairs[:, 1]) < 1.6:
        above, told = np.median(pairs, axis=0)
        yield Caution(
            f"The cameras stand {above:.0f} m above the mapped ground, but tell {told:.0f} m above their take-off.",
            "Normal over a slope; over flat land the GPS, and with it the scale, is doubtful.",
        )
    if gps := summary.get("gps_rms"):
        horizontal, vertical = gps["horizontal_m"], gps["vertical_m"]
        if horizontal > 5 or (vertical or 0) > 5:
            more = "" if vertical is None else f" and {vertical:.1f} m vertically"
            yield Caution(
                f"The GPS positions disagree with the images by {horizontal:.1f} m horizontally{more}.",
                "Scale and place are only that good; check the GPS tags of single images or use ground control.",
            )


def _about_far_off(far: Sequence[str], told: str) -> Iterator[Caution]:
    if far := [name for name in far if name not in told]:  # an estimation has named those that it did not use
        yield Caution(
            f"The GPS position of {names_text(far)} is far from where its camera stands.",
            "It is left out of the residuals; check the GPS tags of these images, or the cameras that were given.",
        )


def _about_geoid(summary: Mapping[str, Any]) -> Iterator[Caution]:
    if summary["heights"] == "ellipsoidal" and summary["settings"]["heights"] is None:
        yield Caution(
            "Heights are those of the origin or the images' GPS, taken as above the ellipsoid: no geoid is applied.",
            "For heights above the sea map with --heights egm96 or the EPSG code of a vertical CRS, for which PROJ "
            "needs its geoid grid; --heights ellipsoidal says that this is meant.",
        )


def _about_points(summary: Mapping[str, Any]) -> Iterator[Caution]:
    if (once := summary["seen_once_share"]) >= 0.02:
        where = f" ({area_text(once * summary['area'])})" if summary["metric"] else ""
        yield Caution(
            f"{once:.0%} of the mapped ground{where} is seen by one image only and cannot be measured there.",
            "At the rim of a flight that is usual: leave it out, or fly one line and one image more around the area; "
            "within it fly with at least 60 % overlap along and across the lines.",
        )
    if (blank := summary["unmatched_share"]) >= 0.15:
        yield Caution(
            f"{blank:.0%} of the ground that two images or more see has no point: nothing could be matched there.",
            "Trees, water and smooth surfaces are like that; more overlap helps, and so does a larger --size where it "
            "is smaller than the images.",
        )
    if (share := summary["predicted"] / max(summary["points"], 1)) >= 0.02:
        yield Caution(
            f"{share:.0%} of the points are predicted, not measured.",
            "They are marked predicted = 1 in cloud.laz; leave them out of measurements.",
        )


def names_text(names: Sequence[str], most: int = 8) -> str:
    """A few names and how many more."""
    text = ", ".join(names[:most])
    return text if len(names) <= most else f"{text} and {len(names) - most} more"
