"""Where the adjustment of a flight starts: models built up by matches, or cameras where GPS and gimbals put them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from overfly.errors import InputError
from overfly.flights import Flight, Frame
from overfly.geometry import Array
from overfly.mapping.agreement import Agreement, agreement, rewritten
from overfly.mapping.bundle import Bundle, components
from overfly.mapping.by_priors import bundle_by_priors
from overfly.mapping.database import read_points, read_verified
from overfly.mapping.matches import Bar, priors
from overfly.mapping.model import CONTRADICTED, mapped, upheld
from overfly.mapping.placing import agrees_with_gps

log = logging.getLogger("overfly")

ENOUGH = 0.95
"""Share of the images that sparse mapping must place, or their priors are tried as well."""

MOST = 0.8
"""Share of a model's images that must keep the matches that agree with GPS and gimbals, or it agrees with neither."""

TRUSTED, FEWER = 0.5, 0.5
"""Share of the images whose priors matches agree with, from which on cameras by priors replace a model that contradicts
GPS, if they are at least so many times as many."""

WORSE = 2.0
"""Times by which reprojection errors may be larger where more images are placed."""

FEWEST_BELIEVED = 50
"""Points of its median image from which on a model is believed although it contradicts GPS: less agrees by chance."""

GOOD_PX = 0.5
"""Errors are compared with so much at least: those of a few wrong points may be zero."""


class _Start(NamedTuple):
    """Models, whether they agree with GPS as far as it is known, and whether they are good enough."""

    parts: list[Bundle]
    agrees: bool
    good: bool

    def better_than(self, other: _Start) -> bool:
        if not self.parts or not other.parts:
            return bool(self.parts)
        if self.agrees != other.agrees:
            return self.agrees
        return _more_placed(self.parts[0], other.parts[0])


