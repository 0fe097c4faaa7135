"""What a map is asked for, checked before anything is read or written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from overfly.errors import InputError, unknown
from overfly.geodesy import vertical_crs
from overfly.mapping.matches import MATCHERS
from overfly.mapping.needs import SIZE, mesh_gb
from overfly.mapping.survey import CONTROL
from overfly.mapping.sweep import TrainedRun

CAMERAS = ("auto", "given", "estimate")
DENSE = ("sweep", "stereo")

MESH_FACES = 200_000
"""Default of the triangles of the textured mesh."""

FACES = (100, 1_000_000)
"""Fewest and most of them: less shows no landscape, more fits into few viewers."""


@dataclass(frozen=True, kw_only=True)
class MapSettings:
    """What a map is asked for.

    Attributes:
        cameras: "given" takes those of the flight folder, "estimate" ignores them, "auto" takes them if there are any.
        calibration: file or folder with the calibrated camera (:func:`overfly.flights.read_calibration`) that an
            estimation keeps; None: the camera is calibrated by the flight itself.
        matcher: what finds the key points from which cameras are estimated: "sift", the network's "encoder", "both", or
            "auto": SIFT, and both where its matches are too few to place the images.
        control: what ground control points do: "split" keeps a quarter of four or more to check the map, "all" lets all
            hold it, "none" leaves them aside.
        dense: "sweep" by a trained network, "stereo" by semi-global matching of rectified pairs.
        network: the trained run (``overfly.run.load_run``) or what loads it; needed by "sweep" and by the matchers
            "encoder" and "both"; without it "auto" has SIFT alone.
        network_name: what the user called it.
        max_memory_gb: memory that the dense step and the products may take; None: half of what is free, at most 6.
        resume: reuse finished steps of an earlier map of the same images with the same settings.
        overwrite: replace another flight's map in the same folder.
        heights: vertical CRS of the products by name or code (:func:`overfly.geodesy.vertical_crs`); None: that of
            gcp_list.txt if it holds the map, or of the origin that comes with given cameras, else heights above the
            ellipsoid.
        ply: write ``cloud.ply`` too.
        mesh: write the textured mesh ``mesh.glb`` too; one that an earlier map left is removed.
        mesh_faces: about so many triangles; None: :data:`MESH_FACES`. Only with ``mesh``.
        size: longest side at which images are worked on, pixels: 800 for 1600 takes two fifths of the dense time.
        seed: of every random choice.
        progress: tell each step on stderr.
    """

    cameras: str = "auto"
    calibration: str | None = None
    matcher: str = "auto"
    control: str = "split"
    dense: str = "sweep"
    network: TrainedRun | Callable[[], TrainedRun] | None = None
    network_name: str | None = None
    max_memory_gb: float | None = None
    resume: bool = True
    overwrite: bool = False
    heights: str | None = None
    ply: bool = False
    mesh: bool = False
    mesh_faces: int | None = None
    size: int = SIZE
    seed: int = 0
    progress: bool = True

    def __post_init__(self) -> None:
        if self.cameras not in CAMERAS:
            raise unknown("--cameras", self.cameras, CAMERAS)
        if self.calibration is not None and self.cameras == "given":
            raise InputError(
                "--calibration serves to estimate cameras, and --cameras given takes those of the flight folder: "
                "leave one of them out."
            )
        if self.matcher not in MATCHERS:
            raise unknown("--matcher", self.matcher, MATCHERS)
        if self.control not in CONTROL:
            raise unknown("--control", self.control, CONTROL)
        if self.dense not in DENSE:
            raise unknown("--dense", self.dense, DENSE)
        if self.dense == "sweep" and self.network is None:
            raise InputError(
                "The dense step sweep needs a trained network: give --network RUN (a run folder of train.py), "
                "or map without one by --dense stereo."
            )
        if self.matcher in ("encoder", "both") and self.network is None:
            raise InputError(
                f"The matcher {self.matcher} needs a trained network: give --network RUN (a run folder of train.py), "
                "or match without one by --matcher sift."
            )
        if self.size < 64:
            raise InputError(
                f"--size {self.size} is too small to match images: give 64 pixels or more, such as {SIZE}."
            )
        if self.heights is not None:
            vertical_crs(self.heights)
        if self.mesh_faces is not None:
            if not self.mesh:
                raise InputError(f"--mesh-faces {self.mesh_faces} asks for no mesh: add --mesh, or leave it out.")
            if not FACES[0] <= self.mesh_faces <= FACES[1]:
                raise InputError(
                    f"--mesh-faces {self.mesh_faces} is not possible: give {FACES[0]} to {FACES[1]} triangles, "
                    f"such as {MESH_FACES}."
                )
        if self.max_memory_gb is not None and not self.max_memory_gb > 0:
            raise InputError(f"--max-memory {self.max_memory_gb} is not possible: give gigabytes above 0, such as 4.")
        needed = mesh_gb(self.mesh_faces or MESH_FACES)
        if self.mesh and self.max_memory_gb is not None and needed > self.max_memory_gb:
            raise InputError(
                f"A mesh of {self.mesh_faces or MESH_FACES} triangles takes about {needed:.1f} GB, more than "
                f"--max-memory {self.max_memory_gb:g}: allow so much, or give fewer --mesh-faces."
            )

    @cached_property
    def run(self) -> TrainedRun | None:
        """The trained run, loaded when it is first asked for."""
        return self.network() if callable(self.network) else self.network

    def matcher_key(self) -> list[str]:
        """What cameras depend on besides the images: "auto" goes by the network's name, since it is seldom loaded."""
        if self.matcher == "sift" or self.network is None:
            return []
        name = self.network_name if self.matcher == "auto" else None
        return [self.matcher, name or self.network_key()]

    def network_key(self) -> str:
        """What a trained run's answer depends on: its weights."""
        from overfly.networks.blocks import weights_key

        assert self.run is not None
        return weights_key(self.run.network)

    def shown(self) -> dict[str, Any]:
        """For the report and map.json."""
        return {
            "cameras": self.cameras,
            "calibration": self.calibration,
            "dense": self.dense,
            "matcher": self.matcher,
            "control": self.control,
            "heights": self.heights,
            "network": self.network_name if self.dense == "sweep" or self.matcher in ("encoder", "both") else None,
            "max_memory_gb": self.max_memory_gb,
            "size": self.size,
            "seed": self.seed,
            "mesh_faces": (self.mesh_faces or MESH_FACES) if self.mesh else None,
        }
