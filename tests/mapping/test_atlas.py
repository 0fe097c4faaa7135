"""Pages of a texture atlas: boxes that do not touch each other, at full size where they fit; labels of faces."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
import pytest
from PIL import Image

from overfly.mapping.atlas import PAD, Layout, lay_out, paint
from overfly.mapping.face_labels import ENOUGH, FEWEST, charts, choose
from overfly.mapping.face_views import CANDIDATES, Candidates
from overfly.rendering.topology import topology


@dataclass
class Ramp:
    """Red grows to the right, green downwards, blue tells the picture; counts how often it is read."""

    blue: int
    size: tuple[int, int] = (400, 300)
    reads: int = 0

    def read(self, size: tuple[int, int]) -> np.ndarray:
        self.reads += 1
        x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
        ramp = np.stack([x * 255 / size[0], y * 255 / size[1], np.full_like(x, self.blue)], axis=-1)
        return np.rint(ramp).astype(np.uint8)


def boxes(count: int, pictures: int, largest: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(count)
    picture = rng.integers(pictures, size=count)
    size = largest ** rng.uniform(0.2, 1, (count, 2))
    low = rng.uniform(0, 1, (count, 2)) * ([400, 300] - size)
    return picture, low, low + size


def covered(layout: Layout) -> list[np.ndarray]:
    """How many boxes lie on each pixel of each page."""
    counts = [np.zeros((height, width), int) for width, height in layout.sizes]
    for page, (x, y), (w, h) in zip(layout.page, layout.place, layout.boxes.size, strict=True):
        assert x + w <= layout.sizes[page][0]
        assert y + h <= layout.sizes[page][1]
        counts[page][y : y + h, x : x + w] += 1
    return counts


@pytest.mark.parametrize(
    ("count", "largest", "side", "pages", "shrinks"),
    [(300, 200, 2048, 4, False), (300, 200, 512, 3, True), (1, 290, 4096, 1, False), (40, 280, 128, 4, True)],
)
def test_boxes_lie_apart_and_show_what_they_are_cut_from(
    count: int, largest: float, side: int, pages: int, shrinks: bool
) -> None:
    picture, low, high = boxes(count, 5, largest)
    layout = lay_out(picture, low, high, side=side, pages=pages)
    assert max(c.max() for c in covered(layout)) == 1
    assert len(layout.sizes) <= pages
    assert max(max(size) for size in layout.sizes) <= side
    assert (layout.scale < 1) == shrinks
    if not shrinks and count > 1:
        assert sum(c.mean() for c in covered(layout)) / len(layout.sizes) > 0.6
    pictures = [Ramp(40 * i) for i in range(5)]
    files = paint(layout, pictures, lambda i: None, np.array([9, 9, 9]))
    assert sum(p.reads for p in pictures) <= 5 * len(files)
    rng = np.random.default_rng(0)
    chart = np.repeat(np.arange(count), 8)
    pixels = low[chart] + rng.uniform(0, 1, (len(chart), 2)) * (high - low)[chart]
    uv = layout.texture_coordinates(chart, pixels)
    assert 0 <= uv.min() <= uv.max() <= 1
    expected = np.column_stack([pixels * 255 / [400, 300], 40.0 * picture[chart]])
    images = [np.asarray(Image.open(io.BytesIO(file))).astype(float) for file in files]
    found = []
    for c, at in zip(chart, uv, strict=True):
        image = images[layout.page[c]]
        column, row = np.floor(at * image.shape[1::-1]).astype(int)
        found.append(image[row, column])
    off = np.abs(np.array(found) - expected)
    assert np.quantile(off, 0.99) < 10  # of 255: JPEG, whole pixels
    x, y = np.moveaxis(uv * np.array(layout.sizes)[layout.page[chart]] - layout.place[chart], -1, 0)
    w, h = layout.boxes.size[chart].T
    assert min(x.min(), y.min(), (w - x).min(), (h - y).min()) >= PAD  # others are farther than filters look


def strip_of_faces(n: int) -> np.ndarray:
    """Neighbours [2 n^2, 3] of a square lattice of n x n cells, cut in two each."""
    at = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]
    faces = np.stack([np.stack([a, d, c], -1), np.stack([a, c, b], -1)], axis=2).reshape(-1, 3)
    return topology(faces, (n + 1) ** 2).neighbours.numpy()


def test_noisy_worth_makes_few_charts_of_good_photographs() -> None:
    n = 60
    neighbours = strip_of_faces(n)
    x = np.arange(len(neighbours)) // 2 % n / n
    rng = np.random.default_rng(0)
    worth = np.zeros((len(x), CANDIDATES), np.float32)
    for k, middle in enumerate((0.2, 0.5, 0.8)):  # three cameras along a line
        worth[:, k] = np.clip(1 - 2 * np.abs(x - middle), 0.01, 1) * rng.uniform(0.6, 1, len(x))
    worth[rng.random(len(x)) < 0.03] = 0  # seen by none
    photo = np.where(worth > 0, np.arange(CANDIDATES) + 10, -1).astype(np.int32)
    label = choose(Candidates(photo, worth), neighbours)
    np.testing.assert_array_equal(label < 0, (worth == 0).all(1))
    seen = label >= 0
    chosen = worth[seen, label[seen] - 10]
    assert (chosen >= ENOUGH * worth[seen].max(1)).all()
    alone = worth[seen].argmax(1) + 10
    assert (alone != label[seen]).mean() > 0.04  # by itself each face would choose otherwise
    sizes = np.bincount(charts(label, neighbours)[seen])
    assert np.count_nonzero(sizes >= FEWEST) == 3
    assert np.count_nonzero(sizes) <= 6
    for k, middle in enumerate((0.2, 0.5, 0.8)):
        near = seen & (np.abs(x - middle) < 0.1)
        assert (label[near] == k + 10).mean() > 0.99


def test_a_face_that_its_neighbours_photograph_does_not_see_keeps_its_own() -> None:
    neighbours = strip_of_faces(20)
    photo = np.full((len(neighbours), CANDIDATES), -1, np.int32)
    worth = np.zeros(photo.shape, np.float32)
    photo[:, 0], worth[:, 0] = 3, 1.0
    lonely = [101, 300]
    photo[lonely, 0] = 7
    label = choose(Candidates(photo, worth), neighbours)
    assert label[lonely].tolist() == [7, 7]
    assert (np.delete(label, lonely) == 3).all()
