"""The database of a flight's matches: by SIFT, by the encoder of a trained network, or by both."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional as F

from overfly.flights import Flight, Frame
from overfly.geometry import Array, Camera, pose, rotation_from_gimbal
from overfly.mapping.apart import cannot_overlap
from overfly.mapping.database import (
    focal_px,
    match_pairs,
    open_database,
    read_matches,
    read_verified,
    write_matches,
)
from overfly.mapping.encoder_matches import Picture, match_pair, overlay, picture
from overfly.mapping.features import MOST_PARTNERS, SMALL_FLIGHT, features, image_pairs, nearest_pairs
from overfly.mapping.overlays import Prior, apart, by_priors, quarter_turns
from overfly.networks.encoder import Encoder

Bar = Callable[[str, str], AbstractContextManager[Callable[..., Any]]]
Pairs = list[tuple[int, int]]
Matches = dict[tuple[int, int], NDArray[np.uint32]]

MATCHERS = ("auto", "sift", "encoder", "both")

PICTURES = 24
"""Frames that are held in memory at once."""


def matched(
    flight: Flight, told: Array | None, workdir: Path, *, matcher: str, encoder: Encoder | None, seed: int, bar: Bar
) -> tuple[Path, list[str]]:
    """The database with verified matches, and the names of the frames whose focal length is a guess.

    Args:
        flight: its frames.
        told: GPS positions [n, 3], NaN where unknown; None without GPS.
        workdir: SIFT features and matches are kept here, and reused.
        matcher: "sift", "encoder" or "both".
        encoder: of a trained network; not needed by "sift".
        seed: of the verification.
        bar: (step, unit) -> context manager of a function that takes (done, total).
    """
    found: list[tuple[NDArray, NDArray]] = [_nothing() for _ in flight.frames]
    database, matches = workdir / "matches.db", Matches()
    if matcher != "encoder":
        folder = workdir / "features"
        folder.mkdir(exist_ok=True)
        with bar("features", "images") as update:
            for i, frame in enumerate(flight.frames):
                pixels, descriptors = features(frame, folder)
                found[i] = frame.straight(pixels), descriptors
                update(i + 1, len(flight))
        _, guessed = open_database(database, flight, found)
        with bar("pairs", "images") as update:
            pairs = image_pairs(told, [descriptors for _, descriptors in found], update)
        with bar("matches", "pairs") as update:
            _match(database, flight, told, pairs, found, seed, update)
        if matcher == "sift":
            return database, guessed
        matches = read_matches(database, [f.name for f in flight.frames])
    else:
        pairs = image_pairs(told, [descriptors for _, descriptors in found])
    assert encoder is not None
    known = np.zeros(len(flight), bool) if told is None else np.isfinite(told[:, :2]).all(1)
    with bar("correspondences", "pairs") as update:
        pairs = sorted({*pairs, *_alike(flight.frames, np.flatnonzero(~known).tolist(), encoder)})
        also, more = encoder_matches(flight.frames, pairs, encoder, priors=priors(flight.frames, told), progress=update)
    also = [frame.straight(own) for frame, own in zip(flight.frames, also, strict=True)]
    for (i, j), rows in more.items():
        rows = rows + np.array([len(found[i][0]), len(found[j][0])], np.uint32)  # behind the points of SIFT
        matches[i, j] = np.concatenate([matches[i, j], rows]) if (i, j) in matches else rows
    found = [(np.concatenate([own, others]), d) for (own, d), others in zip(found, also, strict=True)]
    database = workdir / f"matches_{matcher}.db"
    return database, write_matches(database, flight, found, matches, seed=seed)


def _match(
    database: Path,
    flight: Flight,
    told: Array | None,
    pairs: Pairs,
    found: Sequence[tuple[NDArray, NDArray]],
    seed: int,
    update: Callable[[int, int], None],
) -> None:
    """Match the nearest pairs, then of the others those that may see common ground by what these have shown."""
    names = [frame.name for frame in flight.frames]
    asked = [] if told is None or len(names) <= SMALL_FLIGHT else _second_ring(pairs, told)
    first = sorted(set(pairs) - set(asked))
    match_pairs(database, names, first, seed=seed, progress=lambda done, _: update(done, len(pairs)))
    if not asked:
        return
    assert told is not None
    # Of the first ring alone, whatever an interrupted run has matched besides: the same pairs are asked for again.
    verified = {
        (i, j): (found[i][0][rows[:, 0]], found[j][0][rows[:, 1]])
        for (i, j), rows in read_verified(database, names).items()
        if (i, j) in set(first)
    }
    apart = cannot_overlap(asked, told[:, :2], [(f.width, f.height) for f in flight.frames], verified)
    rest = [pair for pair in asked if pair not in apart]
    ready = len(pairs) - len(rest)
    match_pairs(database, names, rest, seed=seed, progress=lambda done, _: update(ready + done, len(pairs)))
    update(len(pairs), len(pairs))


def _second_ring(pairs: Pairs, told: Array) -> Pairs:
    """Pairs of frames with GPS that do not follow one another, nor are the nearest in any direction."""
    known = np.asarray(np.isfinite(told[:, :2]).all(1))
    first = nearest_pairs(told, 1)
    return [(i, j) for i, j in pairs if j - i > 1 and known[i] and known[j] and (i, j) not in first]


def encoder_matches(
    frames: Sequence[Frame],
    pairs: Sequence[tuple[int, int]],
    encoder: Encoder,
    *,
    priors: Sequence[Prior | None],
    progress: Callable[[int, int], None],
) -> tuple[list[Array], Matches]:
    """Key points and matches of pairs of frames, both ways.

    A frame's own key points are looked for in all its partners, so that its tracks are as long as its partners are
    many; where they were found in it, the partners' key points follow.

    Returns:
        Pixels [n_k, 2] of each frame, and for the pairs (i, j), i < j, rows of indices into them [m, 2].
    """

    @lru_cache(maxsize=PICTURES)
    def look(k: int) -> Picture:
        return picture(encoder, frames[k].image(), priors[k])

    proven: set[int] = set()

    def lying(i: int, j: int) -> Array | None:
        """How frame j lies on frame i: where both have matched as their priors say, nothing else is tried."""
        told = by_priors(priors[i], priors[j])
        sure = bool(told) and {i, j} <= proven
        if sure and apart(priors[i], priors[j]):
            return None
        found = overlay(encoder, look(i), look(j), told) if told else None
        if found is not None:
            proven.update((i, j))
        elif not sure:
            found = overlay(encoder, look(i), look(j), quarter_turns(look(i).size, look(j).size))
        return found

    pixels = [[look(k).points] for k in range(len(frames))]
    count = [len(own[0]) for own in pixels]
    matches: Matches = {}
    for done, (i, j) in enumerate(pairs):
        seen_as = lying(i, j)
        if seen_as is not None:
            rows = []
            for a, b, view in ((i, j, seen_as), (j, i, np.asarray(np.linalg.inv(seen_as)))):
                found = match_pair(encoder, look(a), look(b), view)
                there = count[b] + np.arange(len(found.rows))
                pixels[b].append(found.pixels)
                count[b] += len(found.rows)
                rows.append(np.column_stack([found.rows, there] if a == i else [there, found.rows]))
            matches[i, j] = np.concatenate(rows).astype(np.uint32)
        progress(done + 1, len(pairs))
    return [np.concatenate(parts) for parts in pixels], matches


def priors(frames: Sequence[Frame], told: Array | None) -> list[Prior | None]:
    """Where each frame was roughly taken from: by GPS, gimbal and the height above the ground, if all are known."""
    found: list[Prior | None] = []
    for k, frame in enumerate(frames):
        focal, above = focal_px(frame), frame.relative_altitude
        if told is None or np.isnan(told[k, :2]).any() or frame.gimbal is None or focal is None or not (above or 0) > 0:
            found.append(None)
            continue
        camera = Camera(frame.width, frame.height, focal, focal, frame.width / 2, frame.height / 2)
        found.append(Prior(camera, pose(rotation_from_gimbal(*frame.gimbal), [*told[k, :2], above])))
    return found


@torch.no_grad()
def _alike(frames: Sequence[Frame], asking: Sequence[int], encoder: Encoder) -> Pairs:
    """The most alike partners, by the encoder's global descriptors, of frames of which nothing else is known."""
    import cv2

    if not asking:
        return []
    images = [cv2.resize(frame.image(), encoder.size, interpolation=cv2.INTER_AREA) for frame in frames]
    batch = torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2).float() / 255
    descriptors = torch.cat([encoder(part).descriptor for part in batch.split(16)])
    likeness = F.normalize(descriptors) @ F.normalize(descriptors).T
    likeness.fill_diagonal_(-torch.inf)
    best = likeness.topk(min(MOST_PARTNERS, len(frames) - 1)).indices
    return [(min(i, j), max(i, j)) for i in asking for j in best[i].tolist()]


def _nothing() -> tuple[NDArray, NDArray]:
    return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8)
