"""Finer meshes: edges are halved where more detail is asked for, and the mesh stays without gaps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Index = NDArray[np.int64]

# Which small triangles replace one whose sides are halved: corners 0 to 2, midpoints 3 to 5 of the sides 01, 12, 20.
SPLITS = {
    (0, 0, 0): [(0, 1, 2)],
    (1, 0, 0): [(0, 3, 2), (3, 1, 2)],
    (0, 1, 0): [(0, 1, 4), (0, 4, 2)],
    (0, 0, 1): [(0, 1, 5), (5, 1, 2)],
    (1, 1, 0): [(3, 1, 4), (0, 3, 4), (0, 4, 2)],
    (0, 1, 1): [(4, 2, 5), (0, 1, 4), (0, 4, 5)],
    (1, 0, 1): [(0, 3, 5), (3, 1, 2), (3, 2, 5)],
    (1, 1, 1): [(0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)],
}


def subdivide(faces: Index, edges: Index, halved: NDArray[np.bool_], vertices: int) -> tuple[Index, Index]:
    """Halve edges and re-triangulate the faces beside them, into two, three or four.

    Args:
        faces: [F, 3].
        edges: [E, 2], every edge once, lower index first.
        halved: [E].
        vertices: their number V.

    Returns:
        ``parents`` [V', 2]: vertex i lies in the middle of these two (twice itself for the first V), and the new faces
        [F', 3], wound as their originals.
    """
    number = np.full(len(edges), -1, np.int64)
    number[halved] = vertices + np.arange(int(halved.sum()))
    own = np.arange(vertices)[:, None].repeat(2, 1)
    parents = np.concatenate([own, edges[halved]])
    middle = number[sides(faces, edges, vertices)]  # [F, 3]: on the sides 01, 12, 20
    corners = np.concatenate([faces, middle], axis=1)
    parts = []
    for pattern, triangles in SPLITS.items():
        chosen = corners[((middle >= 0) == np.array(pattern, bool)).all(1)]
        parts += [chosen[:, triangle] for triangle in triangles]
    return parents, np.concatenate(parts)


def sides(faces: Index, edges: Index, vertices: int) -> Index:
    """Index of the edges of each face's sides 01, 12 and 20: [F, 3]."""
    keys = edges[:, 0] * vertices + edges[:, 1]
    order = np.argsort(keys)
    ends = np.sort(np.stack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]], axis=1), axis=2)
    return np.asarray(order[np.searchsorted(keys, ends[..., 0] * vertices + ends[..., 1], sorter=order)])


def wanted(
    faces: Index, edges: Index, error: NDArray[np.float64], length: NDArray[np.float64], *, budget: int, least: float
) -> NDArray[np.bool_]:
    """Which edges to halve so that the mesh has at most ``budget`` faces, the largest errors first.

    Args:
        faces: [F, 3].
        edges: [E, 2].
        error: of each face, summed over the pixels that show it [F].
        length: of the edges, metres [E].
        budget: faces afterwards, about.
        least: shorter edges than twice this are left, metres.

    Returns:
        [E] bool.
    """
    beside = sides(faces, edges, int(faces.max()) + 1)
    count = np.bincount(beside.ravel(), minlength=len(edges))
    # Of equally wrong ones the longest, or triangles would become slivers.
    score = np.bincount(beside.ravel(), error.repeat(3), len(edges)) * length
    possible = np.flatnonzero((length >= 2 * least) & (score > 0))
    order = possible[np.argsort(-score[possible], kind="stable")]
    more = np.cumsum(count[order])  # a halved edge adds a face on either side
    chosen = np.zeros(len(edges), bool)
    chosen[order[: int(np.searchsorted(more, max(budget - len(faces), 0), side="right"))]] = True
    return chosen
