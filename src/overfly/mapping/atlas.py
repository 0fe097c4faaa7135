"""The texture of a mesh: charts cut from the photographs, packed into square pages of an atlas.

A chart is cut with its bounding box and some pixels around it as it stands in the photograph, lens and all, so that no
pixel is resampled while the pages have room for all charts at their own resolution.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from overfly.geometry import Array
from overfly.mapping.seams import cut_field, toned
from overfly.mapping.visibility import Image

PAGE = 8192
"""Longest side of a page: what graphics cards and browsers take."""

SMALLEST = 64
"""Shortest side of a page."""

PAGES = 4
"""Pages at most; charts get smaller where they would not fit."""

PAD = 4
"""Pixels around a chart: mipmaps and JPEG blend it with them, and with nothing else."""

QUALITY = 90
"""Of the pages as JPEG."""

FILLED = 0.9
"""Share of a page that boxes may cover, before it is tried to place them."""


class Picture(Protocol):
    """What charts are cut from: a photograph."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        ...

    def read(self, size: tuple[int, int]) -> Image:
        """RGB [H, W, 3], resampled to another width and height."""
        ...


class Boxes(NamedTuple):
    """Boxes of C charts, in pixels of their pictures as they are cut.

    Attributes:
        picture: [C] which picture.
        corner: [C, 2] column and row of the upper left pixel, the padding included; may lie outside of the picture.
        size: [C, 2] width and height.
    """

    picture: NDArray[np.int64]
    corner: NDArray[np.int64]
    size: NDArray[np.int64]


class Layout(NamedTuple):
    """Where boxes lie.

    Attributes:
        boxes: of the charts.
        scale: of the pictures before they are cut, at most 1.
        page: [C] which page.
        place: [C, 2] column and row of the upper left pixel in it.
        sizes: width and height of each page.
    """

    boxes: Boxes
    scale: float
    page: NDArray[np.int64]
    place: NDArray[np.int64]
    sizes: list[tuple[int, int]]

    def texture_coordinates(self, chart: NDArray, pixels: Array) -> Array:
        """u, v [N, 2] in 0..1, v downwards, of pixels [N, 2] of the pictures of some charts [N]."""
        at = pixels * self.scale - self.boxes.corner[chart] + self.place[chart]
        return np.asarray(at / np.array(self.sizes)[self.page[chart]])


def lay_out(picture: NDArray, low: Array, high: Array, *, side: int = PAGE, pages: int = PAGES) -> Layout:
    """Pack the charts' boxes, at the pictures' own resolution if that fits.

    Charts of one picture come to lie on one page or two, so that each is read once or twice.

    Args:
        picture: [C] the picture of each chart.
        low, high: [C, 2] its bounds, in pixels of the picture.
        side: longest side of a page.
        pages: at most so many.
    """
    order = np.argsort(picture, kind="stable")
    largest = (high - low).max(initial=1.0)
    scale = min(1.0, (side - 2 * PAD - 2) / largest)
    while True:
        corner = np.floor(low * scale).astype(np.int64) - PAD
        boxes = Boxes(np.asarray(picture, np.int64), corner, np.ceil(high * scale).astype(np.int64) + PAD - corner)
        made = _packed(boxes.size, order, side, pages)
        if made is not None:
            return Layout(boxes, scale, *made)
        scale *= 0.95


def _packed(
    size: NDArray[np.int64], order: NDArray, side: int, pages: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], list[tuple[int, int]]] | None:
    """Page [C], place [C, 2] and sizes of the pages; None where more would be needed."""
    page, place = np.full(len(size), -1, np.int64), np.zeros((len(size), 2), np.int64)
    areas = size.prod(1)
    if areas.sum() > pages * side**2:
        return None
    sizes: list[tuple[int, int]] = []
    while len(order):
        if len(sizes) == pages:
            return None
        width = side
        while width > SMALLEST and areas[order].sum() < FILLED * (width // 2) ** 2 and size[order].max() <= width // 2:
            width //= 2
        while True:
            here = order[np.cumsum(areas[order]) <= max(FILLED * width**2, areas[order[0]])]
            spot, fits, used = _shelves(size[here], width)
            if fits.all() or width == side:
                break
            width *= 2  # all that is left should lie on one page, if it fits on a larger one
        page[here[fits]], place[here] = len(sizes), spot
        sizes.append((width, used))
        order = np.concatenate([here[~fits], order[len(here) :]])
    return page, place, sizes


def _shelves(size: NDArray[np.int64], side: int) -> tuple[NDArray[np.int64], NDArray[np.bool_], int]:
    """Boxes [C, 2] on shelves of a square, the highest first: places [C, 2], which of them fit, and the height used."""
    spot, fits = np.zeros_like(size), np.zeros(len(size), bool)
    x = y = height = 0
    for i in np.lexsort((-size[:, 0], -size[:, 1])).tolist():
        width, tall = size[i].tolist()
        if x + width > side:
            x, y, height = 0, y + height, 0
        if y + tall > side:
            continue
        spot[i], fits[i] = (x, y), True
        x, height = x + width, max(height, tall)
    return spot, fits, y + height


def paint(
    layout: Layout,
    pictures: Sequence[Picture],
    movements: Callable[[int], NDArray[np.float32] | None],
    ground: NDArray,
    progress: Callable[[int, int], None] | None = None,
) -> list[bytes]:
    """The pages as JPEG files; one page and one picture are in memory at once.

    Args:
        layout: of the charts.
        pictures: that their boxes are cut from.
        movements: of a picture's tones, see :func:`overfly.mapping.seams.field`; None where it has none.
        ground: [3] the colour between the boxes.
        progress: told (done, in all).
    """
    import cv2

    boxes = layout.boxes
    work = [(p, i) for p in range(len(layout.sizes)) for i in np.unique(boxes.picture[layout.page == p]).tolist()]
    files, done = [], 0
    for page, (width, height) in enumerate(layout.sizes):
        canvas = np.empty((height, width, 3), np.uint8)
        canvas[:] = np.asarray(ground, np.uint8)[::-1]  # blue first: turning the page in the end would take it twice
        for i in [i for p, i in work if p == page]:
            image, moved = pictures[i].read(scaled(pictures[i].size, layout.scale)), movements(i)
            for c in np.flatnonzero((layout.page == page) & (boxes.picture == i)):
                (x, y), (w, h) = layout.place[c], boxes.size[c]
                box = _cut(image, boxes.corner[c], boxes.size[c])
                if moved is not None:
                    box = toned(box, cut_field(moved, boxes.corner[c], boxes.size[c], layout.scale))
                canvas[y : y + h, x : x + w] = box[..., ::-1]
            done += 1
            if progress is not None:
                progress(done, len(work))
        good, data = cv2.imencode(".jpg", canvas, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        assert good
        files.append(data.tobytes())
    return files


def scaled(size: tuple[int, int], scale: float) -> tuple[int, int]:
    """Width and height of a picture when its boxes are cut."""
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def _cut(image: Image, corner: NDArray, size: NDArray) -> Image:
    """A box of an image; beyond its border, the border's colours."""
    column = np.clip(np.arange(corner[0], corner[0] + size[0]), 0, image.shape[1] - 1)
    row = np.clip(np.arange(corner[1], corner[1] + size[1]), 0, image.shape[0] - 1)
    inside = image[row[0] : row[-1] + 1, column[0] : column[-1] + 1]
    return np.asarray(inside[row - row[0]][:, column - column[0]])
