"""Several frames side by side: threads, each of which computes on one core."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager


@contextmanager
def in_threads(workers: int) -> Iterator[Executor]:
    """A pool of threads, each of which computes on one core: more threads below them would only get in their way.

    What waits is dropped when the block ends early.
    """
    import cv2
    import torch

    before = cv2.getNumThreads(), torch.get_num_threads()

    def alone() -> None:
        if workers > 1:
            cv2.setNumThreads(1)
            torch.set_num_threads(1)

    pool = ThreadPoolExecutor(max_workers=workers, initializer=alone)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)
        cv2.setNumThreads(before[0])
        torch.set_num_threads(before[1])
