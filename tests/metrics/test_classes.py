"""The torchmetrics classes are means of the pure functions, in any batching, and do not mix with each other."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import torch
from torch import Tensor

from overfly import metrics
from overfly.errors import InputError
from overfly.metrics import (
    Accuracy,
    ChamferM,
    ChamferM2,
    ChamferSum1024,
    Completeness,
    EmdM,
    EmdSum1024,
    FScore,
    HausdorffM,
    Precision,
    Recall,
    collection,
)
from overfly.metrics import functional as f


def batch(pairs: int = 5, n: int = 60, m: int = 60, seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(pairs, n, 3, generator=generator), torch.rand(pairs, m, 3, generator=generator)


CASES = [
    (ChamferM2(), f.chamfer_m2, "chamfer_m2"),
    (ChamferM(), f.chamfer_m, "chamfer_m"),
    (HausdorffM(), f.hausdorff_m, "hausdorff_m"),
    (Accuracy(), f.accuracy_m, "accuracy_median_m"),
    (Accuracy(0.9), lambda a, b: f.accuracy_m(a, b, 0.9), "accuracy_p90_m"),
    (Completeness(), f.completeness_m, "completeness_median_m"),
    (Precision(0.1), lambda a, b: f.precision(a, b, 0.1), "precision_10cm"),
    (Recall(0.1), lambda a, b: f.recall(a, b, 0.1), "recall_10cm"),
    (FScore(0.1), lambda a, b: f.fscore(a, b, 0.1), "fscore_10cm"),
    (EmdM(), f.emd_m, "emd_m"),
    (ChamferSum1024(), lambda a, b: f.chamfer_sum(a, b) * 1024 / 60, "chamfer_sum_1024"),
    (EmdSum1024(), lambda a, b: f.emd_m(a, b) * 1024, "emd_sum_1024"),
]


@pytest.mark.parametrize(("metric", "function", "key"), CASES, ids=[key for _, _, key in CASES])
def test_mean_of_the_function_in_any_batching(metric, function, key: str) -> None:
    predicted, target = batch()
    metric.reset()
    metric.update(predicted[:2], target[:2])
    metric.update(predicted[2:], target[2:])
    expected = np.mean([function(p, t) for p, t in zip(predicted, target)])
    assert metric.compute().item() == pytest.approx(expected, rel=1e-6)
    assert metric.key == key
    copy = pickle.loads(pickle.dumps(metric))
    assert copy.compute().item() == metric.compute().item()
    metric.reset()
    metric.update(predicted[:1], target[:1])
    assert metric.compute().item() == pytest.approx(function(predicted[0], target[0]), rel=1e-6)


def test_scale_turns_window_units_into_metres() -> None:
    predicted, target = batch(2)
    scale = torch.tensor([100.0, 40.0])
    pairs = list(zip(predicted.double() * scale[:, None, None], target.double() * scale[:, None, None]))
    for metric, function in ((ChamferM2(), f.chamfer_m2), (EmdM(), f.emd_m), (HausdorffM(), f.hausdorff_m)):
        metric.update(predicted, target, scale=scale)
        assert metric.compute().item() == pytest.approx(np.mean([function(*p) for p in pairs]), rel=1e-6)
    share = FScore(5.0)
    share.update(predicted, target, scale=scale)
    assert share.compute().item() == pytest.approx(np.mean([f.fscore(*p, 5.0) for p in pairs]), rel=1e-6)


def test_gsd_thresholds() -> None:
    predicted, target = batch(2)
    metric = Recall(2, unit="gsd")
    assert metric.key == "recall_2gsd"
    metric.update(predicted, target, scale=torch.tensor([10.0, 20.0]), gsd=torch.tensor([0.5, 0.2]))
    expected = [f.recall(predicted[0] * 10, target[0] * 10, 1.0), f.recall(predicted[1] * 20, target[1] * 20, 0.4)]
    assert metric.compute().item() == pytest.approx(np.mean(expected), rel=1e-6)
    with pytest.raises(ValueError, match="gsd="):
        metric.update(predicted, target)


def test_sums_over_1024_take_seeded_subsets_of_large_clouds() -> None:
    predicted, target = batch(2, 1500, 1300)
    for kind in (ChamferSum1024, EmdSum1024):
        one, same, other, halves = kind(seed=3), kind(seed=3), kind(seed=4), kind(seed=3)
        for metric in (one, same, other):
            metric.update(predicted, target)
        halves.update(predicted[:1], target[:1])
        halves.update(predicted[1:], target[1:])
        assert one.compute() == same.compute() == halves.compute()
        assert one.compute() != other.compute()
    small = ChamferSum1024(seed=3)
    small.update(predicted, target)
    expected = [
        f.chamfer_sum(f.subset(p, 1024, 3, i, 0), f.subset(t, 1024, 3, i, 1))
        for i, (p, t) in enumerate(zip(predicted, target))
    ]
    assert small.compute().item() == pytest.approx(np.mean(expected))


def test_collection_clones_with_prefix_and_keeps_equal_states_apart() -> None:
    """After a first batch where all F-scores are 0, they must not be merged into one."""
    group = collection(FScore(0.01), FScore(0.2), Recall(0.2), Precision(0.2), ChamferM(), ChamferSum1024(), EmdM())
    val = group.clone(prefix="val/")
    predicted, target = batch(3)
    val.update(predicted, target + 100, scale=torch.ones(3), gsd=torch.ones(3))
    assert val.compute()["val/fscore_20cm"] == 0
    val.update(predicted, target, scale=torch.ones(3), gsd=torch.ones(3))
    values = val.compute()
    pairs = list(zip(predicted, target))
    assert set(values) == {
        "val/fscore_1cm", "val/fscore_20cm", "val/recall_20cm", "val/precision_20cm", "val/chamfer_m",
        "val/chamfer_sum_1024", "val/emd_m",
    }  # fmt: skip
    assert values["val/recall_20cm"].item() == pytest.approx(np.mean([f.recall(*p, 0.2) for p in pairs]) / 2)
    assert values["val/fscore_20cm"].item() == pytest.approx(np.mean([f.fscore(*p, 0.2) for p in pairs]) / 2)
    assert values["val/fscore_1cm"] < values["val/fscore_20cm"]
    assert group.compute is not val.compute


def test_neighbours_of_a_batch_are_searched_once_and_never_stale(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    real = metrics.base.distances
    monkeypatch.setattr("overfly.metrics.base.distances", lambda *a: calls.append(1) or real(*a))
    group = collection(ChamferM(), ChamferM2(), FScore(0.1), HausdorffM())
    predicted, target = batch(2, seed=7)
    with torch.inference_mode():
        group.update(predicted, target)
        assert len(calls) == 2
        predicted += 1.0  # in place: the same tensor, other values
        group.update(predicted, target)
    assert len(calls) == 4
    late = ChamferM()
    late.update(predicted, target)
    first, second = f.chamfer_m(predicted[0], target[0]), f.chamfer_m(predicted[1], target[1])
    assert late.compute().item() == pytest.approx((first + second) / 2)


def test_lists_of_clouds_of_differing_size() -> None:
    a, b = batch(1, 30, 50)[0][0], batch(1, 70, 20, seed=2)[1][0]
    metric = ChamferM()
    metric.update([a, b], [b, a])
    assert metric.compute().item() == pytest.approx(f.chamfer_m(a, b))


def test_bad_input() -> None:
    predicted, target = batch(2)
    with pytest.raises(ValueError, match="2 and 1 clouds"):
        ChamferM().update(predicted, target[:1])
    with pytest.raises(ValueError, match="scale has 3 values for 2 pairs"):
        ChamferM().update(predicted, target, scale=torch.ones(3))
    with pytest.raises(InputError, match="no points"):
        ChamferM2().update(predicted[:, :0], target)
    with pytest.raises(InputError, match="threshold"):
        FScore(-1)
    with pytest.raises(InputError, match="threshold"):
        FScore(1, unit="km")
    with pytest.raises(InputError, match="quantile"):
        Accuracy(90)
    with pytest.raises(AttributeError, match="Chamfer"):
        metrics.Chamfer  # noqa: B018
