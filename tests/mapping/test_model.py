"""Which of several models is taken: that which keeps the matches, not that which merely has every image."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from overfly.mapping import model

NAMES = [f"{i}.jpg" for i in range(4)]
MATCHES = {(0, 1): 100, (1, 2): 100, (2, 3): 100}


class Fake:
    """A model and its bundle, as far as the choice looks at them."""

    def __init__(self, images: list[int], links: dict[tuple[int, int], int], points: int = 300) -> None:
        self.frames, self.common = np.array(images), links
        self.centres = np.array([[10.0 * i, 0, 50] for i in images])
        self.points = np.zeros((points, 3))
        self.point, self.image = np.zeros(1, int), np.zeros(1, int)

    def __len__(self) -> int:
        return len(self.frames)

    def links(self) -> dict[tuple[int, int], int]:
        return self.common


RIGHT = Fake([0, 1, 2, 3], {(0, 1): 98, (1, 2): 99, (2, 3): 95})
WRONG = Fake([0, 1, 2, 3], {(0, 1): 98, (1, 2): 99, (2, 3): 10}, 400)
"""The last image has been put elsewhere."""

TINY = Fake([0, 1, 2, 3], {(0, 1): 100, (1, 2): 100, (2, 3): 100}, 2)
"""Two points fit without error, and say nothing."""


@pytest.mark.parametrize(
    ("found", "taken", "asked"),
    [
        ({3: RIGHT, 2: WRONG, 1: WRONG}, RIGHT, [3]),
        ({3: WRONG, 2: RIGHT, 1: WRONG}, RIGHT, [3, 2]),
        ({3: WRONG, 2: WRONG, 1: RIGHT}, RIGHT, [3, 2, 1]),
        ({3: WRONG, 2: None, 1: None}, WRONG, [3, 2, 1]),
        ({3: TINY, 2: WRONG, 1: None}, WRONG, [3, 2, 1]),
    ],
)
def test_a_model_that_puts_an_image_elsewhere_asks_for_another_way(
    found: dict[int, Fake | None],
    taken: Fake,
    asked: list[int],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tried: list[int] = []

    def answer(way: int) -> dict[int, Any]:
        tried.append(way)
        return {} if found[way] is None else {0: found[way]}

    monkeypatch.setattr(model, "read_verified", lambda *_: {k: np.zeros((n, 2)) for k, n in MATCHES.items()})
    monkeypatch.setattr(model, "bundle_of", lambda made, _: made)
    monkeypatch.setattr(model, "_global", lambda *args: answer(args[4]))
    monkeypatch.setattr(model, "_incremental", lambda *_: answer(1))
    assert model.mapped(tmp_path / "db", tmp_path, tmp_path, names=NAMES, seed=0) == [taken]
    assert tried == asked


def test_only_matches_between_images_of_the_model_count() -> None:
    half = Fake([0, 1], {(0, 1): 50})
    assert model.upheld(half, MATCHES) == 2
    assert model.upheld(Fake([0, 1], {(0, 1): 49}), MATCHES) == 0
    assert model.upheld(Fake([0, 3], {}), MATCHES) == 2, "they have none: nothing contradicts them"
    copy = Fake([0, 1], {})
    copy.centres[1] = copy.centres[0] + [0, 1, 0]
    assert model.upheld(copy, MATCHES) == 0, "a model that has collapsed to a point is no good one"
    hovered = Fake([0, 1, 2], {(1, 2): 100})
    hovered.centres[0] = hovered.centres[1] + [0, 1, 0]
    matches = {**MATCHES, (0, 2): 100}
    assert model.upheld(hovered, matches) == 2
    hovered.common[0, 2] = 90
    assert model.upheld(hovered, matches) == 3, "from one place no point can be told, from others it can"
