from __future__ import annotations

import errno
import multiprocessing
from pathlib import Path

import numpy as np
import pytest
from plane import make_record, surface

from overfly.data.record import cached, read_record, write_record
from overfly.errors import InputError


def test_a_record_is_read_as_it_was_written(record_folder: Path) -> None:
    record, again = make_record(), read_record(record_folder)
    assert again.cameras == record.cameras
    assert again.facts == record.facts
    for name in ("images", "depth", "world_from_camera", "heights"):
        np.testing.assert_array_equal(getattr(again, name), getattr(record, name))


def test_surface_gives_true_heights_and_nan_outside() -> None:
    record = make_record()
    xy = np.array([[10.3, -55.1], [-200.0, 250.0]])
    np.testing.assert_allclose(record.surface(xy), surface(xy), atol=0.06)  # a cell is 2 m wide and rises 0.1 m
    assert np.isnan(record.surface(np.array([1e6, 0.0])))


def test_a_full_disk_is_one_sentence_and_leaves_no_half_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, array: np.ndarray) -> None:
        if Path(path).name == "depth.npy":
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("overfly.data.record.np.save", full)
    with pytest.raises(InputError, match=r"is full.*cache_dir"):
        write_record(make_record(), tmp_path / "flight")
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_process_left_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "flight.12345.part").mkdir()
    folder = cached(tmp_path / "flight", make_record)
    assert len(read_record(folder)) == 6
    assert not (tmp_path / "flight.12345.part").exists()


def _make(folder: Path, log: Path) -> None:
    def make():  # type: ignore[no-untyped-def]
        with log.open("a") as file:
            file.write("made\n")
        return make_record()

    cached(folder, make)


def test_two_processes_make_a_record_once(tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork")
    workers = [context.Process(target=_make, args=(tmp_path / "flight", tmp_path / "log")) for _ in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
        assert worker.exitcode == 0
    assert (tmp_path / "log").read_text() == "made\n"
