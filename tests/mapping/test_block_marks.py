"""The picture of the block shows what it is told, and states how much longer residuals are drawn."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from overfly.cloud import Cloud
from overfly.mapping import pictures
from overfly.mapping.block_marks import Marks, scale_of
from overfly.mapping.survey import Survey, SurveyedPoint


def test_residuals_links_and_controls_change_the_picture() -> None:
    rng = np.random.default_rng(0)
    cloud = Cloud(np.column_stack([rng.uniform(0, 100, (4000, 2)), rng.normal(0, 1, 4000)]))
    seen = pictures.overview(cloud, min_cell=0.5)
    positions = np.array([[20.0, 20, 80], [80, 20, 80], [80, 80, 80], [20, 80, 80]])
    survey = Survey((SurveyedPoint("a", "control", (50.0, 50.0, 0.0), (0.1, 0.2, 0.0), 0.5, 4),
                     SurveyedPoint("b", "check", (30.0, 60.0, 0.0), (-0.1, 0.1, 0.0), 0.5, 4)))  # fmt: skip
    whole = Marks([(0, 1, 100), (1, 2, 5)], rng.normal(0, 0.3, (4, 2)), np.full((4, 2), 0.1), survey)
    drawn = [
        pictures.block_map(seen, positions, [], marks=marks)
        for marks in (None, Marks(), Marks(whole.links), Marks(whole.links, whole.gps), whole)
    ]
    for before, after in pairwise(drawn):
        assert before.shape != after.shape or (before != after).any()


def test_the_factor_is_round_and_fits_the_block() -> None:
    marks = Marks((), np.full((5, 2), 0.3))
    factor = scale_of(marks, 100.0)
    assert factor == 10  # 0.42 m become 4.2 of at most 6 m
    assert scale_of(Marks(), 100.0) == 1
