"""In which order cameras are looked for, and which of the answers is taken."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from overfly.errors import InputError
from overfly.flights import Flight, Frame
from overfly.mapping import sparse
from overfly.mapping.agreement import Agreement


class Part:
    """A bundle, as far as the choice looks at it."""

    def __init__(self, name: str, images: int, error: float = 0.2, rays: int = 60) -> None:
        self.name, self.images, self.error = name, images, error
        self.image = np.repeat(np.arange(images), rays)

    def __len__(self) -> int:
        return self.images

    def errors(self) -> np.ndarray:
        return np.full(50, self.error)


HELD, FREE, PRIOR = Part("held", 20), Part("free", 20), Part("prior", 20)


@pytest.mark.parametrize(
    ("held", "free", "prior", "agrees", "guessed", "taken", "asked"),
    [
        (HELD, FREE, PRIOR, True, 0, "held", ["held"]),
        (Part("held", 12), FREE, PRIOR, True, 0, "free", ["held", "free"]),
        (HELD, FREE, PRIOR, True, 20, "free", ["free"]),  # no photo tells a focal length
        (HELD, FREE, PRIOR, True, 1, "held", ["held"]),
        (Part("held", 12), Part("free", 11), PRIOR, True, 0, "prior", ["held", "free", "prior"]),
        (Part("held", 12), Part("free", 11), Part("prior", 20, 2.0), True, 0, "held", ["held", "free", "prior"]),
        (HELD, FREE, PRIOR, False, 0, "prior", ["held", "prior"]),
        (HELD, FREE, Part("prior", 19), False, 0, "held", ["held", "prior"]),
        (HELD, FREE, None, False, 0, "held", ["held", "prior"]),
        (None, None, PRIOR, True, 0, "prior", ["held", "free", "prior"]),
        (Part("held", 19), FREE, None, True, 0, "free", ["held", "free"]),
        (Part("held", 12, 0.01), Part("free", 11), PRIOR, True, 0, "prior", ["held", "free", "prior"]),
    ],
)
def test_the_better_start_is_taken_and_the_dear_one_only_tried_where_it_is_needed(
    held: Part | None,
    free: Part | None,
    prior: Part | None,
    agrees: bool,
    guessed: int,
    taken: str,
    asked: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tried: list[str] = []

    def mapped(*_: Any, calibrate: bool, **__: Any) -> list[Part]:
        tried.append("free" if calibrate else "held")
        found = free if calibrate else held
        return [] if found is None else [found]

    def by_priors(*_: Any, **__: Any) -> Part | None:
        tried.append("prior")
        return prior

    monkeypatch.setattr(sparse, "mapped", mapped)
    monkeypatch.setattr(sparse, "agrees_with_gps", lambda part, *_, **__: agrees or part.name == "prior")
    monkeypatch.setattr(sparse, "read_points", lambda *_: ([], []))
    monkeypatch.setattr(sparse, "agreement", lambda *_: Agreement({}, [], [], np.zeros(20, bool)))
    monkeypatch.setattr(sparse, "priors", lambda *_: ["prior"] * 20)
    monkeypatch.setattr(sparse, "read_verified", lambda *_: {})
    monkeypatch.setattr(sparse, "upheld", lambda part, _: len(part))
    monkeypatch.setattr(sparse, "bundle_by_priors", by_priors)
    monkeypatch.setattr(sparse, "components", lambda bundle: [bundle])
    names = [f"{i}.jpg" for i in range(20)]
    flight = Flight(tmp_path, [Frame(name, tmp_path / name, 400, 300) for name in names])
    warnings: list[str] = []
    parts: Any = sparse.sparse_parts(
        tmp_path / "db", flight, names[:guessed], np.zeros((20, 3)), tmp_path, 0,
        lambda *_: nullcontext(lambda *_: None), warnings,
    )  # fmt: skip
    assert [part.name for part in parts] == [taken]
    assert tried == asked
    assert bool(warnings) == (taken == "prior")
    if warnings:
        assert ("contradicted GPS" in warnings[0]) == (held is not None and not agrees)


@pytest.mark.parametrize(
    ("few", "many", "against", "taken", "priors_of", "told"),
    [
        (Part("few", 12), Part("many", 20), "", "many", None, 1),
        (None, Part("many", 20), "", "many", None, 1),
        (Part("few", 18), Part("many", 12), "", "prior", "many.db", 1),  # still too few: the priors have all matches
        (Part("few", 20), None, "", "few", None, 0),  # nothing more is asked for
        (Part("few", 18), Part("many", 20), "many", "prior", "many.db", 1),  # more images, but against GPS
        (Part("few", 20), Part("many", 18), "few", "prior", "many.db", 1),
        (Part("few", 18), Part("many", 20, 3.0), "", "prior", "many.db", 1),  # more images, far worse
    ],
)
def test_more_matches_are_asked_for_where_they_are_too_few(
    few: Part | None,
    many: Part | None,
    against: str,
    taken: str,
    priors_of: str | None,
    told: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    read: list[str] = []
    by_database = {"few.db": few, "many.db": many}
    monkeypatch.setattr(
        sparse, "mapped", lambda database, *_, **__: [p] if (p := by_database[database.name]) is not None else []
    )
    monkeypatch.setattr(sparse, "agrees_with_gps", lambda part, *_, **__: part.name != against)
    monkeypatch.setattr(sparse, "read_points", lambda database, _: (read.append(database.name), []))
    monkeypatch.setattr(sparse, "agreement", lambda *_: Agreement({}, [], [], np.zeros(20, bool)))
    monkeypatch.setattr(sparse, "priors", lambda *_: ["prior"] * 20)
    monkeypatch.setattr(sparse, "read_verified", lambda *_: {})
    monkeypatch.setattr(sparse, "upheld", lambda part, _: len(part))
    monkeypatch.setattr(sparse, "bundle_by_priors", lambda *_, **__: PRIOR)
    monkeypatch.setattr(sparse, "components", lambda bundle: [bundle])
    flight = Flight(tmp_path, [Frame(f"{i}.jpg", tmp_path / f"{i}.jpg", 400, 300) for i in range(20)])
    warnings: list[str] = []
    asked: list[str] = []

    def more() -> Path:
        asked.append("more")
        return tmp_path / "many.db"

    parts: Any = sparse.sparse_parts(
        tmp_path / "few.db", flight, [], np.zeros((20, 3)), tmp_path, 0,
        lambda *_: nullcontext(lambda *_: None), warnings, more,
    )  # fmt: skip
    assert [part.name for part in parts] == [taken]
    assert read == ([] if priors_of is None else [priors_of])
    assert bool(asked) == (taken != "few")
    assert len(warnings) == told
    assert all("network" in warning for warning in warnings)  # whoever reads the report is told that it was asked


@pytest.mark.parametrize(
    ("dropped", "added", "as_they_are", "agreeing", "kept", "taken", "mapped_are"),
    [
        ([(0, 1)], [], HELD, Part("clean", 20), 20, "clean", ["m_agreeing.db"]),
        ([(0, 1)], [], HELD, None, 20, "held", ["m_agreeing.db", "m.db"]),  # what was left out is needed
        ([(0, 1)], [], Part("held", 12), Part("clean", 18), 20, "clean", ["m_agreeing.db", "m.db"]),
        ([], [(0, 2)], HELD, Part("clean", 20), 20, "held", ["m.db"]),  # nothing more is needed
        ([], [(0, 2)], Part("held", 12), Part("clean", 18), 20, "clean", ["m.db", "m_agreeing.db"]),
        ([], [], HELD, None, 18, "held", ["m.db"]),  # loses matches of two images: the priors place no more
        ([], [], HELD, None, 9, "prior", ["m.db"]),  # loses those of most: it is wrong
    ],
)
def test_models_are_made_of_what_agrees_with_the_priors_and_must_keep_it(
    dropped: list[tuple[int, int]],
    added: list[tuple[int, int]],
    as_they_are: Part | None,
    agreeing: Part | None,
    kept: int,
    taken: str,
    mapped_are: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    done: list[str] = []

    def mapped(database: Path, *_: Any, **__: Any) -> list[Part]:
        if database.name not in done:
            done.append(database.name)
        found = as_they_are if database.name == "m.db" else agreeing
        return [] if found is None else [found]

    def rewritten(*_: Any) -> Path:
        (tmp_path / "m_agreeing.db").touch()
        return tmp_path / "m_agreeing.db"

    monkeypatch.setattr(sparse, "mapped", mapped)
    monkeypatch.setattr(sparse, "rewritten", rewritten)
    monkeypatch.setattr(sparse, "agreement", lambda *_: Agreement({}, dropped, added, np.ones(20, bool)))
    monkeypatch.setattr(sparse, "upheld", lambda part, _: min(kept, len(part)))
    monkeypatch.setattr(sparse, "agrees_with_gps", lambda *_, **__: True)
    monkeypatch.setattr(sparse, "priors", lambda *_: ["prior"] * 20)
    monkeypatch.setattr(sparse, "read_points", lambda *_: ([], []))
    prior = PRIOR if kept < 20 else None
    monkeypatch.setattr(sparse, "bundle_by_priors", lambda *_, **__: prior)
    monkeypatch.setattr(sparse, "components", lambda bundle: [bundle])
    flight = Flight(tmp_path, [Frame(f"{i}.jpg", tmp_path / f"{i}.jpg", 400, 300) for i in range(20)])
    parts: Any = sparse.sparse_parts(
        tmp_path / "m.db", flight, [], np.zeros((20, 3)), tmp_path, 0,
        lambda *_: nullcontext(lambda *_: None), [],
    )  # fmt: skip
    assert [part.name for part in parts] == [taken]
    assert done == mapped_are
    assert not (tmp_path / "m_agreeing.db").exists(), "the copy is not kept"


@pytest.mark.parametrize(
    ("new", "old", "agrees", "trusted", "taken"),
    [
        (19, 20, False, False, False),
        (20, 20, False, False, True),
        (10, 20, False, True, True),
        (9, 20, False, True, False),
        (20, 20, True, True, False),
        (20, 19, True, False, True),
    ],
)
def test_cameras_by_priors_replace_a_model_that_contradicts_gps(
    new: int, old: int, agrees: bool, trusted: bool, taken: bool
) -> None:
    parts: Any = Part("new", new), Part("old", old)
    assert sparse._better(*parts, agrees, trusted) == taken


@pytest.mark.parametrize(
    ("images", "rays", "agreeing", "taken"),
    [
        (5, 49, [], None),
        (5, 50, [], "held"),
        (5, 49, ["held"], "held"),
        (6, 20, ["prior"], "prior"),  # fewer images, but they agree
    ],
)
def test_a_model_of_few_points_that_contradicts_gps_gives_way_or_is_refused(
    images: int, rays: int, agreeing: list[str], taken: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sparse, "mapped", lambda *_, **__: [Part("held", images, rays=rays)])
    monkeypatch.setattr(sparse, "agrees_with_gps", lambda part, *_, **__: part.name in agreeing)
    monkeypatch.setattr(sparse, "read_points", lambda *_: ([], []))
    monkeypatch.setattr(sparse, "agreement", lambda *_: Agreement({}, [], [], np.zeros(6, bool)))
    monkeypatch.setattr(sparse, "priors", lambda *_: ["prior"] * 6)
    monkeypatch.setattr(sparse, "upheld", lambda part, _: len(part))
    monkeypatch.setattr(sparse, "bundle_by_priors", lambda *_, **__: Part("prior", 5))
    monkeypatch.setattr(sparse, "components", lambda bundle: [bundle])
    flight = Flight(tmp_path, [Frame(f"{i}.jpg", tmp_path / f"{i}.jpg", 400, 300) for i in range(6)])

    def names() -> list[str]:
        parts: Any = sparse.sparse_parts(
            tmp_path / "db", flight, [], np.zeros((6, 3)), tmp_path, 0, lambda *_: nullcontext(lambda *_: None), []
        )
        return [part.name for part in parts]

    if taken is None:
        with pytest.raises(InputError, match=r"49 points in the median image\) contradicts GPS"):
            names()
    else:
        assert names() == [taken]
