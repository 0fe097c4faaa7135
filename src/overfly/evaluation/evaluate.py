"""The evaluation itself: every method on every window, kept window by window, then the table and the picture."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader

from overfly.data.dataset import WindowDataset
from overfly.evaluation.answers import Baselines, Batch, Network, as_true
from overfly.evaluation.chart import draw
from overfly.evaluation.measure import Values, camera_values, cloud_values, surface_values, truths
from overfly.evaluation.paired import paired
from overfly.evaluation.table import Row, tabulate, write_table
from overfly.files import replacing
from overfly.networks.verification import GroundViews, agreement, ground_views
from overfly.stages.retrieval import window_hits
from overfly.stages.supervision import matching_counts, repeated

log = logging.getLogger("overfly")

KEPT = "windows.jsonl"
"""File of the run folder with the measurements of one window a line, by which a stopped evaluation goes on."""

FORM = 5
"""Of a line in that file: counts up when other methods or metrics are measured, so that older lines do not count."""

GROUPS = {"test": "seen", "unseen": "unseen"}
"""What a split's styles are to the networks."""

KEYPOINTS = 128
"""Key points per frame on which correspondences are counted."""

REPORT_EVERY_S = 30.0


@torch.no_grad()
def evaluate(
    networks: Mapping[str, Network],
    baselines: Callable[[], Baselines],
    loaders: Mapping[str, DataLoader],
    folder: Path,
    *,
    emd_windows: int,
    draws: int,
    seed: int,
) -> list[Row]:
    """Measure all methods on the same windows and write evaluation.md, evaluation.csv and evaluation.png.

    Args:
        networks: by the name in the table.
        baselines: makes the other methods; not called if every window was measured before.
        loaders: of the windows by split, in order; their items hold ``reference_again``.
        folder: the run folder; windows that were measured in it before are not measured again.
        emd_windows: windows of each split on which the exact EMD is measured, spread over all flights.
        draws: of the bootstrap over scenes, for the confidence intervals.
        seed: of the bootstrap.

    Returns:
        The rows of the table.
    """
    estimated = any(bool(_dataset(loader).estimated) for loader in loaders.values())
    kept = _read(folder / KEPT, set(networks), estimated)
    total = sum(len(_dataset(loader)) for loader in loaders.values())
    log.info("%d of %d windows were measured before", len(kept), total) if kept else None
    with replacing(folder / KEPT) as part:  # without what a kill left unfinished
        part.write_text("".join(json.dumps(window) + "\n" for window in kept.values()))
    others: Baselines | None = None
    started, reported, measured = time.monotonic(), time.monotonic(), 0
    with (folder / KEPT).open("a") as file:
        for split, loader in loaders.items():
            dataset = _dataset(loader)
            step = max(1, -(-len(dataset) // max(emd_windows, 1)))
            for batch in loader:
                if all((split, int(index)) in kept for index in batch["index"]):
                    continue
                others = baselines() if others is None else others
                emd = [emd_windows > 0 and int(index) % step == 0 for index in batch["index"]]
                for window in measure(batch, others, networks, emd):
                    window |= {"split": GROUPS[split], "estimated": estimated, **_facts(dataset, window["index"])}
                    if (split, window["index"]) not in kept:
                        kept[split, window["index"]] = window
                        file.write(json.dumps(window) + "\n")
                        measured += 1
                file.flush()
                if time.monotonic() - reported > REPORT_EVERY_S:
                    reported = time.monotonic()
                    left = (reported - started) / measured * (total - len(kept)) / 60
                    log.info("%d of %d windows measured, about %.0f minutes to go", len(kept), total, left)
    windows = list(kept.values())
    for split, loader in loaders.items():
        own = [kept[key] for key in sorted(key for key in kept if key[0] == split)]
        for name, network in networks.items():
            _retrieve(own, loader, name, network)
    rows = tabulate(windows, draws=draws, seed=seed)
    write_table(rows, folder)
    draw(rows, folder / "evaluation.png", networks=list(networks))
    return rows


def measure(
    batch: Batch, baselines: Baselines, networks: Mapping[str, Network], emd: list[bool]
) -> list[dict[str, Any]]:
    """All numbers of the windows of a batch: plain values, one dict a window.

    ``clouds`` holds value and weight of every metric by method, ``calibration`` the sums by bin of confidence, and
    ``encoders`` what retrieval needs from each network.
    """
    answers = {**baselines(batch), **{name: network(batch) for name, network in networks.items()}}
    surfaces = [name for name in networks if answers[name].sigma is not None and answers[name].confidence is not None]
    answers |= {f"{name}, with pairs": paired(answers[name], batch) for name in surfaces}
    known = truths(batch)
    windows: list[dict[str, Any]] = [
        {"form": FORM, "index": int(index), "scene": int(scene), "clouds": {}, "calibration": {}, "encoders": {}}
        for index, scene in zip(batch["index"], batch["scene"], strict=True)
    ]
    cameras = [camera_values(batch, number) for number in range(len(windows))]
    for name, answer in answers.items():
        for number, (window, truth) in enumerate(zip(windows, known, strict=True)):
            values, calibration = surface_values(answer, number, truth)
            window["clouds"][name] = {
                **cloud_values(answer, number, truth, emd=emd[number]),
                **values,
                **cameras[number],
            }
            if calibration is not None:
                window["calibration"][name] = calibration
    for name, network in networks.items():
        for window, (values, encoder) in zip(windows, _encoder(network, batch), strict=True):
            window["clouds"][name] |= values
            window["encoders"][name] = encoder
    return windows


def _encoder(network: Network, batch: Batch) -> list[tuple[Values, dict[str, Any]]]:
    """Correspondences of each window, and what is needed for retrieval once all windows are known."""
    if batch["images"].shape[1] < 2:
        return [({}, {"descriptors": [], "overlaps": []}) for _ in batch["index"]]
    output, seen = network.encode(batch)
    seen = as_true(seen)
    overlaps = batch["overlaps"].masked_fill(repeated(batch), -1.0)
    found = []
    for b in range(len(overlaps)):
        right, visible = matching_counts(_window(output, b), _window(seen, b), KEYPOINTS)
        values: Values = {"match_top1": (right / visible, float(visible))} if visible else {}
        found.append((values, {"descriptors": _listed(output["descriptor"][b]), "overlaps": _listed(overlaps[b])}))
    return found


def _retrieve(windows: list[dict[str, Any]], loader: DataLoader, name: str, network: Network) -> None:
    """Add retrieval to each window of a split, in the order of the loader: among all frames of all its scenes."""
    if not windows or not windows[0]["encoders"][name]["descriptors"]:
        return
    descriptors, overlaps = (
        torch.tensor([window["encoders"][name][key] for window in windows]) for key in ("descriptors", "overlaps")
    )
    scenes = torch.tensor([window["scene"] for window in windows])
    log.info("Looking for the frames of %d windows among each other, by %s", len(windows), name)
    views = _ground_views(loader, network)

    def verify(frame: int, others: Tensor) -> Tensor:
        return agreement(_of(views, [frame]), _of(views, others))

    for metric, judge in {"retrieval_top1": None, "retrieval_verified_top1": verify}.items():
        hits, asked = window_hits(descriptors, overlaps, scenes, judge)
        for window, hit, some in zip(windows, hits.tolist(), asked.tolist(), strict=True):
            if some:
                window["clouds"][name][metric] = (hit / some, some)


def _ground_views(loader: DataLoader, network: Network) -> GroundViews:
    """Of all frames of a split, window by window; features in half precision, which is enough to compare them."""
    parts = []
    for batch in loader:
        seen = network.sized(batch)
        frames = (seen[key].flatten(0, 1) for key in ("images", "intrinsics", "prior_from_window"))
        found = ground_views(network.network.encoder, *frames)  # type: ignore[arg-type]
        parts.append(GroundViews(found.maps.half(), found.inside))
    return GroundViews(*(torch.cat(part) for part in zip(*parts, strict=True)))


def _of(views: GroundViews, chosen: Any) -> GroundViews:
    return GroundViews(views.maps[chosen], views.inside[chosen])


def _facts(dataset: WindowDataset, index: int) -> dict[str, Any]:
    """The cell of a window; a flight of the user's own may not know all of it."""
    facts = dataset.records[dataset.windows[index][0]].facts
    cell = {"overlap": facts.get("overlap"), "altitude": facts.get("altitude"), "path": facts.get("flight_path")}
    named = {name: "unknown" if value is None else value for name, value in cell.items()}
    return {name: round(value) if isinstance(value, float) else value for name, value in named.items()}


def _read(path: Path, networks: set[str], estimated: bool) -> dict[tuple[str, int], dict[str, Any]]:
    """What a stopped evaluation has measured; unfinished lines and those of other networks, methods or cameras do not
    count."""
    splits = {group: split for split, group in GROUPS.items()}
    kept: dict[tuple[str, int], dict[str, Any]] = {}
    lines = path.read_text().splitlines() if path.is_file() else []
    for line in lines:
        try:
            window = json.loads(line)
        except json.JSONDecodeError:
            continue
        same = set(window["encoders"]) == networks and window.get("estimated", False) == estimated
        if same and window.get("form") == FORM:
            kept[splits[window["split"]], window["index"]] = window
    return kept


def _dataset(loader: DataLoader) -> WindowDataset:
    assert isinstance(loader.dataset, WindowDataset)
    return loader.dataset


def _window(values: Mapping[str, Tensor], number: int) -> dict[str, Tensor]:
    return {name: value[number : number + 1] for name, value in values.items() if isinstance(value, Tensor)}


def _listed(values: Tensor) -> list[Any]:
    rounded: list[Any] = values.double().mul(1e4).round().div(1e4).tolist()
    return rounded
