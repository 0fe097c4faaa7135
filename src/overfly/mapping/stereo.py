"""Dense depth by classical stereo: rectified pairs, semi-global matching, consensus of pairs, sub-pixel correlation.

Pairs are matched at half the working size, which costs an eighth of the time; but not under 800 pixels, where roofs and
walls would be lost (recall at 1 m 0.64 instead of 0.70 on 800-pixel images of a suburb). The last pixel comes from the
correlation of full-size images around each depth (:mod:`overfly.mapping.subpixel`), in which all neighbouring frames
take part. Everything finished is kept in the work folder, so that a killed run goes on; memory holds a few frames at a
time whatever the size of the flight.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from overfly.errors import Damaged, InputError
from overfly.files import UNREADABLE, load_arrays, save_arrays
from overfly.flights import Frame
from overfly.geometry import Array, Camera, unproject
from overfly.mapping.coarse import coarse_points
from overfly.mapping.consensus import consensus
from overfly.mapping.depth_map import DepthMap, Map, Opinion
from overfly.mapping.depth_ranges import Span, depth_ranges
from overfly.mapping.matcher import depth_in_frame, disparities, right_disparities
from overfly.mapping.needs import SIZE
from overfly.mapping.neighbours import FURTHER, choose_partners, is_wide
from overfly.mapping.rectify import Rectified, ordered, rectify, relief_of
from overfly.mapping.seen_heights import narrowed
from overfly.mapping.subpixel import refine
from overfly.mapping.threads import in_threads
from overfly.mapping.views import Views

Opinions = Callable[[int, list[int], Array], Opinion | None]
"""What a network says of a frame, given its partners and surface points [M, 3] that its pairs have measured."""

Progress = Callable[[int, int], None]
BASE_TO_HEIGHT = (0.04, 2.0)
DISPARITY_SIGMA = 0.4
"""Standard deviation of a semi-global disparity, pixels of the matched size."""

REFINED_SIGMA = 0.25
"""The same after refinement, pixels of the full size."""

SURE = 0.6
"""Correlation from which on a refined depth is taken for measured before any other frame confirms it."""

ASKED = 4
"""Partners with which a network compares a frame, at most, however many neighbours are asked: it was trained so."""

AHEAD = 2
"""Frames that are begun for each worker before the first of them is finished."""


def stereo(
    frames: Sequence[Frame],
    *,
    workdir: Path,
    points: Array | None = None,
    max_size: int = SIZE,
    neighbours: int = 4,
    seed: int = 0,
    opinions: Callable[[Views, Array], Opinions] | None = None,
    workers: int = 1,
    progress: Progress | None = None,
) -> list[DepthMap]:
    """Depth maps of all frames that have a partner.

    Args:
        frames: with cameras, in one frame of reference, z up.
        workdir: parts and results are kept here; give one folder per set of cameras and settings.
        points: sparse surface points [M, 3], for the depth ranges; None takes a coarse look first.
        max_size: longest side of the depth maps, pixels.
        neighbours: most partners of a frame, but for wide ones (:mod:`overfly.mapping.neighbours`).
        seed: of the coarse look's sample.
        opinions: a network's say in each frame's depth, made from the views and the surface points [M, 3].
        workers: frames that are worked on side by side; what comes out does not depend on it.
        progress: called with (frames done, frames in all).

    Raises:
        InputError: fewer than two frames, or no two that overlap.
    """
    if len(frames) < 2:
        raise InputError(f"Stereo needs at least two frames with cameras, not {len(frames)}: give more images.")
    workdir.mkdir(parents=True, exist_ok=True)
    surface = coarse_points(frames, seed=seed) if points is None or len(points) < 20 else np.asarray(points, float)
    flight = Views(frames, max_size)
    ranges = depth_ranges(flight.full, flight.poses, surface)
    ask = None if opinions is None else opinions(flight, surface)
    partners = choose_partners(flight.full, flight.poses, ranges, count=neighbours, ratio=BASE_TO_HEIGHT)
    pairs = sorted({(min(i, j), max(i, j)) for i, chosen in enumerate(partners) for j in chosen})

    def looks_wide(i: int, j: int) -> bool:
        return is_wide(flight.full[i], flight.poses[i], ranges[i].middle, flight.poses[j])

    if not pairs:
        raise InputError(
            "No two frames see the same ground from places far enough apart for stereo: "
            "fly with 30 % overlap or more, or check the cameras."
        )
    wide_pairs = {(i, j) for i, j in pairs if looks_wide(i, j) or looks_wide(j, i)}
    asked_of = sorted({i for pair in wide_pairs for i in pair})
    narrow = narrowed(flight, ranges, partners, asked_of, workdir / "heights.npz", workers) if wide_pairs else ranges
    searched = {pair: narrow if pair in wide_pairs else ranges for pair in pairs}
    waiting: dict[int, list[tuple[int, int]]] = {i: [] for i in range(len(frames))}
    for pair in pairs:
        for i in pair:
            waiting[i].append(pair)
    _drop_damaged(workdir)

    def match(pair: tuple[int, int]) -> None:
        if not _pair_file(workdir, pair).is_file():
            _match(flight, pair, searched[pair], workdir)

    def measure(i: int, ready: Sequence[Future[None]]) -> None:
        for one in ready:  # they were asked for before, so that somebody is at them or has done them
            one.result()
        # Correlate with frames that took part, the chosen ones first, wide ones last.
        took_part = partners[i] + [j for j in _all(waiting[i], i) if j not in partners[i]]
        wide = [j for j in took_part if looks_wide(i, j)]
        near = [j for j in took_part if j not in wide][:neighbours]
        chosen = near + wide[: neighbours + FURTHER - len(near)]
        matched = [(pair, searched[pair]) for pair in waiting[i]]
        _depth(flight, i, matched, chosen, ranges[i], workdir, _depth_file(workdir, i), ask)

    asked = [i for i in range(len(frames)) if waiting[i]]
    with in_threads(workers) as pool:
        matches: dict[tuple[int, int], Future[None]] = {}
        running: dict[int, Future[None]] = {}
        for done, i in enumerate(asked):
            for k in asked[done : done + AHEAD * workers]:
                if k not in running and not _depth_file(workdir, k).is_file():
                    matches |= {pair: pool.submit(match, pair) for pair in waiting[k] if pair not in matches}
                    running[k] = pool.submit(measure, k, [matches[pair] for pair in waiting[k]])
            if i in running:
                running.pop(i).result()
            for pair in waiting[i]:
                if pair[1] == i:  # the later of the two frames: nobody needs it any more
                    matches.pop(pair, None)
                    _pair_file(workdir, pair).unlink(missing_ok=True)
            if progress:
                progress(i + 1, len(frames))
    return [
        DepthMap(
            frames[i].name,
            flight.full[i],
            flight.poses[i],
            [frames[j].name for j in _all(waiting[i], i)],
            _depth_file(workdir, i),
        )
        for i in asked
    ]


def _drop_damaged(workdir: Path) -> None:
    """Remove what an earlier run left that cannot be read: it is made again."""
    for path in workdir.glob("depth-*.npz"):
        try:
            load_arrays(path)
        except Damaged:
            path.unlink()
    for path in workdir.glob("pair-*.npy"):
        try:
            with path.open("rb") as file:
                np.load(file)
        except UNREADABLE:
            path.unlink()


def _sample(depth: Map, camera: Camera, world_from_camera: Array, step: int = 8) -> Array:
    """World points [M, 3] of every eighth pixel, each way, whose depth is known."""
    rows, columns = (
        k[np.isfinite(depth[::step, ::step])] * step
        for k in np.mgrid[: -(-depth.shape[0] // step), : -(-depth.shape[1] // step)]
    )
    return unproject(np.stack([columns + 0.5, rows + 0.5], 1), depth[rows, columns], camera, world_from_camera)


def _all(pairs: list[tuple[int, int]], i: int) -> list[int]:
    return [j for pair in pairs for j in pair if j != i]


def _depth_file(workdir: Path, i: int) -> Path:
    return workdir / f"depth-{i:05d}.npz"


def _pair_file(workdir: Path, pair: tuple[int, int]) -> Path:
    return workdir / f"pair-{pair[0]:05d}-{pair[1]:05d}.npy"


def _layout(flight: Views, pair: tuple[int, int], ranges: list[Span]) -> tuple[int, int, Rectified | None]:
    """Left frame, right frame and their rectification, None where it is not possible."""
    i, j = pair if ordered((flight.poses[pair[0]], flight.poses[pair[1]])) else pair[::-1]
    here, there = ranges[i], ranges[j]
    layout = rectify(
        (flight.matched_lens[i], flight.matched_lens[j]),
        (flight.poses[i], flight.poses[j]),
        ((here.near, here.far), (there.near, there.far)),
        relief_of(here, there),
    )
    return i, j, layout


def _match(flight: Views, pair: tuple[int, int], ranges: list[Span], workdir: Path) -> None:
    """Match a pair and keep the left canvas's disparities; an empty file where nothing can be matched."""
    i, j, layout = _layout(flight, pair, ranges)
    found = np.zeros((0, 0), np.int16)
    if layout is not None:
        found = disparities(
            (flight.matched_gray(i), flight.matched_gray(j)),
            (flight.matched_lens[i], flight.matched_lens[j]),
            (flight.poses[i], flight.poses[j]),
            layout,
        )
    path = _pair_file(workdir, pair)
    part = path.with_suffix(".part")
    with part.open("wb") as file:
        np.save(file, found)
    part.replace(path)


