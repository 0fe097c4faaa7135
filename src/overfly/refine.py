"""``overfly refine``: stage=ssgan3d on a user's flight, in one folder that can be gone on with."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

from overfly.errors import InputError, unknown
from overfly.mapping.steps import fingerprint
from overfly.run_folder import quoted

GENERATORS = {"vertices": "free_vertices", "network": "mesh_generator"}


def refine(
    flight: Path,
    *,
    out: Path,
    mesh: Path | None = None,
    generator: str = "vertices",
    width: int = 1024,
    faces: int = 200_000,
    hold_out: int = 6,
    adversarial: float | None = None,
    cameras: str = "auto",
    overwrite: bool = False,
    more: Sequence[str] = (),
) -> int:
    """Refine the mesh of a flight; returns the exit code.

    The same command in the same folder goes on where it was stopped.

    Args:
        flight: a flight folder or a folder of photographs.
        out: the run folder; gets start.ply, refined.ply, pictures and metrics.json.
        mesh: rough mesh in the frame of the cameras; None: stereo makes one.
        generator: "vertices" or "network".
        width: of the photographs, pixels.
        faces: of the refined mesh, about.
        hold_out: every so manieth photograph is only measured on.
        adversarial: the paper's lambda; None: as configured.
        cameras: auto, given or estimate.
        overwrite: replace another refinement in ``out``.
        more: further overrides of the configuration.

    Raises:
        InputError: a value is impossible, or ``out`` holds another refinement.
    """
    from overfly.run import main

    if generator not in GENERATORS:
        raise unknown("--generator", generator, sorted(GENERATORS))
    if not flight.is_dir():
        raise InputError(f"There is no folder {flight}: give a flight folder or a folder of photographs.")
    if faces < 1000:
        raise InputError(f"--faces {faces} is too few to show a landscape: give 1000 or more.")
    rough = min(faces, 20_000)
    steps = [(rough, 2), (max(rough, faces // 3), 1), (faces, 1)]
    levels = ",".join(f"{{faces:{count},shrink:{shrink}}}" for count, shrink in steps)
    asked = [
        "stage=ssgan3d",
        f"model={GENERATORS[generator]}",
        f"data.flight={quoted(flight.resolve())}",
        f"data.mesh={'null' if mesh is None else quoted(mesh.resolve())}",
        f"data.faces={rough}",
        f"data.width={width}",
        f"data.hold_out={hold_out}",
        f"data.cameras={cameras}",
        f"stage.levels=[{levels}]",
        *([] if adversarial is None else [f"loss.adversarial={adversarial}"]),
        *more,
    ]
    seen = _inputs(flight, mesh, out)
    recorded = out / "overrides.txt"
    if recorded.is_file():
        before = [line for line in recorded.read_text().splitlines() if line and not line.startswith(_OWN)]
        if "stage=ssgan3d" not in before:
            raise InputError(f"{out} is a run of another stage: give a new folder as --out.")
        same = before == asked and (out / INPUTS).is_file() and json.loads((out / INPUTS).read_text()) == seen
        if same and not overwrite:
            return main([f"resume={out}"])
        if overwrite:
            for given in (flight, mesh):
                if given is not None and given.resolve().is_relative_to(out.resolve()):
                    raise InputError(f"{given} lies in {out}, which --overwrite would delete: give another --out.")
            shutil.rmtree(out)
        elif (out / "checkpoints" / "last.ckpt").is_file():
            raise InputError(
                f"{out} holds another refinement (other photographs or settings): give another --out, or --overwrite."
            )
    elif out.is_dir() and any(path.name != INPUTS for path in out.iterdir()):
        raise InputError(f"{out} is not empty and holds no refinement: give a new folder as --out.")
    out.mkdir(parents=True, exist_ok=True)
    (out / INPUTS).write_text(json.dumps(seen))
    return main([*asked, f"hydra.run.dir={quoted(out)}"])


INPUTS = "inputs.json"
"""What the photographs and the mesh were, so that others under the same names are not taken for them."""


def _inputs(flight: Path, mesh: Path | None, out: Path) -> list[list[str | int]]:
    """Name, size and time of every file of the flight, and of the mesh."""
    files = [path for path in flight.rglob("*") if path.is_file() and not path.resolve().is_relative_to(out.resolve())]
    files += [mesh] if mesh is not None and mesh.is_file() else []
    return [list(facts) for facts in fingerprint(files)]


_OWN = ("hydra.run.dir=", "resume=")
