"""The refinement of a mesh through the real command: it learns, resumes bit-equally, stops when told, and its parts."""

from __future__ import annotations

import json
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from overfly.errors import InputError
from overfly.mesh import read_mesh
from overfly.networks import FreeVertices, MeshGenerator
from overfly.rendering import Views
from overfly.run import main
from overfly.stages import SsGan3dStage
from overfly.stages.exposures import Exposures
from overfly.stages.levels import PATIENCE, Levels, converged
from overfly.stages.refined_mesh import RefinedMesh, prepared
from overfly.stages.shots import Shot, patches, shot_of
from overfly.tables import read_rows
from photographed import KNOWN_WARNINGS, SHIFT, Photographed, flat_mesh, height, make_photographed

pytestmark = KNOWN_WARNINGS

LEVELS = "stage.levels=[{faces:700,shrink:2},{faces:1300,shrink:1},{faces:2600,shrink:1}]"
TWO_LEVELS = "stage.levels=[{faces:700,shrink:2},{faces:700,shrink:1}]"
NETWORK = ["model=mesh_generator", "model.critic.width=4", "model.lr=0.005"]

Train = Callable[..., Path]


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Photographed:
    return make_photographed(tmp_path_factory.mktemp("knoll"))


def overrides(given: Photographed, out: Path) -> list[str]:
    weights = "alpha=1 beta=1 gamma=1 consistency=1 laplacian=0.02 normal_consistency=0.02 edge_length=0.01"
    return [
        "stage=ssgan3d", f"data.flight={given.flight}", f"data.mesh={given.mesh}", f"data.reference={given.reference}",
        "data.width=96", "data.hold_out=3",
        "data.batch_size=2", "model.critic.width=4", "model.lr=0.3", "loss.adversarial=0", LEVELS,
        *(f"loss.{item}" for item in weights.split()), "stage.patches=1", "stage.patch_size=32", "stage.tolerance=0",
        "stage.robust=5", "trainer.max_epochs=6", "trainer.accelerator=cpu", "trainer.enable_progress_bar=false",
        "callbacks.results.photographs=1", "callbacks.results.every_n_epochs=100", f"hydra.run.dir={out}",
    ]  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def _few_samples() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("overfly.refinement.measure.SAMPLES", 10_000)
        yield


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Titles of the pictures, which are not drawn: that takes longer than the runs here."""
    titles: list[str] = []
    monkeypatch.setattr("overfly.callbacks.refinement.plot_photograph", lambda *a: titles.append(a[-1]))
    return titles


@pytest.fixture
def train(given: Photographed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, drawn: list[str]) -> Iterator[Train]:
    """Run train.py's entry in this process; returns the run folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["train.py"])
    interrupt = signal.getsignal(signal.SIGINT)

    def run(name: str, *more: str, code: int = 0) -> Path:
        own = [] if any(item.startswith("resume=") for item in more) else overrides(given, tmp_path / name)
        assert main([*own, *more]) == code
        return tmp_path / name

    yield run
    signal.signal(signal.SIGINT, interrupt)  # Lightning leaves it ignored after an interruption


