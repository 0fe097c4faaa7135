"""What is wrong with the images themselves and with their cameras: blur, exposure, texture, copies, mixed cameras."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from overfly.flights import CAMERAS, Flight
from overfly.geometry import Array
from overfly.mapping.database import focal_px
from overfly.preflight.findings import Finding, count, some
from overfly.preflight.images import Look

BLURRED = 0.55
"""Sharpness relative to the flight's median; sharp images lie above 0.7 (see :func:`overfly.preflight.images.look`)."""

MOTION_PX = 1.0
"""Blur by the drone's motion during the exposure that costs accuracy, pixels."""

CLIPPED_BRIGHT, CLIPPED_DARK = 0.05, 0.1
JUMP = 1.35
"""Ratio of an image's brightness to that of its neighbours that looks like another exposure."""

Those = Callable[[NDArray | Sequence[bool]], tuple[str, ...]]
"""Names of the images for which a list of truths holds."""

FLAT, ALL_FLAT = 0.5, 0.9
"""Share of the picture without texture that costs a part of an image, and that leaves nothing of it."""

MANY = 0.1
"""Share of the images from which on a map lacks a part without them."""

FOCALS_DISAGREE = 0.05


def relative_sharpness(flight: Flight, looks: Sequence[Look]) -> Array:
    """Sharpness of each image over the median of those of its size, the worse of both axes [n]; NaN where unknown."""
    sharp = np.array([look.sharpness for look in looks], float).reshape(-1, 2)
    groups = defaultdict(list)
    for i, frame in enumerate(flight.frames):
        groups[frame.width, frame.height].append(i)
    relative = np.full(len(looks), np.nan)
    for members in groups.values():
        values = sharp[members]
        if np.isfinite(values).all(1).any():
            relative[members] = (values / np.nanmedian(values, axis=0)).min(1)
    return relative


def image_findings(flight: Flight, looks: Sequence[Look], motion_px: float | None) -> Iterator[Finding]:
    """Findings about the pixels.

    Args:
        flight: its frames, in parallel with ``looks``.
        looks: at the images.
        motion_px: way of the drone during the exposure, in pixels on the ground; None where unknown.
    """
    names = [f.name for f in flight.frames]

    def those(which: NDArray | Sequence[bool]) -> tuple[str, ...]:
        return tuple(name for name, chosen in zip(names, which, strict=True) if chosen)

    if flight.skipped:
        text = f"{count(len(flight.skipped), 'file')} cannot be read ({some(flight.skipped)})"
        yield Finding("warn", "files", text, "copy them again from the card", tuple(flight.skipped))
    if broken := those([look.error is not None for look in looks]):
        few = len(names) - len(broken) < 2
        text = f"{count(len(broken), 'image')} of {len(names)} cannot be decoded ({some(broken)})"
        remedy = "copy them again from the card" + ("; a map needs two at least" if few else " or remove them")
        yield Finding("stop" if few else "bad", "files", text, remedy, broken)
    with np.errstate(invalid="ignore"):
        blurred = those(relative_sharpness(flight, looks) < BLURRED)
    if blurred:
        yield Finding(
            "bad" if len(blurred) > MANY * len(names) else "warn",
            "blur",
            f"{count(len(blurred), 'image')} of {len(names)} much less sharp than the others ({some(blurred)})",
            "remove them if their neighbours still overlap, else fly there again, slower or with a shorter exposure",
            blurred,
        )
    if motion_px is not None and motion_px > MOTION_PX:
        yield Finding(
            "warn",
            "blur",
            f"The drone moved by {motion_px:.1f} pixels during an exposure",
            f"fly at {1 / motion_px:.0%} of the speed, or expose {motion_px:.1f} times shorter",
        )
    yield from _exposure(looks, those)
    yield from _texture(looks, those)
    yield from _copies(flight, looks)


def _exposure(looks: Sequence[Look], those: Those) -> Iterator[Finding]:
    bright, dark = (np.array([getattr(look, name) for look in looks]) for name in ("bright", "dark"))
    with np.errstate(invalid="ignore"):
        for which, what, remedy in (
            (bright > CLIPPED_BRIGHT, "overexposed", "lower the exposure by one stop; white areas cannot be matched"),
            (dark > CLIPPED_DARK, "underexposed", "raise the exposure; black areas cannot be matched"),
        ):
            if found := those(which):
                share = float(np.nanmax(bright if what == "overexposed" else dark))
                text = f"{count(len(found), 'image')} {what}, up to {share:.0%} of the pixels clipped ({some(found)})"
                yield Finding("warn", "exposure", text, remedy, found)
    level = np.array([look.brightness for look in looks])
    jumps = np.zeros(len(level), bool)
    for i in range(len(level)):
        around = np.concatenate([level[max(0, i - 2) : i], level[i + 1 : i + 3]])
        around = around[np.isfinite(around)]
        if len(around) >= 3 and np.isfinite(level[i]) and np.ptp(around) < (JUMP - 1) * np.median(around):
            ratio = max(level[i], 1.0) / max(float(np.median(around)), 1.0)
            jumps[i] = max(ratio, 1 / ratio) > JUMP
    if found := those(jumps):
        text = f"The brightness of {count(len(found), 'image')} jumps against the neighbours ({some(found)})"
        yield Finding(
            "note", "exposure", text, "lock the exposure before the flight; seams will show in the map", found
        )


