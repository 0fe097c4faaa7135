"""Where the adjustment of a flight starts: models built up by matches, or cameras where GPS and gimbals put them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from overfly.flights import Flight
from overfly.geometry import Array
from overfly.mapping.agreement import agreement, rewritten
from overfly.mapping.bundle import Bundle, components
from overfly.mapping.by_priors import Verified, bundle_by_priors
from overfly.mapping.database import read_points
from overfly.mapping.matches import Bar, priors
from overfly.mapping.model import CONTRADICTED, mapped, upheld
from overfly.mapping.placing import agrees_with_gps

ENOUGH = 0.95
"""Share of the images that sparse mapping must place, or their priors are tried as well."""

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

    def judged(parts: list[Bundle], matches: Verified) -> tuple[bool, bool]:
        """Whether parts agree with GPS and keep their matches, as far as GPS is known, and are good enough."""
        if not parts or told is None:
            return bool(parts), bool(parts) and len(parts[0]) >= ENOUGH * len(names)
        kept = upheld(parts[0], {pair: len(rows) for pair, rows in matches.items()})
        agree = kept >= (1 - CONTRADICTED) * len(parts[0]) and agrees_with_gps(parts[0], told, flight.frames)
        return agree, agree and len(parts[0]) >= ENOUGH * len(names)

    def started(database: Path, folder: Path) -> tuple[list[Bundle], Verified]:
        """Models of matches that agree with the priors, and these matches."""
        if told is None:
            return built_up(database, folder), {}
        found = agreement(database, names, priors(flight.frames, told), seed)
        if found.dropped:
            return built_up(rewritten(database, names, found, seed), folder), found.verified
        best = built_up(database, folder)
        if found.added and not judged(best, found.verified)[1]:
            again = built_up(rewritten(database, names, found, seed), folder / "agreeing")
            if again and (not best or judged(again, found.verified) > judged(best, found.verified)):
                best = again
        return best, found.verified

    def from_priors(database: Path, matches: Verified) -> list[Bundle]:
        assert told is not None
        features, lens_ids = read_points(database, names)
        with bar("guided matches", "pairs") as update:
            prior = bundle_by_priors(
            flight.frames, told, features, matches, lens_ids,
            priors=priors(flight.frames, told), seed=seed, progress=update,
        )  # fmt: skip
        return [] if prior is None else components(prior)

    best, matches = started(database, workdir)
    agrees, good = judged(best, matches)
    if not good and more is not None:
        database = more()
        richer, matches = started(database, workdir / "more")
        now_agrees, now_good = judged(richer, matches)
        if richer and (not best or now_agrees > agrees or (now_agrees == agrees and _more_placed(richer[0], best[0]))):
            best, agrees, good = richer, now_agrees, now_good
            warnings.append(
                "SIFT found too few matches to place all images in agreement with GPS, and the network's were added: "
                "fly with more overlap, and look at the picture of the block."
            )
    if good or told is None:
        return best
    features, lens_ids = read_points(database, names)
    with bar("guided matches", "pairs") as update:
        prior = bundle_by_priors(
            flight.frames, told, features, matches, lens_ids,
            priors=priors(flight.frames, told), seed=seed, progress=update,
        )  # fmt: skip
    parts = [] if prior is None else components(prior)
    if not parts or (best and not _better(parts[0], best[0], agrees)):
        return best
    left = len(names) - (len(best[0]) if best else 0)
    failed = "contradicted GPS" if best and not agrees else f"left out {left} of {len(names)} images"
    tried = "" if more is None else ", also with the network's,"
    warnings.append(
        f"Matches were so few{tried} that sparse mapping {failed}: the cameras were started where GPS and gimbals say "
        "that they are, with the matches that agree with that. Fly with more overlap, and look at the picture of the "
        "block."
    )
    return parts


def _better(new: Bundle, old: Bundle, agrees: bool) -> bool:
    """Whether a bundle by priors is worth more than one of sparse mapping, which ``agrees`` with GPS or does not."""
    return _more_placed(new, old) if agrees else len(new) >= len(old)


def _more_placed(new: Bundle, old: Bundle) -> bool:
    """Whether a bundle has more images without much larger errors than the old one, if these say anything."""
    usual = max(float(np.median(old.errors())), GOOD_PX)
    return len(new) > len(old) and float(np.median(new.errors())) < WORSE * usual
