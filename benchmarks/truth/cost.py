"""What a command costs: core-seconds, wall-clock seconds and the most memory that it held."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path


def run_measured(
    command: Sequence[str],
    log: Path,
    *,
    env: dict[str, str] | None = None,
    append: bool = False,
    before: Callable[[], None] | None = None,
) -> dict[str, float]:
    """Run a command to its end, its output in a file, and return ``core_seconds``, ``seconds`` and ``peak_mb``.

    The peak is that of the command and its children together, as looked at five times a second. ``before`` is called in
    the new process, to set its limits.

    Raises:
        RuntimeError: it failed; the message is the last line that it wrote.
    """
    start, peak_kb = time.perf_counter(), 0
    with log.open("a" if append else "w") as out:
        child = subprocess.Popen(command, stdout=out, stderr=out, env=os.environ | (env or {}), preexec_fn=before)
        while not (ended := os.wait4(child.pid, os.WNOHANG))[0]:
            peak_kb = max(peak_kb, _held_kb(child.pid))
            time.sleep(0.2)
    _, status, usage = ended
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise RuntimeError((log.read_text().strip() or f"exit code {child.returncode}").splitlines()[-1])
    return {
        "core_seconds": usage.ru_utime + usage.ru_stime,
        "seconds": time.perf_counter() - start,
        "peak_mb": peak_kb / 1024,
    }


def _held_kb(pid: int) -> int:
    """Resident memory of a process and its descendants, kB; 0 where it has ended."""
    held = 0
    try:
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("VmRSS:"):
                held = int(line.split()[1])
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return held
    return held + sum(_held_kb(int(child)) for child in children)
