"""Whether training waits for its data: seconds to load a batch beside seconds to learn from it, in one run."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir

from overfly.configuration import build, conf_dir, register_resolvers


def main() -> None:
    register_resolvers()
    overrides = [
        "stage=gan",
        "run_dir=.",
        "data.source.images={train: 120, val: 20, test: 0, unseen: 0}",
        *sys.argv[1:],
    ]
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        cfg = compose("train", overrides=[*overrides, f"cache_dir={Path.home() / '.cache/overfly'}"])
    data = build(cfg.data)
    data.source.prepare("train")
    loader = data.loader("train", shuffle=True)
    network = build(cfg.model).train()
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-4)
    loading, learning, windows = 0.0, 0.0, 0
    iterator = iter(loader)
    batch = next(iterator)  # starts the workers
    while True:
        start = time.perf_counter()
        points = network(batch)["points"]
        points.square().mean().backward()
        optimizer.step()
        optimizer.zero_grad()
        learning += time.perf_counter() - start
        windows += len(points)
        start = time.perf_counter()
        try:
            batch = next(iterator)
        except StopIteration:
            break
        loading += time.perf_counter() - start
    print(f"{windows} windows, {cfg.data.workers} workers, batches of {cfg.data.batch_size}")
    print(f"learning              {1e3 * learning / windows:7.1f} ms a window")
    print(f"waiting for data      {1e3 * loading / windows:7.1f} ms a window")
    print(f"waiting / learning    {loading / learning:7.3f}")


if __name__ == "__main__":
    main()
