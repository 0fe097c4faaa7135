"""PLY files: ascii and binary, of any scalar types, into columns and triangles."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from overfly.errors import InputError
from overfly.files import replacing

CODES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
CODES |= {"float": "f4", "double": "f8"}
SIZED = {f"{kind}{bits}": f"{kind[0]}{bits // 8}" for kind in ("int", "uint") for bits in (8, 16, 32)}
TYPES = CODES | SIZED | {"float32": "f4", "float64": "f8"}
NAMES = {code: name for name, code in CODES.items()}
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}


@dataclass
class Ply:
    """The vertices' columns (each [V], by property name), triangles [F, 3] int32 or None, and the comments."""

    columns: dict[str, NDArray]
    faces: NDArray[np.int32] | None = None
    comments: list[str] = field(default_factory=list)


@dataclass
class _Element:
    name: str
    count: int
    properties: list[tuple[str, str, str | None]] = field(default_factory=list)  # name, type, type of a list's length

    @property
    def has_lists(self) -> bool:
        return any(length for _, _, length in self.properties)


def read_ply(path: Path | str) -> Ply:
    """Read a PLY file; polygons become triangle fans.

    Raises:
        InputError: the file is no PLY, broken or shorter than its header says.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            order, elements, comments = _header(file)
            body = file.read()
        rows = _ascii(body, elements) if order == "=" else _binary(body, elements, order)
    except (ValueError, KeyError, IndexError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path} is not a readable PLY file ({error}): write it again or give another file."
        ) from error
    if "vertex" not in rows:
        raise InputError(f"{path} is a PLY file without vertices: give a point cloud or a mesh.")
    faces = None
    if "face" in rows:
        corners = [v for k, v in rows["face"].items() if k in ("vertex_indices", "vertex_index")]
        faces = _triangles(corners[0]) if corners else None
    return Ply(rows["vertex"], faces, comments)


def write_ply(
    path: Path | str,
    columns: dict[str, NDArray],
    faces: NDArray | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Write a binary little-endian PLY file, atomically; a column keeps its type."""
    count = len(next(iter(columns.values())))
    write_ply_tables(path, [columns], count, faces, comments)


def write_ply_tables(
    path: Path | str,
    tables: Iterable[dict[str, NDArray]],
    count: int,
    faces: NDArray | None = None,
    comments: Sequence[str] = (),
) -> None:
    """As :func:`write_ply`, of vertices that come in several tables of the same columns, ``count`` in all."""
    with replacing(path) as temporary, temporary.open("wb") as file:
        for number, columns in enumerate(tables):
            kinds = [(name, "<" + column.dtype.str[1:]) for name, column in columns.items()]
            if number == 0:
                header = ["ply", "format binary_little_endian 1.0", *(f"comment {c}" for c in comments)]
                header += [f"element vertex {count}"]
                header += [f"property {NAMES[kind[1:]]} {name}" for name, kind in kinds]
                if faces is not None:
                    header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
                file.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii"))
            table = np.empty(len(next(iter(columns.values()))), kinds)
            for name, column in columns.items():
                table[name] = column
            file.write(table.tobytes())
        if faces is not None:
            corners = np.empty(len(faces), [("n", "u1"), ("v", "<i4", 3)])
            corners["n"], corners["v"] = 3, faces
            file.write(corners.tobytes())


def _header(file: io.BufferedReader) -> tuple[str, list[_Element], list[str]]:
    if file.readline(100).strip() != b"ply":
        raise ValueError("it does not begin with 'ply'")
    order, elements, comments = "", [], []
    while line := file.readline(10_000):
        words = line.decode("latin-1").split()
        match words:
            case ["format", kind, _]:
                order = ORDERS[kind]
            case ["comment" | "obj_info", *rest]:
                comments.append(" ".join(rest))
            case ["element", name, count]:
                elements.append(_Element(name, int(count)))
                if elements[-1].count < 0:
                    raise ValueError(f"{count} rows of {name}")
            case ["property", "list", length, kind, name]:
                elements[-1].properties.append((name, TYPES[kind], TYPES[length]))
            case ["property", kind, name]:
                elements[-1].properties.append((name, TYPES[kind], None))
            case ["end_header"]:
                if not order:
                    raise ValueError("its header names no format")
                return order, elements, comments
            case []:
                pass
            case _:
                raise ValueError(f"header line {' '.join(words)!r}")
    raise ValueError("its header has no end")


