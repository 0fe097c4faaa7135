"""Where the adjustment of a flight starts: models built up by matches, or cameras where GPS and gimbals put them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from overfly.flights import Flight
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

GOOD_PX = 0.5
"""Errors are compared with so much at least: those of a few wrong points may be zero."""


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

    def judged(parts: list[Bundle], matches: Mapping[tuple[int, int], int]) -> tuple[bool, bool]:
        """Whether parts agree with GPS, as far as it is known, and whether they are good enough."""
        if not parts or told is None:
            return bool(parts), bool(parts) and len(parts[0]) >= ENOUGH * len(names)
        kept = upheld(parts[0], matches) / len(parts[0])
        agree = kept >= MOST and agrees_with_gps(parts[0], told, flight.frames)
        return agree, agree and kept >= 1 - CONTRADICTED and len(parts[0]) >= ENOUGH * len(names)

    def better(new: list[Bundle], old: list[Bundle], matches: Mapping[tuple[int, int], int]) -> bool:
        now, was = judged(new, matches)[0], judged(old, matches)[0]
        return bool(new) and (not old or now > was or (now == was and _more_placed(new[0], old[0])))

    def started(database: Path, folder: Path) -> tuple[list[Bundle], Agreement | None]:
        """Models of matches that agree with the priors, and what agrees."""
        if told is None or not any(stand := priors(flight.frames, told)):
            return built_up(database, folder), None
        with bar("agreement", "pairs") as update:
            found = agreement(database, names, stand, seed, update)
        log.info("pairs against GPS and gimbals: %s; pairs by them: %s", found.dropped, found.added)

        def agreeing() -> list[Bundle]:
            copy = rewritten(database, names, found, seed)
            try:
                return built_up(copy, folder / "agreeing")
            finally:
                copy.unlink()

        best = agreeing() if found.dropped else built_up(database, folder)
        if not judged(best, found.sure())[1] and (found.dropped or found.added):
            other = built_up(database, folder) if found.dropped else agreeing()
            best = other if better(other, best, found.sure()) else best
        return best, found

    best, found = started(database, workdir)
    agrees, good = judged(best, found.sure() if found else {})
    if not good and more is not None:
        database = more()
        richer, found = started(database, workdir / "more")
        if better(richer, best, sure := found.sure() if found else {}):
            best, (agrees, good) = richer, judged(richer, sure)
            warnings.append(
                "SIFT found too few matches to place all images in agreement with GPS, and the network's were added: "
                "fly with more overlap, and look at the picture of the block."
            )
    if good or told is None:
        return best
    features, lens_ids = read_points(database, names)
    matches = found.verified if found else read_verified(database, names)
    stand = [p if found and found.believed[i] else None for i, p in enumerate(priors(flight.frames, told))]
    with bar("guided matches", "pairs") as update:
        prior = bundle_by_priors(
            flight.frames, told, features, matches, lens_ids, priors=stand, seed=seed, progress=update
        )
    parts = [] if prior is None else components(prior)
    trusted = found is not None and found.believed.mean() >= TRUSTED
    if not parts or (best and not _better(parts[0], best[0], agrees, trusted)):
        return best
    left = len(names) - (len(best[0]) if best else 0)
    failed = "contradicted GPS or most matches" if best and not agrees else f"left out {left} of {len(names)} images"
    tried = "" if more is None else ", also with the network's,"
    warnings.append(
        f"Matches were so few{tried} that sparse mapping {failed}: the cameras were started where GPS and gimbals say "
        "that they are, with the matches that agree with that. Fly with more overlap, and look at the picture of the "
        "block."
    )
    return parts


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