def results(run: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((run / "metrics.json").read_text())
    return found


@pytest.fixture(scope="module")
def finished(given: Photographed, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An uninterrupted run, with the true surface."""
    out = tmp_path_factory.mktemp("refinement") / "whole"
    before = list(sys.argv)
    sys.argv = ["train.py"]
    try:
        assert main(overrides(given, out)) == 0
    finally:
        sys.argv = before
    return out


def test_a_flat_mesh_becomes_the_knoll(finished: Path) -> None:
    metrics = results(finished)["metrics"]
    assert metrics["val/loss"] < 0.85 * metrics["start/loss"]
    assert metrics["val/psnr_db"] > metrics["start/psnr_db"] + 2
    assert metrics["val/ssim"] > metrics["start/ssim"] + 0.1
    assert metrics["val/nc"] > metrics["start/nc"]
    assert metrics["val/chamfer_m"] < 0.85 * metrics["start/chamfer_m"]
    assert metrics["val/fscore_0.5m"] > metrics["start/fscore_0.5m"]
    assert {"train/loss", "train/loss_reconstruction", "train/loss_consistency", "val/covered"} <= set(metrics)
    rows = read_rows(finished / "metrics.csv")
    assert [row["epoch"] for row in rows] == list(range(6))
    assert len({row["start/loss"] for row in rows}) == 1  # the same in every line: what there was to begin with


def test_start_and_refined_mesh_stand_in_the_frame_of_the_cameras(finished: Path, given: Photographed) -> None:
    rough, start, refined = (read_mesh(path) for path in (given.mesh, finished / "start.ply", finished / "refined.ply"))
    np.testing.assert_allclose(start.vertices, rough.vertices, atol=1e-6)
    assert np.array_equal(start.faces, rough.faces)
    assert np.array_equal(start.colors, rough.colors)
    assert refined.colors is not None
    own = refined.vertices - SHIFT
    inner = (np.abs(own[:, :2]) < 7).all(1)
    error = np.abs(own[inner, 2] - height(own[inner, :2]))
    assert error.mean() < 0.7 * height(own[inner, :2]).mean()  # of a flat mesh it is that height
    assert np.abs(own[:, :2]).max() < 25


def test_levels_add_faces(finished: Path) -> None:
    text = (finished / "train.log").read_text()
    assert "level 1:" not in text  # the rough mesh has its faces already
    assert 0.9 * 2600 <= len(read_mesh(finished / "refined.ply").faces) <= 2600
    told = [int(line.rsplit(": ", 1)[1].split()[0]) for line in text.splitlines() if "] - level " in line]
    assert len(told) == 2
    assert 0.9 * 1300 < told[0] <= 1300 < told[1] <= 2600


def test_pictures_show_held_out_photographs(finished: Path, given: Photographed) -> None:
    from PIL import Image

    (path,) = (finished / "pictures").glob("*.png")
    assert np.asarray(Image.open(path)).std() > 10
    assert "4 photographs" not in (finished / "train.log").read_text()
    assert "6 photographs of 96 x 64 pixels, 2 held out" in (finished / "train.log").read_text()
    assert (finished / "checkpoints" / "best.ckpt").is_file()


@pytest.mark.parametrize(
    ("epoch", "step", "more"),
    [
        (2, 0, []),  # the checkpoint precedes a subdivision that follows the errors of the epoch before
        (3, 1, []),  # within the level
        (4, 1, ["loss.adversarial=0.05", "stage.critic_steps=2", *NETWORK]),
    ],
)
def test_a_resumed_run_ends_like_an_uninterrupted_one(
    train: Train, finished: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], epoch: int,
    step: int, more: list[str],
) -> None:  # fmt: skip
    whole = train("whole", *more) if more else finished
    own = SsGan3dStage.training_step

    def stopped(self: SsGan3dStage, batch: Any, batch_idx: int) -> None:
        if (self.current_epoch, batch_idx) == (epoch, step):
            raise KeyboardInterrupt
        own(self, batch, batch_idx)

    with monkeypatch.context() as patch:
        patch.setattr(SsGan3dStage, "training_step", stopped)
        part = train("part", *more, code=130)
    assert "resume=<the run folder>" in capfd.readouterr().err
    assert not (part / "metrics.json").exists()
    train("part", f"resume={part}")
    assert results(part) == results(whole)
    assert read_rows(part / "metrics.csv") == read_rows(whole / "metrics.csv")
    assert (part / "refined.ply").read_bytes() == (whole / "refined.ply").read_bytes()


def test_resuming_a_finished_run_keeps_its_results(train: Train, finished: Path) -> None:
    names, rows = ("metrics.json", "start.ply", "refined.ply"), read_rows(finished / "metrics.csv")
    before = [(finished / name).read_bytes() for name in names]
    train("", f"resume={finished}")
    assert [(finished / name).read_bytes() for name in names] == before
    assert read_rows(finished / "metrics.csv") == rows
    assert "ssgan3d: finished before" in (finished / "train.log").read_text()


def test_a_run_that_was_killed_after_its_last_epoch_is_completed(train: Train, finished: Path, tmp_path: Path) -> None:
    before, mesh = results(finished), (finished / "refined.ply").read_bytes()
    for name in ("refined.ply", "metrics.json"):
        shutil.move(finished / name, tmp_path / name)
    try:
        train("", f"resume={finished}")
        assert (finished / "refined.ply").read_bytes() == mesh
        after = results(finished)
    finally:
        for name in ("refined.ply", "metrics.json"):
            shutil.move(tmp_path / name, finished / name)
    for name in ("val/psnr_db", "val/loss"):
        assert after["metrics"][name] == pytest.approx(before["metrics"][name])


@pytest.mark.parametrize(
    ("epochs", "levels", "says"),
    [
        (1, [{"faces": 10, "shrink": 1}] * 2, "1 epochs are too few for 2 levels"),
        (3, [{"faces": 10}], "give faces and shrink"),
        (3, [{"faces": 10, "shrink": 0}], "1 or more"),
    ],
)
def test_impossible_levels_are_refused(epochs: int, levels: list[dict[str, int]], says: str) -> None:
    with pytest.raises(InputError, match=says):
        Levels(epochs, levels)


def test_training_stops_when_the_loss_has_come_to_rest_and_says_so(train: Train) -> None:
    run = train("run", "stage.tolerance=0.9", "trainer.max_epochs=10", TWO_LEVELS)
    assert results(run)["epochs"] == 5 + PATIENCE + 1  # the epochs of the level before do not count
    assert "Stopped by the overall loss, which converged at" in (run / "train.log").read_text()
    train("run", f"resume={run}")  # and has not become restless
    assert results(run)["epochs"] == 5 + PATIENCE + 1
    assert "finished before" in (run / "train.log").read_text()


@pytest.mark.parametrize(("model", "lr"), [("free_vertices", 0.3), ("mesh_generator", 0.005)])
def test_both_generators_and_the_critic_train(train: Train, model: str, lr: float) -> None:
    more = [f"model={model}", f"model.lr={lr}", "model.critic.width=4", "loss.adversarial=0.1", TWO_LEVELS]
    run = train("run", *more, "trainer.max_epochs=2")
    metrics = results(run)["metrics"]
    assert {"train/loss_adversarial", "train/critic_distance", "train/gradient_penalty"} <= set(metrics)
    assert metrics["val/loss"] < metrics["start/loss"]


def test_fast_dev_run_passes_and_leaves_no_mesh(train: Train) -> None:
    run = train("run", "trainer.fast_dev_run=true", "loss.adversarial=0.1")
    assert not list(run.glob("*.ply"))
    assert "val/loss" in results(run)["metrics"]


def test_pictures_tell_how_their_photograph_was_used(train: Train, drawn: list[str]) -> None:
    one = ["trainer.max_epochs=2", TWO_LEVELS, "callbacks.results.photographs=2", "callbacks.results.every_n_epochs=1"]
    train("some", *one)
    held = [f"frame_000{i}.jpg, not refined on" for i in (2, 5)]
    assert drawn == [f"{name}; epoch {epoch}" for epoch in (1, 2, 2) for name in held]
    drawn.clear()
    run = train("none", *one, "data.hold_out=0")
    assert "0 held out" in (run / "train.log").read_text()
    assert drawn[0] == "frame_0001.jpg, refined on; epoch 1"


@pytest.mark.parametrize(
    ("more", "says"),
    [
        (["from_run=nowhere"], "starts from a mesh, not from the weights in nowhere: give its refined.ply"),
        (["+loss.alpah=1"], "alpha"),
        (["loss.alpha=0", "loss.beta=0", "loss.gamma=0", "loss.consistency=0"], "Nothing compares the mesh"),
        (["stage.levels=[]"], "stage.levels is empty"),
        (["data.hold_out=1"], "hold_out=1 leaves no photograph"),
        (["data.dense=sweep", "data.mesh=null"], "use data.dense=stereo"),
    ],
)  # fmt: skip
def test_what_is_impossible_is_one_sentence(
    train: Train, capfd: pytest.CaptureFixture[str], more: list[str], says: str
) -> None:
    train("run", *more, code=2)
    assert says in capfd.readouterr().err


# -- the parts ---------------------------------------------------------------------------------------------------------


def test_levels_share_the_epochs_and_the_rate_falls_in_each() -> None:
    levels = Levels(7, [{"faces": 10, "shrink": 4}, {"faces": 20, "shrink": 2}, {"faces": 40, "shrink": 1}])
    assert [levels.due(epoch) for epoch in range(9)] == [0, 0, 0, 1, 1, 2, 2, 2, 2]
    assert levels[levels.last] == (40, 1)
    for index in range(3):
        start = index * 7 / 3
        rates = [levels.rate(index, start + share * 7 / 3) for share in (0, 0.25, 0.5, 0.75, 1, 2)]
        assert rates == pytest.approx([1, (1 + 0.5**0.5) / 2, 0.5, (1 - 0.5**0.5) / 2, 0.1, 0.1])


def test_a_loss_has_come_to_rest_when_it_no_longer_falls_under_the_threshold() -> None:
    assert not converged([1.0] * PATIENCE, threshold=None, tolerance=0.1)
    assert converged([1.0] * (PATIENCE + 1), threshold=None, tolerance=0.1)
    assert converged([1.0] * (PATIENCE + 1), threshold=1.1, tolerance=0.1)
    assert not converged([1.0] * (PATIENCE + 1), threshold=1.0, tolerance=0.1)
    assert not converged([1.0] * (PATIENCE + 1), threshold=None, tolerance=0)
    assert not converged([1.0, *[0.8] * PATIENCE], threshold=None, tolerance=0.1)
    assert converged([1.0, *[0.95] * PATIENCE], threshold=None, tolerance=0.1)
    assert converged([-1.0, *[-1.05] * PATIENCE], threshold=None, tolerance=0.1)


def small_batch() -> dict[str, torch.Tensor]:
    rng = torch.Generator().manual_seed(0)
    k = torch.tensor([[30.0, 0, 15], [0, 31, 9], [0, 0, 1]]).repeat(2, 1, 1)
    batch: dict[str, torch.Tensor] = {"index": torch.tensor([3, 1])}
    for of in ("", "other_"):
        batch |= {f"{of}image": torch.rand(2, 3, 16, 32, generator=rng), f"{of}intrinsics": k}
        batch |= {f"{of}valid": torch.ones(2, 16, 32, dtype=torch.bool), f"{of}camera_from_local": torch.eye(4)[None]}
    return batch


def test_a_reduced_photograph_has_a_reduced_camera() -> None:
    batch = small_batch()
    batch["valid"][0, 5, 7] = False
    whole, half, other = shot_of(batch), shot_of(batch, shrink=2), shot_of(batch, shrink=2, of="other_")
    assert whole.views.size == (32, 16)
    assert half.views.size == (16, 8)
    torch.testing.assert_close(half.views.intrinsics[0], torch.tensor([[15.0, 0, 7.5], [0, 15.5, 4.5], [0, 0, 1]]))
    torch.testing.assert_close(half.image[0, :, 2, 3], whole.image[0, :, 4:6, 6:8].mean((1, 2)))
    assert half.valid.sum() == 2 * 16 * 8 - 1
    assert half.valid[0, 2, 3] == 0
    torch.testing.assert_close(other.image[1, 0, 0, 0], batch["other_image"][1, 0, :2, :2].mean())
    assert half.indices.tolist() == [3, 1]


def test_patches_show_the_same_places_and_the_best_covered() -> None:
    real = torch.arange(2 * 16 * 32.0).reshape(2, 1, 16, 32).repeat(1, 3, 1, 1)
    fake, mask = (real + 0.5).requires_grad_(), torch.ones(2, 16, 32)
    mask[:, :, :16] = 0
    draw = partial(patches, fake, real, count=3, size=8)
    virtual, true = draw(mask, random=torch.Generator().manual_seed(1))
    assert virtual.shape == true.shape == (6, 3, 8, 8)
    for i in range(6):
        first = int(true[i, 0, 0, 0]) % 512
        row, column = first // 32, first % 32
        assert torch.equal(true[i], real[i // 3, :, row : row + 8, column : column + 8])
        known = mask[i // 3, row : row + 8, column : column + 8]
        assert torch.equal(virtual[i], true[i] + 0.5 * known)
    (gradient,) = torch.autograd.grad(virtual.sum(), fake)
    assert (gradient[..., :16] == 0).all()
    _, again = draw(mask, random=torch.Generator().manual_seed(1))
    _, others = draw(mask, random=torch.Generator().manual_seed(2))
    assert torch.equal(true, again)
    assert not torch.equal(true, others)
    assert patches(fake, real, mask, count=1, size=99, random=torch.Generator())[0].shape == (2, 3, 16, 16)


def test_exposures_find_brightness_and_their_mean_stays_one() -> None:
    batch = small_batch()
    held_out = np.array([False, False, True, False])
    exposures, shot = Exposures(held_out), shot_of(batch)
    gain = torch.tensor([1.3, 0.8])[:, None, None, None]
    for _ in range(60):
        gains = exposures(shot.image / gain, shot, shot.valid)
    assert gains[0, 0] / gains[1, 0] == pytest.approx(1.3 / 0.8, rel=1e-3)
    flat = Exposures(held_out)
    for _ in range(60):
        for pair in ([0, 1], [3, 3]):
            dark = flat(0.7 * shot.image, Shot(*shot[:3], torch.tensor(pair)), shot.valid)
    torch.testing.assert_close(dark, torch.ones(2, 3), atol=1e-3, rtol=0)  # all too dark: the colours' own fault


def refined(kind: Any = FreeVertices) -> RefinedMesh:
    torch.manual_seed(0)
    return RefinedMesh(prepared(flat_mesh(2.0), "cpu"), generator=kind, step=0.5)


@pytest.mark.parametrize("kind", [FreeVertices, MeshGenerator])
def test_a_subdivided_mesh_is_saved_and_loaded_whole(kind: Any) -> None:
    mesh, fresh = refined(kind), refined(kind)
    assert mesh.edge_m == pytest.approx(2.0)
    with torch.no_grad():
        for parameter in mesh.parameters():
            parameter += 0.01 * torch.randn_like(parameter)
    before, area = mesh.prepared(), 44.0 * 32.0
    mesh.error[:50] = 1.0
    assert mesh.subdivide_to(1500, least=0.01)
    assert not mesh.error.any()
    assert 1350 <= len(mesh.faces) <= 1500
    torch.testing.assert_close(mesh.prepared().vertices[: len(before.vertices)], before.vertices)
    assert flat_mesh(2.0).areas().sum() == pytest.approx(area)
    mesh.error[3] = 2.0
    edge = mesh.edge_m = 1.2345
    fresh.load_state_dict(mesh.state_dict())
    for a, b in zip(fresh.prepared()[:2], mesh.prepared()[:2], strict=True):
        assert torch.equal(a, b)
    assert all(torch.equal(a, b) for a, b in zip(fresh.sides[:4], mesh.sides[:4], strict=True))
    assert np.array_equal(fresh.error, mesh.error)
    assert fresh.edge_m == edge
    assert not fresh.subdivide_to(1000, least=0.01)
    assert fresh.to("meta").faces.device.type == "meta"


def test_the_most_different_faces_become_finer() -> None:
    mesh = refined()
    down = Views(
        torch.tensor([[[40.0, 0, 32], [0, 40, 24], [0, 0, 1]]]),
        torch.tensor([[[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 30], [0, 0, 0, 1]]]),
        (64, 48),
    )
    seen = mesh.prepared().seen_by(down)
    photograph = seen.image.detach().clone()
    photograph[..., :16, :16] = 0  # wrong in the corner at small x and large y
    valid = torch.ones(1, 48, 64)
    valid[:, 40:] = 0
    photograph[..., 40:, :] = 0  # and where it is not known
    mesh.add_error(seen, photograph, valid)
    assert 0 < (mesh.error > 0).sum() < 100
    count = len(mesh.prepared().vertices)
    assert mesh.subdivide_to(len(mesh.faces) + 100, least=0.01)
    new = mesh.prepared().vertices[count:]
    assert len(new) > 20
    assert (new[:, 0] < -9).all()
    assert (new[:, 1] > 3).all()
