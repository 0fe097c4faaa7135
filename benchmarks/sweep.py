"""The sweep's kernels beside plain torch, and the shipped network on a frame of one megapixel: `make bench`.

The plain way stands in the tests, so they must be importable (PYTHONPATH=tests:tests/networks).
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable

import torch
from test_sweep_kernels import GROUPS, STRIDE, make_inputs, plainly

from overfly.networks.sweep import agreement
from overfly.shipped import load_network
from terrain import make_batch


def seconds(call: Callable[[], object], times: int = 5) -> float:
    """The fastest of several calls, after one that compiles."""
    call()
    found = []
    for _ in range(times):
        start = time.perf_counter()
        call()
        found.append(time.perf_counter() - start)
    return min(found)


def main() -> None:
    reference, others, cast, heights = make_inputs(width=256, height=192, channels=32)

    def step(operation: Callable[..., object]) -> None:
        leaves = reference.clone().requires_grad_(), others.clone().requires_grad_()
        operation(*leaves, cast, heights)[0].square().sum().backward()  # type: ignore[index]

    plain = seconds(lambda: step(plainly))
    fused = seconds(lambda: step(lambda *given: agreement(*given, stride=STRIDE, groups=GROUPS)))
    print(
        f"sweep of 4 frames, forward and backward: kernels {fused:.3f} s, plain torch {plain:.3f} s, "
        f"{fused / plain:.2f} times"
    )
    network = load_network().network
    batch = make_batch(1, frames=5, width=512, height=384)
    with torch.inference_mode():
        taken = seconds(lambda: network(batch), times=3)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(
        f"surface of 512 x 384 points (every other pixel of 1024 x 768) from 5 frames: {taken:.2f} s, "
        f"{peak:.1f} GB in all"
    )


if __name__ == "__main__":
    main()
