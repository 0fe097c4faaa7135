"""Where the adjustment of a flight starts: models built up by matches, or cameras where GPS and gimbals put them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from overfly.flights import Flight
from overfly.geometry import Array
from overfly.mapping.bundle import Bundle, bundle_of, components
from overfly.mapping.by_priors import bundle_by_priors
from overfly.mapping.database import read_points, read_verified
from overfly.mapping.matches import Bar
from overfly.mapping.model import mapped
from overfly.mapping.placing import agrees_with_gps

ENOUGH = 0.95
"""Share of the images that sparse mapping must place, or their priors are tried as well."""

WORSE = 2.0
"""Times by which reprojection errors may be larger where more images are placed."""


def sparse_parts(
    database: Path,
    flight: Flight,
    guessed: Sequence[str],
    told: Array | None,
    workdir: Path,
    seed: int,
    bar: Bar,
    warnings: list[str],
) -> list[Bundle]:
    """Bundles without common images, the largest first: with the focal lengths that the photos tell, if they tell them.

    Over flat ground a focal length without limits may run away, and everything with it; it is let go only where not
    all images could be placed with the one that is told. Where matches are so few that sparse mapping leaves images
    out or contradicts GPS, cameras start where GPS and gimbals say that they are.

    Args:
        database: of verified matches.
        flight: its frames.
        guessed: names of those whose focal length is a guess.
        told: GPS positions [n, 3] in local ENU metres, NaN where unknown; None without GPS.
        workdir: the models are kept here.
        seed: of the mapping.
        bar: (step, unit) -> context manager of a function that takes (done, total).
        warnings: for the user.
    """
    names = [frame.name for frame in flight.frames]
    numbers = {name: i for i, name in enumerate(names)}

    def found(folder: Path, calibrate: bool) -> list[Bundle]:
        models = mapped(database, flight.root, folder, names=names, seed=seed, calibrate=calibrate)
        return [bundle_of(model, numbers) for model in models]

    best = [] if len(guessed) == len(names) else found(workdir / "held", calibrate=False)
    if not (best and len(best[0]) == len(names)):
        free = found(workdir, calibrate=True)
        best = free if not best or (free and len(free[0]) > len(best[0])) else best
    if told is None:
        return best
    placed = len(best[0]) if best else 0
    agrees = bool(best) and agrees_with_gps(best[0], told)
    if agrees and placed >= ENOUGH * len(names):
        return best
    features, lens_ids = read_points(database, names)
    with bar("guided matches", "pairs") as update:
        prior = bundle_by_priors(
            flight.frames, told, features, read_verified(database, names), lens_ids, progress=update
        )
    parts = [] if prior is None else components(prior)
    if not parts or (best and not _better(parts[0], best[0], agrees)):
        return best
    failed = "contradicted GPS" if best and not agrees else f"left out {len(names) - placed} of {len(names)} images"
    warnings.append(
        f"Matches were so few that sparse mapping {failed}: the cameras were started where GPS and gimbals say that "
        "they are, and are only roughly held by the images. Fly with more overlap."
    )
    return parts


def _better(new: Bundle, old: Bundle, agrees: bool) -> bool:
    """Whether a bundle by priors is worth more than one of sparse mapping, which ``agrees`` with GPS or does not."""
    if not agrees:
        return len(new) >= len(old)
    return len(new) > len(old) and float(np.median(new.errors())) < WORSE * float(np.median(old.errors()))
