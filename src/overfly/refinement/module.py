"""The DataModule of a refinement: photographs with their cameras, the rough mesh, and the truth where it is known."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader

from overfly.cloud import Cloud, read_cloud
from overfly.data.dataset import WindowSampler
from overfly.data.photographs import PhotographPairs, Photographs, held_out, photographs
from overfly.errors import InputError
from overfly.files import existing
from overfly.flights import Flight
from overfly.mapping.block import Block
from overfly.mapping.facts import ground_sampling
from overfly.mapping.map import align_flight, measure_flight
from overfly.mapping.needs import SIZE
from overfly.mapping.rough_mesh import rough_mesh
from overfly.mapping.steps import key_of
from overfly.mesh import Mesh, read_mesh
from overfly.refinement.colors import check_overlap, colors_from
from overfly.refinement.measure import ShapeMeasure
from overfly.rendering.topology import topology

log = logging.getLogger("overfly")

ROUGH_POINTS = 8_000_000
"""Points that a rough mesh is made from, at most: some for each of the parts that its cells are cut into."""

LEAST_WIDTH = 64
"""Of the photographs, pixels."""

MULTIPLE = 16
"""Width and height of the photographs are multiples of it: they are halved up to four times."""


class PhotographModule(L.LightningDataModule):
    """Photographs in pairs (:class:`overfly.data.photographs.PhotographPairs`) and the mesh to refine.

    Args:
        flight: a flight folder or a folder of photographs; None: a synthetic flight is made after ``synthetic``.
        synthetic: arguments of :func:`overfly.flights.fly`.
        mesh: a .ply, .obj or .glb in the frame of the flight's cameras; None: stereo makes a rough one.
        faces: about so many faces of a rough mesh that is made.
        dense: how the cloud of the rough mesh is made; see :class:`overfly.mapping.settings.MapSettings`.
        cameras: auto, given or estimate.
        reference: a true cloud in the frame of the cameras; None: the flight's own, if it has one.
        width: of the photographs, pixels; larger ones are reduced.
        hold_out: one photograph out of so many is only measured on, 0 for none.
        batch_size: photographs of a step.
        seed: of everything that is drawn.
        work: folder for the steps of aligning and stereo.
        cache_dir: where a synthetic flight is kept.

    Attributes:
        photographs, mesh, gsd: after ``setup``; the mesh is local, metres; gsd is metres per pixel of the photographs.
        shape: measures meshes against the truth, None where there is none.
    """

    photographs: Photographs
    mesh: Mesh
    gsd: float
    shape: ShapeMeasure | None

    def __init__(
        self,
        *,
        flight: str | None,
        synthetic: Mapping[str, Any],
        mesh: str | None,
        faces: int,
        dense: str,
        cameras: str,
        reference: str | None,
        width: int | None,
        hold_out: int,
        batch_size: int,
        seed: int,
        work: str,
        cache_dir: str,
    ) -> None:
        super().__init__()
        held_out(3, hold_out)  # refused now and not after minutes
        if width is not None and width < LEAST_WIDTH:
            raise InputError(f"width={width} shows no detail: give {LEAST_WIDTH} pixels or more, such as 512.")
        if reference is not None:
            existing(reference, "The reference cloud", (".ply", ".las", ".laz"))
        self.flight, self.synthetic, self.given, self.faces = flight, dict(synthetic), mesh, faces
        self.dense, self.cameras, self.reference = dense, cameras, reference
        self.width, self.hold_out, self.batch_size, self.seed = width, hold_out, batch_size, seed
        self.work, self.cache_dir = Path(work), Path(cache_dir)
        self.found: tuple[Flight, Block, Mesh] | None = None

    has_test = False
    test_splits: tuple[str, ...] = ()

    def prepare_data(self) -> None:
        """Fly and measure what is not there yet; finished steps are kept."""
        self.found = self._rough()

    def setup(self, stage: str) -> None:
        if hasattr(self, "mesh"):
            return
        flight, block, mesh = self.found or self._rough()
        origin = np.round(mesh.vertices.mean(0))
        self.photographs = photographs(
            block.frames, width=self.width, hold_out=self.hold_out, multiple=MULTIPLE, origin=origin
        )
        mesh = welded(mesh)
        local = Mesh(mesh.vertices - origin, with_area(mesh.faces), mesh.colors)
        check_overlap(local, self.photographs)
        if local.colors is None:
            log.info("The mesh has no colours: they are estimated from the photographs")
            sides = topology(local.faces, len(local.vertices))
            local = Mesh(local.vertices, local.faces, colors_from(local, sides, self.photographs))
        self.mesh = local
        self.gsd = ground_sampling(Cloud(mesh.vertices), self.photographs.cameras, block.poses)
        truth = self.reference or flight.reference
        if truth is not None and self.reference is None and (block.cameras_from == "estimated" or not block.metric):
            log.info("%s is not used: it is in the frame of given cameras, and these are estimated", truth)
            truth = None
        self.shape = None
        if truth is not None:
            cloud = read_cloud(truth)
            self.shape = ShapeMeasure(cloud.with_points(cloud.points - origin), local)
        held = int(self.photographs.held_out.sum())
        log.info(
            "%d photographs of %d x %d pixels, %d held out; the mesh has %d faces; %.3g m per pixel",
            len(self.photographs), *self.photographs.size, held, len(local.faces), self.gsd,
        )  # fmt: skip

    def train_dataloader(self) -> DataLoader:
        return self._loader(~self.photographs.held_out, shuffle=True)

    def val_dataloader(self) -> DataLoader:
        """The photographs that are held out; all of them if none is."""
        held = self.photographs.held_out
        return self._loader(held if held.any() else ~held, shuffle=False)

    def _loader(self, chosen: np.ndarray, *, shuffle: bool) -> DataLoader:
        pairs = PhotographPairs(self.photographs, chosen, seed=self.seed)
        sampler = WindowSampler(len(pairs), seed=self.seed, shuffle=shuffle)
        size = min(self.batch_size, len(pairs)) if shuffle else 1
        return DataLoader(pairs, batch_size=size, sampler=sampler, pin_memory=torch.cuda.is_available())

    def _rough(self) -> tuple[Flight, Block, Mesh]:
        folder = self._flight_folder()
        settings: dict[str, Any] = {"out": self.work, "cameras": self.cameras, "seed": self.seed, "dense": self.dense}
        if self.width is not None:  # finer stereo than the photographs are compared at is in vain
            settings["size"] = min(max(self.width, 64), SIZE)
        if self.given is not None:
            mesh = read_mesh(self.given)  # first: aligning may take minutes
            return *align_flight(folder, **settings), mesh
        if self.dense == "sweep":
            raise InputError("dense=sweep needs a trained network: map the flight first, or use data.dense=stereo.")
        flight, block, cloud = measure_flight(folder, **settings)
        return flight, block, rough_mesh(cloud.sample(ROUGH_POINTS), faces=self.faces)

    def _flight_folder(self) -> Path:
        if self.flight is not None:
            return Path(self.flight)
        from overfly.flights import fly

        folder = self.cache_dir / "photographs" / key_of(self.synthetic)
        fly(**self.synthetic, out=folder)
        return folder


def welded(mesh: Mesh) -> Mesh:
    """The mesh with vertices at the same place made one, or it would tear where a file keeps them apart."""
    vertices, first, place = np.unique(mesh.vertices, axis=0, return_index=True, return_inverse=True)
    if len(vertices) == len(mesh.vertices):
        return mesh
    log.info("%d vertices at the place of another are joined", len(mesh.vertices) - len(vertices))
    faces = place.reshape(-1)[mesh.faces].astype(np.int32)
    return Mesh(vertices, faces, None if mesh.colors is None else mesh.colors[first])


def with_area(faces: NDArray[np.int32]) -> NDArray[np.int32]:
    """Faces [F, 3] without those that name a vertex twice: they show nothing and cannot be subdivided."""
    return faces[(faces != np.roll(faces, 1, axis=1)).all(1)]