def _texture(looks: Sequence[Look], those: Those) -> Iterator[Finding]:
    flat = np.array([look.flat for look in looks])
    if np.isfinite(flat).any() and np.nanmedian(flat) > ALL_FLAT:
        yield Finding(
            "stop",
            "texture",
            f"In most images {np.nanmedian(flat):.0%} of the picture shows no texture",
            "nothing can be matched on water, snow or a sky; look at the images and fly over textured ground",
        )
        return
    with np.errstate(invalid="ignore"):
        nothing, found = those(flat > ALL_FLAT), those((flat > FLAT) & (flat <= ALL_FLAT))
    if nothing:
        # Holes at a shore are one thing, images that nothing can place another: it is said first, as blur is.
        yield Finding(
            "bad" if len(nothing) > MANY * len(looks) else "warn",
            "texture",
            f"{count(len(nothing), 'image')} of {len(looks)} without any texture ({some(nothing)})",
            "they will not be placed and leave holes; look at them: nothing matches water, snow, fog or a covered lens",
            nothing,
        )
    if found:
        text = f"{count(len(found), 'image')} with more than half of the picture without texture ({some(found)})"
        remedy = "expect holes there (water, snow, fresh asphalt); more overlap or a greater height helps at the shore"
        yield Finding("warn", "texture", text, remedy, found)


def _copies(flight: Flight, looks: Sequence[Look]) -> Iterator[Finding]:
    first: dict[str, str] = {}
    copies, twins = [], []
    places: dict[tuple, str] = {}
    for frame, look in zip(flight.frames, looks, strict=True):
        if look.digest and look.digest in first:
            copies.append(frame.name)
            continue
        first[look.digest] = frame.name
        if frame.gps is not None and frame.time is not None:
            key = (round(frame.gps.latitude, 6), round(frame.gps.longitude, 6), frame.time)
            if key in places:
                twins.append(frame.name)
            places[key] = frame.name
    if copies:
        alone = len(looks) - len(copies) < 2
        text = f"{count(len(copies), 'image')} of {len(looks)} with the same pixels as another one ({some(copies)})"
        remedy = "one image alone gives no depth" if alone else "remove the copies; they add nothing"
        level = "stop" if alone else "bad" if 2 * len(copies) > len(looks) else "warn"
        yield Finding(level, "duplicates", text, remedy, tuple(copies))
    if twins:
        text = f"{count(len(twins), 'image')} taken at the same place and time as another one ({some(twins)})"
        yield Finding("note", "duplicates", text, "remove edited versions of the same photograph", tuple(twins))


def camera_findings(flight: Flight) -> Iterator[Finding]:
    """Findings about sizes, focal lengths and orientation tags."""
    groups = sorted(flight.camera_groups().values(), key=len, reverse=True)
    given = flight.cameras_from is not None
    if len(groups) > 1 and not given:
        some_of = [flight.frames[members[0]] for members in groups]
        text = ", ".join(
            f"{len(members)} x {f.model or 'unknown camera'} {f.width} x {f.height}"
            + (f" at {f.focal_mm:g} mm" if f.focal_mm else "")
            for members, f in list(zip(groups, some_of))[:3]
        )
        small = [flight.frames[i].name for members in groups[1:] if len(members) < 10 for i in members]
        yield Finding(
            "warn" if small else "note",
            "cameras",
            f"The images come from {len(groups)} cameras or zoom settings ({text}{', ...' if len(groups) > 3 else ''})",
            "each is calibrated by itself, which needs ten images; leave smaller groups out where others see the place",
            tuple(small),
        )
    unknown = [f.name for f in flight.frames if focal_px(f) is None and f.camera is None]
    if unknown and not given:
        text = f"The focal length of {count(len(unknown), 'image')} is not known ({some(unknown)})"
        remedy = "it is estimated from the images, which bends flat ground; keep the EXIF data of the original files"
        yield Finding("warn", "cameras", text, remedy, tuple(unknown))
    yield from _focals(flight)
    turned = [f.name for f in flight.frames if f.orientation != 1]
    if turned:
        text = f"{count(len(turned), 'image')} with an Orientation tag"
        remedy = "nothing is to be done, pixels are used as stored; other programs may turn them"
        yield Finding("note", "orientation", text, remedy, tuple(turned))


def _focals(flight: Flight) -> Iterator[Finding]:
    presets = {preset.model: preset for preset in CAMERAS.values()}
    odd, worst = [], 0.0
    for frame in flight.frames:
        preset = presets.get(frame.model or "")
        if preset is None or frame.focal_px is None or frame.camera is not None:
            continue
        expected = preset.camera(frame.width, frame.height).fx
        if abs(frame.focal_px / expected - 1) > FOCALS_DISAGREE:
            odd.append(frame.name)
            worst = max(worst, abs(frame.focal_px / expected - 1))
    if odd:
        yield Finding(
            "warn",
            "cameras",
            f"The focal length in {count(len(odd), 'image')} differs by up to {worst:.0%} from the camera's data sheet",
            "heights scale with it where GPS is weak; check that the images were not cropped or resized by an editor",
            tuple(odd),
        )
