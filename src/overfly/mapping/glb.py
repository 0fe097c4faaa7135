"""A textured triangle mesh as a binary glTF 2.0 file (GLB): y up, float32, unlit, the textures inside it."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from overfly import __version__
from overfly.files import replacing
from overfly.geometry import Array

FLOAT, UINT = 5126, 5125
VERTICES, INDICES = 34962, 34963
LINEAR_MIPMAP, LINEAR, CLAMP = 9987, 9729, 33071


class Part(NamedTuple):
    """Triangles with one texture.

    Attributes:
        vertices: [V, 3] metres, z up, small enough for float32.
        uv: [V, 2] texture coordinates, v downwards.
        faces: [F, 3] counter-clockwise seen from outside.
        texture: a JPEG file.
    """

    vertices: Array
    uv: Array
    faces: NDArray[np.integer]
    texture: bytes


def write_glb(path: Path, parts: Sequence[Part], extras: Mapping[str, Any]) -> None:
    """Write the file, atomically.

    Photographs carry their light: the materials are unlit, where a viewer knows that (KHR_materials_unlit).

    Args:
        path: the .glb file.
        parts: one or more.
        extras: written for the asset and the scene, such as what to add to the vertices.
    """
    chunks: list[bytes] = []
    views: list[dict[str, int]] = []
    accessors: list[dict[str, Any]] = []

    def put(data: bytes, **facts: int) -> int:
        offset = sum(len(chunk) for chunk in chunks)
        chunks.append(data + bytes(-len(data) % 4))
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(data), **facts})
        return len(views) - 1

    def array(values: NDArray, kind: str, component: int, target: int, **bounds: list[float]) -> int:
        view = put(np.ascontiguousarray(values).tobytes(), target=target)
        accessors.append({"bufferView": view, "componentType": component, "count": len(values), "type": kind, **bounds})
        return len(accessors) - 1

    primitives, images = [], []
    for i, part in enumerate(parts):
        xyz = np.asarray(part.vertices[:, [0, 2, 1]] * [1, 1, -1], "<f4")
        ends = {"min": xyz.min(0).tolist(), "max": xyz.max(0).tolist()}
        position = array(xyz, "VEC3", FLOAT, VERTICES, **ends)
        texture = array(np.asarray(part.uv, "<f4"), "VEC2", FLOAT, VERTICES)
        indices = array(np.asarray(part.faces, "<u4").reshape(-1), "SCALAR", UINT, INDICES)
        attributes = {"POSITION": position, "TEXCOORD_0": texture}
        primitives.append({"attributes": attributes, "indices": indices, "material": i})
        images.append({"bufferView": put(part.texture), "mimeType": "image/jpeg"})
    count = range(len(parts))
    shade = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    content = {
        "asset": {"version": "2.0", "generator": f"overfly {__version__}", "extras": dict(extras)},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0], "extras": dict(extras)}],
        "nodes": [{"mesh": 0, "name": "map"}],
        "meshes": [{"primitives": primitives}],
        "materials": [
            {
                "pbrMetallicRoughness": {"baseColorTexture": {"index": i}, **shade},
                "extensions": {"KHR_materials_unlit": {}},
            }
            for i in count
        ],
        "textures": [{"sampler": 0, "source": i} for i in count],
        "samplers": [{"magFilter": LINEAR, "minFilter": LINEAR_MIPMAP, "wrapS": CLAMP, "wrapT": CLAMP}],
        "images": images,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": sum(len(chunk) for chunk in chunks)}],
    }
    header = json.dumps(content, allow_nan=False).encode()
    header += b" " * (-len(header) % 4)
    length = 12 + 8 + len(header) + 8 + content["buffers"][0]["byteLength"]  # type: ignore[index]
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, length))
        file.write(struct.pack("<I4s", len(header), b"JSON") + header)
        file.write(struct.pack("<I4s", length - 28 - len(header), b"BIN\0"))
        for chunk in chunks:
            file.write(chunk)
