"""A map that is killed at random moments and resumed each time, against one that was left alone.

    python benchmarks/kills.py FLIGHT --out outputs/kills [--kills 20] [--dense stereo]

The first map runs through and tells how long it takes. The second one is killed (SIGKILL, with its children) after
random times that are drawn so that the moments lie all over the map's steps, started again each time, and at last left
to end. Then every product must be the same to the last bit but report and map.json, which tell times; exit code 1 if
not.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

SAME = ("cloud.laz", "dsm.tif", "dsm_source.tif", "orthophoto.tif", "transforms.json")


def fingerprints(folder: Path) -> dict[str, str]:
    """SHA-256 of every product that tells no times."""
    return {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in SAME}


def start(command: list[str], log: Path) -> subprocess.Popen:
    """The map in a process group of its own."""
    with log.open("a") as out:
        return subprocess.Popen(command, stdout=out, stderr=out, start_new_session=True)


def last_step(log: Path, since: int) -> str | None:
    """The last step that a map told of after so many bytes of its log; None before the first."""
    lines = log.read_bytes()[since:].decode(errors="replace").replace("\r", "\n").strip().splitlines()
    return next((line.split()[0] for line in reversed(lines) if line.split()), None)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("flight", type=Path)
    parser.add_argument("--out", type=Path, default=Path("outputs/kills"))
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--dense", choices=("stereo", "sweep"), default="stereo")
    parser.add_argument("--size", type=int, default=1600)
    asked = parser.parse_args()
    shutil.rmtree(asked.out, ignore_errors=True)
    asked.out.mkdir(parents=True)

    def command(folder: str) -> list[str]:
        own = [sys.executable, "-m", "overfly.cli", "map", str(asked.flight), "--out", str(asked.out / folder)]
        return [*own, "--dense", asked.dense, "--size", str(asked.size)]

    begun = time.perf_counter()
    if start(command("whole"), asked.out / "whole.log").wait():
        raise SystemExit((asked.out / "whole.log").read_text())
    whole = time.perf_counter() - begun
    rng, log = np.random.default_rng(asked.seed), asked.out / "killed.log"
    killed: list[str] = []
    while len(killed) < asked.kills:
        since = log.stat().st_size if log.is_file() else 0
        child = start(command("killed"), log)
        while child.poll() is None and last_step(log, since) is None:  # nothing can be lost yet
            time.sleep(0.05)
        wait = rng.uniform(0, whole)  # shorter times would never get past the longest step that starts anew
        try:
            code = child.wait(timeout=wait)
        except subprocess.TimeoutExpired:
            os.killpg(child.pid, signal.SIGKILL)
            child.wait()
            killed.append(last_step(log, since) or "")
            print(f"killed {wait:.1f} s after it read the flight, the last it told was: {killed[-1]}", flush=True)
            continue
        if code:
            raise SystemExit(log.read_text())
        shutil.rmtree(asked.out / "killed")  # it came to its end before all kills: the rest hits a new one
    if start(command("killed"), log).wait():
        raise SystemExit(log.read_text())
    first, second = (fingerprints(asked.out / folder) for folder in ("whole", "killed"))
    differing = [name for name in SAME if first[name] != second[name]]
    print(f"{asked.kills} kills; {'the same to the last bit' if not differing else f'different: {differing}'}")
    raise SystemExit(bool(differing))


if __name__ == "__main__":
    main()