def _ascii(body: bytes, elements: list[_Element]) -> dict[str, dict]:
    lines = [line for line in body.decode("latin-1").split("\n") if line.strip()]
    rows: dict[str, dict] = {}
    at = 0
    for element in elements:
        part = lines[at : at + element.count]
        at += element.count
        if len(part) < element.count:
            raise ValueError(f"{element.count} rows of {element.name} announced, {len(part)} found")
        if not element.has_lists:
            # float64 holds every value of the narrower types exactly.
            table = np.loadtxt(part, ndmin=2) if part else np.empty((0, len(element.properties)))
            if table.shape[1] != len(element.properties):
                raise ValueError(f"{table.shape[1]} values in a row of {element.name}")
            rows[element.name] = {
                name: table[:, i].astype(kind) for i, (name, kind, _) in enumerate(element.properties)
            }
            continue
        columns: dict[str, list] = {name: [] for name, _, _ in element.properties}
        for line in part:
            words = iter(line.split())
            for name, kind, length in element.properties:
                taken = [next(words, None) for _ in range(int(next(words, "")) if length else 1)]
                if None in taken:
                    raise ValueError(f"a row of {element.name} is too short")
                value = np.array(taken, float).astype(kind)
                columns[name].append(value if length else value[0])
        rows[element.name] = columns
    return rows


def _binary(body: bytes, elements: list[_Element], order: str) -> dict[str, dict]:
    rows, at = {}, 0
    for element in elements:
        if not element.has_lists:
            kind = np.dtype([(name, order + kind) for name, kind, _ in element.properties])
            table, at = _take(body, at, kind, element), at + kind.itemsize * element.count
            rows[element.name] = {
                name: table[name].astype(table[name].dtype.newbyteorder("=")) for name, _, _ in element.properties
            }
        else:
            rows[element.name], at = _binary_lists(body, at, element, order)
    return rows


def _take(body: bytes, at: int, kind: np.dtype, element: _Element) -> NDArray:
    if at + kind.itemsize * element.count > len(body):
        raise ValueError(f"it ends within its {element.count} rows of {element.name}")
    return np.frombuffer(body, kind, element.count, at)


def _binary_lists(body: bytes, at: int, element: _Element, order: str) -> tuple[dict, int]:
    """Rows of varying length: at once where all have the length of the first, else one by one."""
    if element.count and len(element.properties) == 1:
        name, kind, length = element.properties[0]
        first = int(np.frombuffer(body, order + str(length), 1, at)[0])
        row = np.dtype([("n", order + str(length)), ("v", order + kind, (first,))])
        if at + row.itemsize * element.count <= len(body):
            table = np.frombuffer(body, row, element.count, at)
            if (table["n"] == first).all():
                return {name: table["v"]}, at + row.itemsize * element.count
    columns: dict[str, list] = {name: [] for name, _, _ in element.properties}
    for _ in range(element.count):
        for name, kind, length in element.properties:
            size = 1
            if length:
                size = int(np.frombuffer(body, order + length, 1, at)[0])
                at += np.dtype(length).itemsize
            value = np.frombuffer(body, order + kind, size, at)
            at += value.nbytes
            columns[name].append(value if length else value[0])
    return columns, at


def _triangles(polygons: NDArray | list[NDArray]) -> NDArray[np.int32]:
    if isinstance(polygons, np.ndarray) and polygons.shape[1:] == (3,):
        return polygons.astype(np.int32)
    fans = [(p[0], p[i], p[i + 1]) for p in polygons for i in range(1, len(p) - 1)]
    return np.array(fans, np.int32).reshape(-1, 3)
