"""Files that are either complete or absent."""

from __future__ import annotations

import os
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
from numpy.typing import NDArray

from overfly.errors import Damaged, InputError

UNREADABLE = (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile, zlib.error)
"""What NumPy raises for an .npy or .npz file that is missing, cut off or changed."""


@contextmanager
def replacing(path: Path | str) -> Iterator[Path]:
    """A temporary path beside ``path`` that takes its place when the block ends well, and vanishes when it fails.

    Readers, and a process that is killed in the middle, see the old file or the whole new one. Missing
    folders are made.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # A folder of its own keeps the name and suffix, which writers of meshes and rasters look at.
    folder = Path(mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        temporary = folder / path.name
        yield temporary
        os.replace(temporary, path)
    finally:
        for rest in folder.iterdir():
            rest.unlink()
        folder.rmdir()


def existing(path: Path | str, what: str, suffixes: tuple[str, ...]) -> Path:
    """``path``, if it is a file with one of the ``suffixes``.

    Raises:
        InputError: it is missing, a folder, or of another kind.
    """
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        given = f"{what} {path} ends in {path.suffix!r}" if path.suffix else f"{what} {path} has no file ending"
        raise InputError(f"{given}: give a file that ends in {', '.join(suffixes)}.")
    if not path.exists():
        raise InputError(f"{what} {path} does not exist: check the path.")
    if not path.is_file():
        raise InputError(f"{what} {path} is not a file: give a file that ends in {', '.join(suffixes)}.")
    return path


def save_arrays(path: Path, arrays: Mapping[str, NDArray]) -> None:
    """Write arrays as .npz, uncompressed: complete or absent."""
    part = path.with_name(f"{path.name}.part")
    try:
        with part.open("wb") as file:
            np.savez(file, **dict(arrays))  # type: ignore[arg-type]
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def opened_arrays(path: Path) -> Iterator[Mapping[str, NDArray]]:
    """The arrays of an .npz file, each read, and its checksum compared, when it is asked for.

    Raises:
        Damaged: it is missing, cut off or changed.
    """
    try:
        with path.open("rb") as file, np.load(file) as arrays:
            yield arrays
    except UNREADABLE as error:
        raise Damaged(path) from error


def load_arrays(path: Path) -> dict[str, NDArray]:
    """All arrays of an .npz file.

    Raises:
        Damaged: it is missing, cut off or changed.
    """
    with opened_arrays(path) as arrays:
        return {name: arrays[name] for name in arrays}