def sparse_parts(
    database: Path,
    flight: Flight,
    guessed: Sequence[str],
    told: Array | None,
    workdir: Path,
    seed: int,
    bar: Bar,
    warnings: list[str],
    more: Callable[[], Path] | None = None,
) -> list[Bundle]:
    """Bundles without common images, the largest first: with the focal lengths that the photos tell, if they tell them.

    Over flat ground a focal length without limits may run away, and everything with it; it is let go only where not
    all images could be placed with the one that is told. Pairs whose matches contradict GPS and gimbals are left out.
    Where matches are so few that sparse mapping leaves images out or contradicts GPS, more of them are asked for; if
    these are too few as well, cameras start where GPS and gimbals say that they are.

    Args:
        database: of verified matches.
        flight: its frames.
        guessed: names of those whose focal length is a guess.
        told: GPS positions [n, 3] in local ENU metres, NaN where unknown; None without GPS.
        workdir: the models are kept here.
        seed: of the mapping.
        bar: (step, unit) -> context manager of a function that takes (done, total).
        warnings: for the user.
        more: makes a database of more matches.

    Raises:
        InputError: all that was found contradicts GPS, and is too little to be believed.
    """
    names = [frame.name for frame in flight.frames]
    calibrated = all(frame.calibration is not None for frame in flight.frames)

    def built_up(database: Path, folder: Path) -> list[Bundle]:
        def found(folder: Path, calibrate: bool) -> list[Bundle]:
            return mapped(database, flight.root, folder, names=names, seed=seed, calibrate=calibrate)

        held = [] if len(guessed) == len(names) else found(folder / "held", calibrate=False)
        if (held and len(held[0]) == len(names)) or calibrated:
            return held
        free = found(folder, calibrate=True)
        return free if not held or (free and len(free[0]) > len(held[0])) else held

    stand = [] if told is None else priors(flight.frames, told)

    def judged(parts: list[Bundle], found: Agreement | None) -> _Start:
        if not parts or told is None:
            return _Start(parts, bool(parts), bool(parts) and len(parts[0]) >= ENOUGH * len(names))
        kept = upheld(parts[0], found.sure() if found else {}) / len(parts[0])
        agrees = kept >= MOST and agrees_with_gps(parts[0], told, flight.frames)
        good = agrees and kept >= 1 - CONTRADICTED and len(parts[0]) >= ENOUGH * len(names)
        return _Start(parts, agrees, good)

    def started(database: Path, folder: Path) -> tuple[_Start, Agreement | None]:
        """Models of matches that agree with the priors, and what agrees."""
        if not any(stand):
            return judged(built_up(database, folder), None), None
        with bar("agreement", "pairs") as update:
            found = agreement(database, names, stand, seed, update)
        log.info("pairs against GPS and gimbals: %s; pairs by them: %s", found.dropped, found.added)

        def agreeing() -> _Start:
            copy = rewritten(database, names, found, seed)
            try:
                return judged(built_up(copy, folder / "agreeing"), found)
            finally:
                copy.unlink()

        def as_it_is() -> _Start:
            return judged(built_up(database, folder), found)

        ways = [agreeing, as_it_is] if found.dropped else [as_it_is, *([agreeing] if found.added else [])]
        best = ways[0]()
        for way in ways[1:]:
            if not best.good and (other := way()).better_than(best):
                best = other
        return best, found

    remark: list[str] = []
    best, found = started(database, workdir)
    if not best.good and more is not None:
        database = more()
        richer, found = started(database, workdir / "more")
        if richer.better_than(best):
            best = richer
            remark = [
                "SIFT found too few matches to place all images in agreement with GPS, and the network's were added: "
                "fly with more overlap, and look at the picture of the block."
            ]
    if best.good or told is None:
        warnings += remark
        return best.parts
    features, lens_ids = read_points(database, names)
    matches = found.verified if found else read_verified(database, names)
    believed = [p if found and found.believed[i] else None for i, p in enumerate(stand)]
    with bar("guided matches", "pairs") as update:
        prior = bundle_by_priors(
            flight.frames, told, features, matches, lens_ids, priors=believed, seed=seed, progress=update
        )
    parts = [] if prior is None else components(prior)
    trusted = found is not None and found.believed.mean() >= TRUSTED
    if parts and not agrees_with_gps(parts[0], told, flight.frames, mostly=True):
        parts = []
    few = _too_few(best, told, flight.frames)
    if few is not None and not parts:
        raise InputError(
            f"The images share too little to be placed: what {len(best.parts[0])} of them have in common ({few} "
            "points in the median image) contradicts GPS, and so few agree by chance. Give images that overlap by 60 % "
            "or more."
        )
    worse = (
        few is None and bool(best.parts) and bool(parts) and not _better(parts[0], best.parts[0], best.agrees, trusted)
    )
    if not parts or worse:
        warnings += remark
        return best.parts
    left = len(names) - (len(best.parts[0]) if best.parts else 0)
    failed = f"left out {left} of {len(names)} images"
    if best.parts and not best.agrees:
        failed = "contradicted GPS or most matches"
    tried = "" if more is None else ", also with the network's,"
    warnings.append(
        f"Matches were so few{tried} that sparse mapping {failed}: the cameras were started where GPS and gimbals say "
        "that they are, with the matches that agree with that. Fly with more overlap, and look at the picture of the "
        "block."
    )
    return parts


def _too_few(best: _Start, told: Array, frames: Sequence[Frame]) -> int | None:
    """Points of the median image of a model that contradicts GPS and rests on too few of them; None of any other."""
    if not best.parts or best.agrees or agrees_with_gps(best.parts[0], told, frames, mostly=True):
        return None
    usual = int(np.median(np.bincount(best.parts[0].image, minlength=len(best.parts[0]))))
    return usual if usual < FEWEST_BELIEVED else None


def _better(new: Bundle, old: Bundle, agrees: bool, trusted: bool) -> bool:
    """Whether a bundle by priors is worth more than one of sparse mapping, which ``agrees`` with GPS or does not.

    Where matches agree with the priors (``trusted``) what contradicts them is worth little.
    """
    if agrees:
        return _more_placed(new, old)
    return len(new) >= (FEWER if trusted else 1.0) * len(old)


def _more_placed(new: Bundle, old: Bundle) -> bool:
    """Whether a bundle has more images without much larger errors than the old one, if these say anything."""
    usual = max(float(np.median(old.errors())), GOOD_PX)
    return len(new) > len(old) and float(np.median(new.errors())) < WORSE * usual
