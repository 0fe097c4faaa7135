"""``overfly refine``: its errors are sentences, colours come from the photographs, and the same command goes on."""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from overfly.cloud import Cloud
from overfly.errors import InputError
from overfly.mesh import Mesh, read_mesh, write_mesh
from overfly.refine import refine
from overfly.refinement.colors import colors_from
from overfly.refinement.measure import ShapeMeasure
from overfly.refinement.module import welded, with_area
from overfly.rendering import topology
from photographed import KNOWN_WARNINGS, SHIFT, Photographed, color, flat_mesh, height, make_photographed, moved

pytestmark = KNOWN_WARNINGS

QUICK = ["trainer.max_epochs=3", "trainer.accelerator=cpu", "trainer.enable_progress_bar=false", "loss.adversarial=0"]

Refine = Callable[..., int]


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Photographed:
    return make_photographed(tmp_path_factory.mktemp("a knoll, seen=twice"), colored=False)


@pytest.fixture
def run(given: Photographed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Refine:
    """Refine the knoll into the folder ``out``, quickly and without pictures."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["overfly"])
    monkeypatch.setattr("overfly.callbacks.refinement.plot_photograph", lambda *a: None)

    def call(**changes: object) -> int:
        options = {"flight": given.flight, "out": tmp_path / "out", "mesh": given.mesh, "faces": 1000, "width": 96}
        return refine(**{**options, "hold_out": 3, "more": QUICK, **changes})  # type: ignore[arg-type]

    return call


def test_the_same_command_refines_goes_on_and_is_finished(
    run: Refine, tmp_path: Path, given: Photographed, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "my refinement, 1=a"  # names that Hydra would take apart
    assert run(out=out) == 0
    log, metrics = (out / "train.log").read_text(), (out / "metrics.json").read_bytes()
    assert "The mesh has no colours: they are estimated from the photographs" in log
    colors = read_mesh(out / "start.ply").colors
    assert colors is not None
    mesh = flat_mesh()
    middle = (np.abs(mesh.vertices[:, :2]) < [14, 10]).all(1) & (height(mesh.vertices[:, :2]) < 0.2)
    assert np.abs(colors[middle] / 255 - color(mesh.vertices[middle, :2])).mean() < 0.05
    assert len(read_mesh(out / "refined.ply").faces) <= 1000
    assert json.loads(metrics)["epochs"] == 3

    assert run(out=out) == 0  # finished
    assert "finished before" in (out / "train.log").read_text()
    assert (out / "metrics.json").read_bytes() == metrics

    with pytest.raises(InputError, match=r"holds another refinement .* give another --out, or --overwrite"):
        run(out=out, faces=1200)
    assert run(out=out, faces=1200, overwrite=True, more=[*QUICK, "trainer.fast_dev_run=true"]) == 0
    assert not (out / "refined.ply").exists()


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"generator": "vertex"}, r"vertices"),
        ({"faces": 999}, r"^--faces 999 is too few"),
        ({"flight": Path("nowhere")}, r"^There is no folder nowhere: give a flight folder"),
    ],
)
def test_impossible_values_are_refused_at_once(run: Refine, changes: dict[str, object], says: str) -> None:
    with pytest.raises(InputError, match=says):
        run(**changes)


def test_a_folder_of_other_things_is_left_alone(run: Refine, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.txt").write_text("years of work")
    for overwrite in (False, True):
        with pytest.raises(InputError, match="is not empty and holds no refinement"):
            run(overwrite=overwrite)
    assert (tmp_path / "out" / "thesis.txt").is_file()


def test_other_photographs_under_the_same_names_are_another_refinement(
    run: Refine, tmp_path: Path, given: Photographed
) -> None:
    flight = tmp_path / "flight"
    shutil.copytree(given.flight, flight)
    assert run(flight=flight) == 0
    touched = next(flight.rglob("*.png"), None) or next(flight.rglob("*.jpg"))
    os.utime(touched, ns=(1, 1))
    with pytest.raises(InputError, match="holds another refinement"):
        run(flight=flight)
    inside = tmp_path / "out" / "flight"
    shutil.copytree(given.flight, inside)
    with pytest.raises(InputError, match="which --overwrite would delete"):
        run(flight=inside, overwrite=True)
    assert inside.is_dir()


def test_a_run_of_another_stage_is_never_replaced(run: Refine, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "overrides.txt").write_text("experiment=overfly_base\n")
    with pytest.raises(InputError, match="is a run of another stage"):
        run(overwrite=True)


def test_vertices_at_one_place_become_one() -> None:
    mesh = flat_mesh()
    soup = Mesh(
        mesh.vertices[mesh.faces.reshape(-1)],
        np.arange(mesh.faces.size, dtype=np.int32).reshape(-1, 3),
        None if mesh.colors is None else mesh.colors[mesh.faces.reshape(-1)],
    )
    joined = welded(soup)
    assert len(joined.vertices) == len(mesh.vertices)
    assert (topology(joined.faces, len(joined.vertices)).neighbours >= 0).sum() == (
        topology(mesh.faces, len(mesh.vertices)).neighbours >= 0
    ).sum()
    assert np.array_equal(joined.vertices[joined.faces], mesh.vertices[mesh.faces])


def broken(kind: str) -> Mesh:
    mesh = moved(flat_mesh(colored=False))
    if kind == "nan":
        mesh.vertices[[3, 8]] = np.nan
    elif kind == "far":
        return Mesh(mesh.vertices + np.array([0, 300, 0]), mesh.faces)
    elif kind == "above":
        return Mesh(mesh.vertices + np.array([0, 0, 500]), mesh.faces)
    elif kind == "fins":
        fin = np.r_[mesh.faces[0, :2], 200]
        return Mesh(mesh.vertices, np.concatenate([mesh.faces, [fin, fin[[0, 1, 2]] + [0, 0, 1]]]).astype(np.int32))
    return mesh


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        ("nan", "2 of the 391 vertices of"),
        ("far", "do not overlap: it misses the nearest by 6"),  # 300 m less a little at 96 px per 40 m
        ("above", "it lies behind every camera"),
        ("fins", "are shared by more than two faces"),
    ],
)
def test_a_mesh_that_cannot_be_refined_is_one_sentence_and_bars_nothing(
    run: Refine, tmp_path: Path, given: Photographed, capfd: pytest.CaptureFixture[str], kind: str, says: str
) -> None:
    path = tmp_path / f"{kind}.ply"
    write_mesh(broken(kind), path)
    assert run(mesh=path) == 2
    error = capfd.readouterr().err
    assert says in error
    assert "Traceback" not in error
    if kind == "nan":  # the next attempt, with another mesh, needs no --overwrite
        assert run(more=[*QUICK, "trainer.fast_dev_run=true"]) == 0


def test_one_photograph_is_refused(run: Refine, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    one = make_photographed(tmp_path / "one", count=1)
    assert run(flight=one.flight, mesh=one.mesh) == 2
    assert "needs at least two" in capfd.readouterr().err


def test_the_command_passes_everything_on(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    from typer.testing import CliRunner

    from overfly.cli import app

    told: list[list[str]] = []
    monkeypatch.setattr("overfly.run.main", lambda argv: told.append(argv) or 0)
    (tmp_path / "it's a flight").mkdir()
    options = ["--faces=5000", "--width=640", "--hold-out=0", "--lambda=0.5", "--generator=network", "--cameras=given"]
    result = CliRunner().invoke(app, ["refine", str(tmp_path / "it's a flight"), "--out", "out", *options])
    assert result.exit_code == 0, result.output
    (asked,) = told
    assert f"data.flight='{tmp_path}/it\\'s a flight'" in asked
    assert {"stage=ssgan3d", "model=mesh_generator", "data.mesh=null", "data.faces=5000"} < set(asked)
    assert {"data.width=640", "data.hold_out=0", "loss.adversarial=0.5", "data.cameras=given"} < set(asked)
    assert asked[-1] == "hydra.run.dir='out'"


def test_colours_are_of_what_is_seen_and_grey_elsewhere(given: Photographed) -> None:
    from overfly.data.photographs import photographs

    shots = photographs(given.frames, width=None, hold_out=3, multiple=16, origin=SHIFT)
    mesh = flat_mesh(1.0)
    lid = mesh.vertices + np.array([0, 0, 5.0])  # hides the ground in its middle
    chosen = mesh.faces[(np.abs(mesh.vertices[mesh.faces].mean(1)[:, :2]) < 6).all(1)]
    faces = np.concatenate([mesh.faces, chosen + len(lid)]).astype(np.int32)
    both = Mesh(np.concatenate([mesh.vertices, lid]), faces)
    found = colors_from(both, topology(both.faces, len(both.vertices)), shots)[: len(lid)]
    x, y = np.abs(mesh.vertices[:, :2]).T
    under, outside = (x < 3) & (y < 3), (x > 12) & (x < 15) & (y < 9)
    assert (found[under] == 128).all()
    assert np.abs(found[outside] / 255 - color(mesh.vertices[outside, :2])).mean() < 0.05
    nothing = replace(shots, valid=np.zeros_like(shots.valid))
    assert (colors_from(both, topology(both.faces, len(both.vertices)), nothing) == 128).all()


def test_shapes_are_measured_over_all_the_ground_under_a_coarse_mesh() -> None:
    truth = np.random.default_rng(0).uniform([-30, -30], [30, 30], (20_000, 2))
    coarse = flat_mesh(8.0, half=(20.0, 12.0))
    measure = ShapeMeasure(Cloud(np.c_[truth, np.full(len(truth), 0.25)]), coarse)
    inside = (np.abs(truth) < [20, 12]).all(1).sum()
    assert inside <= len(measure.truth) < 1.3 * inside
    found = measure(coarse.vertices, coarse.faces)
    assert found["completeness_m"] == pytest.approx(0.25, abs=0.02)
    assert found["accuracy_m"] == pytest.approx(0.3, abs=0.05)  # 20 points in a square metre
    assert found["fscore_0.5m"] > 0.9
    with pytest.raises(InputError, match="no common ground"):
        ShapeMeasure(Cloud(np.c_[truth + 500, truth[:, :1]]), coarse)


def test_faces_without_area_are_left_out() -> None:
    faces = np.array([[0, 1, 2], [1, 1, 2], [2, 1, 2], [3, 2, 3], [2, 1, 3]], np.int32)
    assert with_area(faces).tolist() == [[0, 1, 2], [2, 1, 3]]