def _at_full_size(
    flight: Views, i: int, chosen: list[int], depth: Map, support: NDArray[np.uint8]
) -> dict[str, NDArray]:
    """A depth map of the matched size, refined at full size: depth, sigma, support and score."""
    import cv2

    size = (flight.full[i].width, flight.full[i].height)
    if not np.isfinite(depth).any():
        nothing = np.full(size[::-1], np.nan, np.float32)
        none = np.zeros(nothing.shape, np.uint8)
        return {"depth": nothing, "sigma": nothing, "support": none, "score": np.full_like(nothing, -1)}
    large = cv2.resize(depth, size, interpolation=cv2.INTER_LINEAR)
    support = np.asarray(cv2.resize(support, size, interpolation=cv2.INTER_NEAREST))
    refined = refine(flight.shot(i), [flight.shot(j) for j in chosen], large, steps=(-1, -0.5, 0, 0.5, 1), best=2)
    support[~np.isfinite(refined.depth)] = 0
    sigma = refined.step * np.float32(REFINED_SIGMA)
    return {"depth": refined.depth, "sigma": sigma, "support": support, "score": refined.score}


def _depth(
    flight: Views,
    i: int,
    pairs: list[tuple[tuple[int, int], list[Span]]],
    chosen: list[int],
    span: Span,
    workdir: Path,
    path: Path,
    ask: Opinions | None,
) -> None:
    """Merge the pairs of a frame and the network's opinion, refine the depth at full size and keep it."""
    import cv2

    depths: list[Map] = []
    sigmas: list[Map] = []
    floor = span.floor(flight.matched[i], flight.poses[i])
    for pair, ranges in pairs:
        match = np.load(_pair_file(workdir, pair))
        left, _, layout = _layout(flight, pair, ranges)
        if layout is None or not match.size:
            continue
        seen = match if left == i else right_disparities(match)
        depth = depth_in_frame(seen, flight.matched[i], flight.poses[i], layout, right=left != i)
        depth = np.where(depth < floor, depth, np.float32(np.nan))
        depths.append(depth)
        sigmas.append(layout.sigma(depth, DISPARITY_SIGMA))
    small = flight.matched[i]
    shape = small.height, small.width
    if depths:
        depth, _, support = consensus(depths, sigmas)
    else:
        depth, support = np.full(shape, np.nan, np.float32), np.zeros(shape, np.uint8)
    full = _at_full_size(flight, i, chosen, depth, support)
    paired = np.isfinite(full["depth"])
    opinion = None if ask is None else ask(i, chosen[:ASKED], _sample(depth, small, flight.poses[i]))
    if opinion is not None:
        # It has no vote where pairs were matched: with its wide sigma it would agree with wrong matches, too. A veto it
        # has, when maps are compared.
        said = cv2.resize(opinion.depth, shape[::-1], interpolation=cv2.INTER_LINEAR)
        seen_again = cv2.resize(opinion.views, shape[::-1], interpolation=cv2.INTER_NEAREST) >= 2
        fill = ~np.isfinite(depth) & seen_again & np.isfinite(said)
        # The network is less exact than a pair: it may be off by more than the last step's pixel.
        others = [flight.matched_shot(j) for j in chosen]
        guess = np.where(fill, said, np.float32(np.nan))
        moved = refine(flight.matched_shot(i), others, guess, steps=(-2, -1, 0, 1, 2))
        filled = _at_full_size(flight, i, chosen, moved.depth, np.isfinite(moved.depth).astype(np.uint8))
        full = {name: np.where(paired, values, filled[name]) for name, values in full.items()}
        doubted = opinion.resized(*paired.shape[::-1]).contradicts(full["depth"], full["support"])
        surely = (full["score"] >= SURE) & (full["support"] >= 1) & ~doubted
        sure = np.where(surely, full["depth"], np.float32(np.nan))
        opinion = opinion.settled(sure, flight.full[i], flight.poses[i])
    kept = {
        "depth": full["depth"],
        "sigma": full["sigma"].astype(np.float16),
        "support": full["support"],
        "score": np.round(np.clip(np.nan_to_num(full["score"], nan=-1), -1, 1) * 100).astype(np.int8),
        "paired": paired,
    }
    if opinion is not None:
        kept |= {f"opinion_{name}": value for name, value in vars(opinion).items()}
    save_arrays(path, kept)
