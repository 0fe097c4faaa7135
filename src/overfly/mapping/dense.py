"""The dense cloud of a block, by semi-global stereo alone or together with a trained network."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from overfly.flights import Flight
from overfly.mapping.block import Block
from overfly.mapping.needs import Budget, allowed_gb, budget
from overfly.mapping.settings import MapSettings
from overfly.mapping.steps import Steps
from overfly.mapping.tiles import Tiles, write_tiles

FEWEST_POINTS = 30
"""Sparse points that tell the height of the ground."""


def how_dense(asked: MapSettings) -> str:
    """By what a cloud is made, in words."""
    if asked.dense == "stereo":
        return "semi-global stereo"
    network = "the shipped network" if asked.network_name == "shipped" else f"the network {asked.network_name or ''}"
    return (f"stereo and {network}" if _measures(asked) else network).strip()


def _measures(asked: MapSettings) -> bool:
    """Whether the network tells surfaces that are measured together with pairs."""
    return asked.run is not None and getattr(asked.run.network, "predicts_surfaces", False)


def memory_budget(block: Block, asked: MapSettings) -> Budget:
    """How much is held at once, so that the map keeps to the memory that it may take."""
    sizes = [(camera.width, camera.height) for camera in block.cameras]
    may = allowed_gb() if asked.max_memory_gb is None else asked.max_memory_gb
    return budget(sizes, may, asked.size, network=asked.dense == "sweep")


def stereo_cloud(block: Block, scratch: Path, asked: MapSettings, steps: Steps) -> Tiles:
    """The dense cloud by semi-global matching, in the block's frame."""
    return _fused(block, scratch, asked, steps, None)


def sweep_cloud(block: Block, flight: Flight, scratch: Path, asked: MapSettings, steps: Steps) -> Tiles:
    """The dense cloud by the trained network, in the block's frame."""
    run = asked.run
    assert run is not None
    if _measures(asked):
        from overfly.mapping.sweep import SweepOpinions

        sparse = block.points is not None and len(block.points) >= FEWEST_POINTS
        ground = ground_height(block, flight, asked.seed) if block.metric and not sparse else None
        return _fused(
            block, scratch, asked, steps, partial(SweepOpinions, run, ground_height=ground, metric=block.metric)
        )
    from overfly.mapping.network import network_cloud, prior_pose

    told = block.gps_positions()
    priors = []
    for frame, pose in zip(block.frames, block.poses, strict=True):
        position = told.get(frame.name)
        if position is not None and np.isnan(position[2]):
            position = np.array([position[0], position[1], pose[2, 3]])
        priors.append(prior_pose(position, frame.gimbal, pose))
    ground = ground_height(block, flight, asked.seed)
    with steps.bar("dense", "windows") as update:
        cloud = network_cloud(block.frames, run, ground_height=ground, priors=priors, progress=update)
    return write_tiles(scratch / "tiles", [cloud])


def _fused(block: Block, scratch: Path, asked: MapSettings, steps: Steps, opinions: Any) -> Tiles:
    from overfly.mapping.fuse import fuse
    from overfly.mapping.stereo import stereo

    held = memory_budget(block, asked)
    with steps.bar("dense", "depth maps") as update:
        maps = stereo(
            block.frames,
            workdir=scratch,
            points=block.points,
            max_size=asked.size,
            seed=asked.seed,
            opinions=opinions,
            workers=held.workers,
            progress=update,
        )
    with steps.bar("dense", "fused") as update, steps.bar("dense", "tiles") as update_tiles:
        return fuse(
            maps,
            block.frames,
            workdir=scratch,
            walls=block.metric,
            tile_points=held.tile_points,
            held=held.held_maps,
            progress=update,
            progress_of_tiles=update_tiles,
        )


def ground_height(block: Block, flight: Flight, seed: int) -> float:
    """Prior height of the ground in the block's frame: sparse points, the altitude that the flight tells, or a look."""
    heights = block.poses[:, 2, 3]
    if block.points is not None and len(block.points) >= FEWEST_POINTS:
        return float(np.median(block.points[:, 2]))
    if isinstance(altitude := flight.facts.get("altitude"), int | float) and altitude > 0:
        return float(np.median(heights)) - float(altitude)
    if relative := [
        (z, f.relative_altitude) for z, f in zip(heights, block.frames, strict=True) if f.relative_altitude
    ]:
        return float(np.median([z - above for z, above in relative]))
    from overfly.mapping.coarse import coarse_points

    return float(np.median(coarse_points(block.frames, seed=seed)[:, 2]))
