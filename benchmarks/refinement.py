"""SS-GAN-3D on synthetic scenes of known surface: variants from the same rough mesh, judged on held-out frames.

    python benchmarks/refinement.py --out outputs/refinements
    python benchmarks/refinement.py --variants full no_critic --scenes village --paths grid --seeds 0

Finished cells are kept: the same command goes on. Writes refinement.md and refinement.csv into --out.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np

VARIANTS = {
    "full": [],
    "no_critic": ["loss.adversarial=0"],
    "network": ["model=mesh_generator"],
    "no_psnr": ["loss.alpha=0"],
    "no_ssim": ["loss.beta=0"],
    "no_nc": ["loss.gamma=0"],
    "no_consistency": ["loss.consistency=0"],
    # A peer without anything of ours: vertices and colours down the paper's Eq. 6 alone.
    "descent": ["loss.adversarial=0", "loss.consistency=0"],
}
PATHS = {"grid": [], "circular": ["overlap=84", "data.synthetic.frames=24"]}  # 16 to 24 photographs
COLUMNS = {
    "psnr_db": ("PSNR, dB", "{:+.2f}"),
    "ssim": ("SSIM", "{:+.3f}"),
    "nc": ("NC", "{:+.4f}"),
    "chamfer_m": ("Chamfer", "{:+.1%}"),
    "fscore_0.5m": ("F-score at 0.5 m", "{:+.3f}"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("outputs/refinements"))
    parser.add_argument("--scenes", nargs="+", default=["blocks", "village", "campus"])
    parser.add_argument("--paths", nargs="+", default=list(PATHS), choices=list(PATHS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), choices=list(VARIANTS))
    parser.add_argument("more", nargs="*", help="overrides of every run, such as stage.epochs=6")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    for seed in asked.seeds:
        for scene in asked.scenes:
            for path in asked.paths:
                for variant in asked.variants:
                    refine(asked.out, scene, path, seed, variant, asked.more)
                    write(asked.out)


def refine(out: Path, scene: str, path: str, seed: int, variant: str, more: Iterable[str]) -> None:
    """One cell, unless it is there already; all variants of a flight share its photographs and rough mesh."""
    folder = out / f"{scene}-{path}-{seed}-{variant}"  # for other overrides give another --out
    if (folder / "seconds.txt").is_file():
        return
    print(folder.name, flush=True)
    command = [
        sys.executable, "train.py", "experiment=ssgan3d_small", f"flight_path={path}", f"data.synthetic.scene={scene}",
        f"data.synthetic.seed={100 + seed}", f"seed={seed}", f"data.work={out / f'{scene}-{path}-{seed}-rough'}",
        f"hydra.run.dir={folder}", "trainer.enable_progress_bar=false", *PATHS[path],
        *VARIANTS[variant], *more,
    ]  # fmt: skip
    start = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    (folder / "seconds.txt").write_text(f"{time.perf_counter() - start:.1f}\n")


def write(out: Path) -> None:
    """The table of all finished cells: changes from the start, means with 95 % intervals over flights."""
    rows = []
    for done in sorted(out.glob("*/seconds.txt")):
        scene, path, seed, variant = done.parent.name.split("-")
        values = json.loads((done.parent / "metrics.json").read_text())["metrics"]
        row: dict[str, object] = {"scene": scene, "path": path, "seed": int(seed), "variant": variant}
        for name in COLUMNS:
            row |= {f"start/{name}": values[f"start/{name}"], name: values[f"val/{name}"]}
        rows.append({**row, "seconds": float(done.read_text())})
    with (out / "refinement.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    titles = [title for title, _ in COLUMNS.values()]
    lines = [f"| variant | flights | {' | '.join(titles)} | seconds |", "| --- " * (len(titles) + 3) + "|"]
    for variant in VARIANTS:
        own = [row for row in rows if row["variant"] == variant]
        if own:
            cells = [interval(own, name) for name in COLUMNS]
            seconds = float(np.mean([float(str(row["seconds"])) for row in own]))
            lines.append(f"| {variant} | {len(own)} | {' | '.join(cells)} | {seconds:.0f} |")
    (out / "refinement.md").write_text("\n".join(lines) + "\n")


def interval(rows: list[dict[str, object]], name: str) -> str:
    """Mean change and its bootstrap interval."""
    before, after = (np.array([float(str(row[key])) for row in rows]) for key in (f"start/{name}", name))
    change = after / before - 1 if name == "chamfer_m" else after - before
    draws = change[np.random.default_rng(0).integers(len(change), size=(2000, len(change)))].mean(1)
    form = COLUMNS[name][1]
    low, high = np.quantile(draws, [0.025, 0.975])
    return f"{form.format(change.mean())} ({form.format(low)} to {form.format(high)})"


if __name__ == "__main__":
    main()
