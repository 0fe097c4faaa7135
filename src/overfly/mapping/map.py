"""One flight becomes a map: read, align, dense cloud, rasters, report. The order of things, and nothing else."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from overfly import __version__
from overfly.errors import InputError
from overfly.flights import Flight, read_calibration, read_flight, with_calibration
from overfly.geodesy import crs_code
from overfly.mapping.block import Block, checked, read_block, write_block
from overfly.mapping.calibration import source_remarks
from overfly.mapping.deliver import deliver
from overfly.mapping.dense import how_dense, memory_budget, stereo_cloud, sweep_cloud
from overfly.mapping.given import given_block
from overfly.mapping.heights import check_heights, check_place, with_heights
from overfly.mapping.needs import SIZE, Sizes, least_gb
from overfly.mapping.report import count_text
from overfly.mapping.settings import MapSettings
from overfly.mapping.steps import Steps, claim, fingerprint, key_of, unwritable
from overfly.mapping.tiles import Tiles, keep_tiles, kept_tiles

BLOCK_FORM, DENSE_FORM = 30, 31
"""Of what the steps keep, half-finished parts included: raised whenever the same images and settings become another
block, or the same block another cloud, so that a map resumed from an older version's folder mixes nothing."""


def map_flight(flight_folder: Path | str, *, out: Path | str, **settings: Any) -> dict[str, Any]:
    """Map a flight: write the products into ``out`` and return the content of ``map.json``.

    Args:
        flight_folder: a flight folder, or a plain folder of images.
        out: folder of the results; finished steps are kept in ``out/work``.
        **settings: see :class:`MapSettings`.

    Raises:
        InputError: the flight cannot be mapped, or ``out`` belongs to another one.
    """
    flight, steps, identity, asked = _opened(flight_folder, out, settings)
    check_memory([(frame.width, frame.height) for frame in flight.frames], asked)
    with _told_when_stopped(steps):
        block, key = _aligned(flight, identity, asked, steps)
        check_heights(block)
        local = _measured(flight, block, key, asked, steps)
        held = memory_budget(block, asked)
        return deliver(flight, block, local, Path(out), asked, steps, window=held.window, sample=held.sample)


def align_flight(flight_folder: Path | str, *, out: Path | str, **settings: Any) -> tuple[Flight, Block]:
    """The flight and its cameras, given or estimated, and nothing dense; arguments as :func:`map_flight`."""
    flight, steps, identity, asked = _opened(flight_folder, out, settings)
    with _told_when_stopped(steps):
        return flight, _aligned(flight, identity, asked, steps)[0]


def measure_flight(flight_folder: Path | str, *, out: Path | str, **settings: Any) -> tuple[Flight, Block, Tiles]:
    """The flight, its cameras and the dense cloud in their frame, without products; arguments as :func:`map_flight`."""
    flight, steps, identity, asked = _opened(flight_folder, out, settings)
    check_memory([(frame.width, frame.height) for frame in flight.frames], asked)
    with _told_when_stopped(steps):
        block, key = _aligned(flight, identity, asked, steps)
        return flight, block, _measured(flight, block, key, asked, steps)


def _opened(
    flight_folder: Path | str, out: Path | str, settings: dict[str, Any]
) -> tuple[Flight, Steps, str, MapSettings]:
    asked = MapSettings(**settings)
    flight_folder, out = Path(flight_folder), Path(out)
    start = time.perf_counter()
    flight = read_flight(flight_folder)
    identity = key_of(fingerprint([f.path for f in flight.frames]), _camera_files(flight_folder))
    work = claim(out, flight_folder, identity, overwrite=asked.overwrite)
    steps = Steps(work, resume=asked.resume, show=asked.progress)
    steps.seconds["images"] = round(time.perf_counter() - start, 2)
    return flight, steps, identity, asked


@contextmanager
def _told_when_stopped(steps: Steps) -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt:
        kept = sorted({p.name.rsplit("-", 1)[0] for p in steps.folder.iterdir() if p.is_dir() and p.suffix == ""})
        steps.say(
            "stopped",
            f"during {steps.running or 'the start'}; kept: {', '.join(kept) or 'nothing yet'}. "
            "The same command goes on from there.",
        )
        raise
    except OSError as error:
        if (reason := unwritable(error, steps.folder)) is None:
            raise
        raise InputError(
            f"{steps.folder.parent} cannot be written during {steps.running or 'the start'}: {reason}. What is "
            "finished is kept, and the same command goes on from there."
        ) from error


