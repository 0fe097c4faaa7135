"""The steps of a map: named, timed, and kept in ``OUT/work`` so that a map that was stopped goes on where it was.

A step's result is a folder named by a key of everything that it depends on. It is written under another name and
renamed when complete, so a kill at any time loses only the running step.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import resource
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from overfly.errors import Damaged, InputError
from overfly.files import UNREADABLE

T = TypeVar("T")


def key_of(*parts: Any) -> str:
    """Sixteen hexadecimal digits that depend on every part (anything JSON can write, and paths)."""
    text = json.dumps(parts, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def fingerprint(paths: Sequence[Path]) -> list[tuple[str, int, int]]:
    """Name, size and modification time of files: equal while nobody touches them."""
    return [(p.name, p.stat().st_size, p.stat().st_mtime_ns) for p in sorted(paths) if p.is_file()]


def peak_memory_mb() -> float:
    """The most memory that this process or one of its children has held."""
    largest = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return largest / (1024 if sys.platform != "darwin" else 1024**2)


def unwritable(error: OSError, folder: Path) -> str | None:
    """Why nothing could be written, for the user; None where an error has another cause.

    GDAL's errors have no number, so the disk is asked, too.
    """
    free = shutil.disk_usage(folder).free if folder.is_dir() else 0
    if error.errno in (errno.ENOSPC, errno.EDQUOT) or "No space left" in str(error) or free < FULL:
        return f"the disk is full ({free / 1e9:.1f} GB free), make room on it"
    if error.errno in (errno.EROFS, errno.EACCES, errno.EPERM):
        return f"{error.strerror} ({error.filename or folder}), give another folder by --out or the right to write"
    return None


FULL = 4_000_000
"""Free bytes with which a disk counts as full."""


class Steps:
    """Runs steps one after the other, tells them on stderr, and keeps their results.

    Args:
        folder: where results are kept.
        resume: reuse results whose key is the same; False makes them all anew.
        show: print a line for each step and progress bars; False is silent.
    """

    def __init__(self, folder: Path, *, resume: bool, show: bool) -> None:
        self.folder, self.resume = folder, resume
        self.console = Console(stderr=True, quiet=not show, highlight=False, soft_wrap=True)
        self.seconds: dict[str, float] = {}
        self.reused: list[str] = []
        self.running: str | None = None

    def say(self, step: str, text: str) -> None:
        """One line on stderr."""
        self.console.print(f"[bold]{step:>9}[/bold]  {text}")

    @contextmanager
    def timed(self, step: str) -> Iterator[None]:
        """Adds the seconds of the block to the step."""
        self.running, start = step, time.perf_counter()
        try:
            yield
        finally:
            self.seconds[step] = round(self.seconds.get(step, 0.0) + time.perf_counter() - start, 2)
        self.running = None

    def kept(
        self,
        step: str,
        key: str,
        make: Callable[[Path], T],
        write: Callable[[T, Path], None],
        read: Callable[[Path], T],
    ) -> T:
        """The result of a step: read where it is kept under ``key``, made and kept otherwise.

        Args:
            step: its name, also in ``seconds``.
            key: of all that the result depends on (:func:`key_of`).
            make: makes the result; gets a scratch folder of its own that survives a kill, for finished parts.
            write: writes it into a folder.
            read: reads it from a folder; what it cannot read is made anew.
        """
        place, scratch = self.folder / f"{step}-{key}", self.folder / f"{step}-{key}.scratch"
        if self.resume and place.is_dir():
            try:
                with self.timed(step):
                    result = read(place)
            except (Damaged, *UNREADABLE):
                self.say(step, f"{place.name} is damaged and made anew")
                shutil.rmtree(place)
            else:
                self.reused.append(step)
                self.say(step, "[dim]kept from the last run (same images, same settings)[/dim]")
                return result
        if not self.resume:
            shutil.rmtree(scratch, ignore_errors=True)
        with self.timed(step):
            scratch.mkdir(parents=True, exist_ok=True)
            result = make(scratch)
            part = self.folder / f"{step}-{key}.{os.getpid()}.part"
            shutil.rmtree(part, ignore_errors=True)
            part.mkdir()
            write(result, part)
            shutil.rmtree(place, ignore_errors=True)
            os.replace(part, place)
            shutil.rmtree(scratch, ignore_errors=True)
            result = read(place)  # what a resumed map would work with, and not what lay in the scratch folder
        self._forget_old(step)
        return result

    def _forget_old(self, step: str, most: int = 2) -> None:
        """Keep the newest results of a step: more, with ever other settings, would only fill the disk."""
        kept = sorted(self.folder.glob(f"{step}-*"), key=lambda p: p.stat().st_mtime, reverse=True)
        for old in kept[most:]:
            shutil.rmtree(old, ignore_errors=True)

    @contextmanager
    def bar(self, step: str, what: str) -> Iterator[Callable[[int, int], None]]:
        """A progress bar; the block calls it with (done, in all)."""
        columns = (
            TextColumn(f"[bold]{step:>9}[/bold]  {what}"),
            BarColumn(bar_width=30),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
        )
        hidden = self.console.quiet or not self.console.is_terminal  # a log file wants lines, not bars
        with Progress(*columns, console=self.console, transient=True, disable=hidden) as progress:
            task = progress.add_task(what, total=None)

            def update(done: int, total: int) -> None:
                progress.update(task, completed=done, total=total)

            yield update


OWN = (
    "cloud.laz", "cloud.ply", "dsm.tif", "dsm_source.tif", "orthophoto.tif", "mesh.glb", "map.json", "report.html",
    "transforms.json",
)  # fmt: skip


def claim(out: Path, flight: Path, identity: str, *, overwrite: bool) -> Path:
    """Make ``out`` the folder of this flight's map; returns its work folder.

    Args:
        out: the folder of the results.
        flight: the flight folder.
        identity: key of the flight's images, equal when the flight was only moved.
        overwrite: take the folder over from another flight's map, whose kept steps are removed.

    Raises:
        InputError: it holds the map of another flight, files of ours of unknown origin, or is the flight itself.
    """
    out, flight = out.resolve(), flight.resolve()
    if out == flight or out == flight / "images":
        raise InputError(f"--out {out} is the flight itself, which is never written to: give another folder.")
    if out.exists() and not out.is_dir():
        raise InputError(f"--out {out} is a file: give a folder.")
    work = out / "work"
    mark = work / "flight.json"
    if not overwrite:
        if mark.is_file() and {path.name for path in out.iterdir()} | {path.name for path in work.iterdir()} != {
            "work",
            mark.name,
        }:  # one that was refused before it computed anything holds no map
            with contextlib.suppress(json.JSONDecodeError):
                owner: Mapping[str, str] = json.loads(mark.read_text())
                if owner.get("flight") != str(flight) and owner.get("identity") != identity:
                    raise InputError(
                        f"{out} holds the map of another flight, {owner.get('flight')}: "
                        "give another --out folder, or --overwrite to replace it."
                    )
        elif taken := [name for name in OWN if (out / name).exists()]:
            raise InputError(
                f"{out} already holds {', '.join(taken)} of unknown origin: "
                "give another --out folder, or --overwrite to replace it."
            )
    else:
        shutil.rmtree(work, ignore_errors=True)
    try:
        work.mkdir(parents=True, exist_ok=True)
        for stale in [*work.glob("*.part"), *(p for name in OWN for p in out.glob(f".{name}.*"))]:
            shutil.rmtree(stale, ignore_errors=True)  # left behind by a killed process
        mark.write_text(json.dumps({"flight": str(flight), "identity": identity}) + "\n")
    except OSError as error:
        raise InputError(f"--out {out} cannot be written ({error.strerror}): give another folder.") from error
    return work
