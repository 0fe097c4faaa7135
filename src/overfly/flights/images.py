"""Image files: finding them, natural order, and a cheap test that a file is complete."""

from __future__ import annotations

import re
from pathlib import Path
from typing import BinaryIO

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
TAIL = 1 << 16


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sorts "img_9" before "img_10"."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", name.lower()) if part]


def list_images(folder: Path) -> list[Path]:
    """Image files directly in a folder, by natural name order; hidden files are left out."""
    if not folder.is_dir():
        return []
    found = [p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith(".") and p.is_file()]
    return sorted(found, key=lambda p: natural_key(p.name))


def defect(path: Path) -> str | None:
    """Why the image file cannot be used, or None: header and end are looked at, pixels are decoded only in doubt.

    Damage in the middle of a file is only found when the image is loaded.
    """
    size = path.stat().st_size
    if size == 0:
        return "empty file"
    if not path.stat().st_mode & 0o444:
        return "not readable"
    suffix = path.suffix.lower()
    with path.open("rb") as file:
        head = file.read(4)
        if head[:2] == b"\xff\xd8":
            start = _scan_start(file, size)
            if start is None:
                return "truncated JPEG"
            file.seek(max(start, size - TAIL))
            if b"\xff\xd9" in file.read():
                return None
        elif head == b"\x89PNG":
            file.seek(max(0, size - 32))
            if b"IEND" in file.read():
                return None
        elif suffix in SUFFIXES[:3]:
            return f"not a {suffix[1:].upper()} file"
    return _decode(path)


def _scan_start(file: BinaryIO, size: int) -> int | None:
    """Offset of the compressed pixels of a JPEG; None where the headers end before them."""
    offset = 2
    while offset + 4 <= size:
        file.seek(offset)
        marker = file.read(4)
        if len(marker) < 4 or marker[0] != 0xFF:
            return None
        if marker[1] == 0xFF:  # fill byte
            offset += 1
            continue
        length = int.from_bytes(marker[2:], "big")
        if marker[1] == 0xDA:
            return offset + 2 + length if offset + 2 + length < size else None
        offset += 2 + length
    return None


def _decode(path: Path) -> str | None:
    import warnings

    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path) as image:
                image.load()
    except (OSError, SyntaxError, ValueError, EOFError) as error:
        return str(error).split("\n")[0] or "cannot be decoded"
    return None
