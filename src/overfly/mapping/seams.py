"""Evening the seams between charts: what two photographs of one place differ by is spread over both charts.

After Lempitsky & Ivanov 2007 ("Seamless Mosaicing of Image-Based Texture Maps"): each vertex of each chart is moved in
tone, so that the charts agree where they meet and the movement is smooth inside of them. It fades with the distance
from the seam, for what is far away was even by the frames' gains.

Tones are logarithms of colours: light and exposure multiply, and what is added to a lawn would drown its shadows.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from overfly.geometry import Array
from overfly.rendering.operations import interpolate, rasterise

FADE = 50.0
"""Vertices over which a movement fades."""

JOINT = 10.0
"""Weight of a seam's difference against one of the movements of two neighbours inside of a chart."""

UNLIKE = 0.2
"""Difference of tones from which on two photographs show another thing and not another light: roof and ground."""

FLOOR = 16.0
"""Added to colours of 0..255 before their logarithm, for there is noise in the dark."""

PARTS = 4
"""Pixels of a photograph along one of the field of movements."""

CLOSED = 7
"""Pixels of that field, over which it is carried on beyond its charts."""


def movements(tones: Array, vertex: NDArray, faces: NDArray) -> Array:
    """What is added to the tones of the charts' vertices [W, 3].

    Args:
        tones: [W, 3] of each vertex of each chart in its photograph; NaN where the vertex is not to be moved, and not
            to be compared.
        vertex: [W] the vertex of the mesh that it is.
        faces: [F, 3] over the W vertices, each within one chart.
    """
    from scipy.sparse import coo_array, diags_array
    from scipy.sparse.linalg import cg

    known = np.asarray(np.isfinite(tones).all(1))
    order = np.flatnonzero(known)  # what is not compared must not stand between two that are
    order = order[np.argsort(vertex[order], kind="stable")]
    i, j = order[:-1], order[1:]
    joint = vertex[i] == vertex[j]
    i, j = i[joint], j[joint]
    off = tones[j] - tones[i]
    weight = JOINT * np.maximum(0, 1 - (off**2).mean(1) / UNLIKE**2) ** 2  # Tukey's
    inside = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    inside = inside[known[inside].all(1)]
    ends = np.concatenate([inside, np.column_stack([i, j])])
    share = np.concatenate([np.full(len(inside), 0.5), weight])  # sides inside of a chart come twice
    (a, b), n = ends.T, len(tones)
    links = coo_array((np.concatenate([share, share]), (np.concatenate([a, b]), np.concatenate([b, a]))), shape=(n, n))
    whole = links.sum(1) + FADE**-2
    normal, scale = (diags_array(whole) - links).tocsr(), diags_array(1 / whole)
    found = np.zeros(tones.shape)
    for k in range(3):
        right = np.bincount(i, weight * off[:, k], n) - np.bincount(j, weight * off[:, k], n)
        found[:, k], _ = cg(normal, right, rtol=1e-3, maxiter=500, M=scale)
    return found


def tones_at(image: NDArray[np.uint8], pixels: Array, width: float) -> Array:
    """Tones [N, 3] of an image at pixels [N, 2], of colours averaged over squares of ``width``; NaN where it ends."""
    import cv2

    side = max(1, round(width))
    smooth = cv2.blur(image, (side, side), borderType=cv2.BORDER_REPLICATE)
    column, row = np.floor(pixels).astype(np.int64).T
    inside = (column >= 0) & (column < image.shape[1]) & (row >= 0) & (row < image.shape[0])
    column, row = np.clip(column, 0, image.shape[1] - 1), np.clip(row, 0, image.shape[0] - 1)
    return np.where(inside[:, None], np.log(smooth[row, column] + FLOOR), np.nan)


def field(size: tuple[int, int], pixels: Array, moved: Array, faces: NDArray) -> NDArray[np.float32]:
    """Movements all over a photograph of width and height ``size``, each pixel for :data:`PARTS` x :data:`PARTS`.

    Args:
        size: of the photograph.
        pixels: [V, 2] of the charts' vertices in it.
        moved: [V, 3] their movements.
        faces: [F, 3] of all its charts.

    Returns:
        [rows, columns, 3], continued a little beyond the charts and 0 elsewhere.
    """
    import cv2

    columns, rows = (-(-n // PARTS) for n in size)
    flat = np.column_stack([pixels / PARTS, np.ones(len(pixels))])  # seen at depth 1, pixels are the plane itself
    points, triangles = torch.from_numpy(flat)[None], torch.from_numpy(np.ascontiguousarray(faces, np.int32))
    face = rasterise(points, triangles, (columns, rows))
    through = tuple(torch.arange(n, dtype=torch.float64)[None] + 0.5 for n in (columns, rows))
    values, _ = interpolate(points, torch.from_numpy(moved).float(), triangles, face, (through[0], through[1]))
    inside = (face[0].numpy() >= 0).astype(np.float32)
    known = values[0].numpy() * inside[..., None]
    total, count = (cv2.blur(x, (CLOSED, CLOSED), borderType=cv2.BORDER_CONSTANT) for x in (known, inside))
    beside = total / np.maximum(count, np.float32(1e-6))[..., None]
    return np.asarray(np.where(inside[..., None] > 0, known, beside), np.float32)


def toned(colors: NDArray[np.uint8], moved: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Colours [..., 3] with their tones moved."""
    return np.asarray(np.rint(np.clip((colors + np.float32(FLOOR)) * np.exp(moved) - FLOOR, 0, 255)), np.uint8)


def cut_field(values: NDArray[np.float32], corner: NDArray, size: NDArray, scale: float) -> NDArray[np.float32]:
    """The movements [h, w, 3] of a box of w, h = ``size`` pixels from ``corner`` on, of a photograph scaled before."""
    import cv2

    step = 1 / (PARTS * scale)
    shift = (np.asarray(corner) + 0.5) * step - 0.5
    matrix = np.array([[step, 0, shift[0]], [0, step, shift[1]]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    width, height = (int(n) for n in size)
    return np.asarray(cv2.warpAffine(values, matrix, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE))