def _aligned(flight: Flight, identity: str, asked: MapSettings, steps: Steps) -> tuple[Block, str]:
    """The block and the key of everything it depends on."""
    estimate = asked.cameras == "estimate" or (asked.cameras == "auto" and flight.cameras_from is None)
    check_place(flight, asked.heights, estimate=estimate, control=asked.control)
    steps.say("images", _about(flight))
    ruled = [asked.control] if flight.gcps and asked.control != "split" else []
    if asked.calibration is not None:
        if not estimate:
            raise InputError(
                f"The flight has cameras of its own ({flight.cameras_from}), so that --calibration {asked.calibration} "
                "would not be used: add --cameras estimate, or leave it out."
            )
        flight = with_calibration(flight, read_calibration(asked.calibration), asked.calibration)
        steps.say("lens", f"kept from {asked.calibration}: {_focal_text(flight)}")
    lenses = sorted({repr(f.calibration) for f in flight.frames if f.calibration is not None})
    matched = [asked.seed, *ruled, *asked.matcher_key(), *lenses]
    key = key_of(__version__, BLOCK_FORM, identity, estimate, matched if estimate else (ruled or None))
    block = steps.kept(
        "cameras",
        key,
        lambda scratch: (
            estimated_block(flight, scratch, asked, steps) if estimate else given_block(flight, asked.control)
        ),
        write_block,
        lambda folder: read_block(folder, flight),
    )
    if asked.calibration is not None:  # not kept with the block: another path may hold the same camera
        block = replace(block, warnings=[*block.warnings, *source_remarks(asked.calibration)])
    block = with_heights(block, asked.heights)
    steps.say("cameras", _about_block(block, flight))
    return block, key


def _measured(flight: Flight, block: Block, key: str, asked: MapSettings, steps: Steps) -> Tiles:
    """The dense cloud of a block, whose own key is given."""
    network = asked.network_key() if asked.dense == "sweep" else None
    key = key_of(key, DENSE_FORM, asked.dense, network, asked.seed, *([] if asked.size == SIZE else [asked.size]))
    make: Callable[[Path], Tiles] = {
        "sweep": lambda scratch: sweep_cloud(block, flight, scratch, asked, steps),
        "stereo": lambda scratch: stereo_cloud(block, scratch, asked, steps),
    }[asked.dense]
    local = steps.kept("dense", key, make, keep_tiles, kept_tiles)
    steps.say("dense", f"{count_text(len(local))} points by {how_dense(asked)}")
    return local


def check_memory(sizes: Sizes, asked: MapSettings) -> None:
    """Refuse before the work starts what would not fit, by the estimate of :mod:`overfly.mapping.needs`.

    Args:
        sizes: widths and heights of the images, pixels.
        asked: the settings.

    Raises:
        InputError: more than ``max_memory_gb`` would be needed.
    """
    needed = least_gb(sizes, asked.size, network=asked.dense == "sweep")
    if asked.max_memory_gb is not None and needed > asked.max_memory_gb:
        raise InputError(
            f"Mapping images of this size takes {np.ceil(10 * needed) / 10:.1f} GB at the least, more than "
            f"--max-memory {asked.max_memory_gb:g}: allow so much, or match at a smaller --size than {asked.size}."
        )


def estimated_block(flight: Flight, scratch: Path, asked: MapSettings, steps: Steps) -> Block:
    """Cameras estimated from the images."""
    from overfly.mapping.align import align

    def encoder() -> Any:
        assert asked.run is not None
        return asked.run.network.encoder

    return checked(
        align(
            flight,
            workdir=scratch,
            seed=asked.seed,
            bar=steps.bar,
            matcher=asked.matcher,
            encoder=None if asked.network is None else encoder,
            control=asked.control,
        ),
        flight,
    )


def _about(flight: Flight) -> str:
    gps = sum(f.gps is not None for f in flight.frames)
    text = f"{len(flight)} images, {gps} with GPS"
    return text if not flight.skipped else f"{text}; skipped: {', '.join(flight.skipped)}"


def _about_block(block: Block, flight: Flight) -> str:
    where = "estimated from the images" if block.cameras_from == "estimated" else f"given by {block.cameras_from}"
    text = f"{where}: {len(block.frames)} of {len(flight)} images placed"
    if block.reprojection_px is not None:
        text += f", {block.reprojection_px:.2f} px"
    if block.origin is not None and block.metric:
        return f"{text}, {crs_code(block.origin.crs_epsg, block.origin.vertical_epsg)}"
    return f"{text}, local frame" if block.metric else f"{text}, metric scale unknown"


def _focal_text(flight: Flight) -> str:
    """The focal lengths of the calibrations that are kept."""
    kept = sorted({round(f.pinhole.fx) for f in flight.frames if f.pinhole is not None})
    return f"focal length {', '.join(map(str, kept))} px"


def _camera_files(root: Path) -> list[tuple[str, int, int]]:
    names = ("transforms.json", "reconstruction.json", "geo.txt", "gcp_list.txt")
    models = [path for folder in ("sparse", "sparse/0") for path in (root / folder).glob("*") if path.is_file()]
    return fingerprint([root / n for n in names] + models)
