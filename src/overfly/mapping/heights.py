"""What the heights of a map refer to: the ellipsoid, a vertical CRS, or ground control."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from overfly.errors import InputError
from overfly.flights import Flight
from overfly.geodesy import crs_from_enu, vertical_crs
from overfly.mapping.block import Block
from overfly.mapping.control import FEWEST


def check_place(flight: Flight, asked: str | None, *, estimate: bool, control: str) -> None:
    """Refuse heights that a flight cannot have, before its cameras are estimated.

    Args:
        flight: as it was read.
        asked: as in :func:`with_heights`.
        estimate: whether its cameras are estimated, not given.
        control: what its ground control does, see :func:`overfly.mapping.align.align`.

    Raises:
        InputError: nothing tells its place on the Earth.
    """
    if asked is None or (not estimate and (flight.cameras_from is None or flight.origin is not None)):
        return
    if not estimate and control != "none" and len(flight.gcps) >= FEWEST:
        return
    if not estimate:
        raise InputError(
            f"--heights {asked} needs a place on the Earth, which the cameras of {flight.cameras_from} do not tell: "
            "give ground control, or the origin in transforms.json (key overfly.origin), map with --cameras estimate, "
            "or leave it out."
        )
    if sum(frame.gps is not None for frame in flight.frames) < 2 and (not flight.gcps or control == "none"):
        raise InputError(
            f"--heights {asked} needs a place on the Earth, which this flight does not tell: give GPS in the images, a "
            "geo.txt or ground control, or leave it out."
        )


def with_heights(block: Block, asked: str | None) -> Block:
    """The block, its products in the vertical CRS asked for; where none is asked for, in that of its origin.

    Args:
        block: with cameras in metres on the Earth, if heights are asked for.
        asked: see :func:`overfly.geodesy.vertical_crs`.

    Raises:
        InputError: the place on the Earth, or what the controls' heights refer to, is not known.
    """
    if asked is None:
        return block
    if block.origin is None or not block.metric:
        raise InputError(
            f"--heights {asked} needs a place on the Earth, which could not be found: see the warnings about GPS and "
            "ground control of a map without it."
        )
    if _held_by_controls(block) and block.origin.vertical_epsg is None:
        raise InputError(
            f"--heights {asked} cannot be reached from the heights of gcp_list.txt, which do not say what they refer "
            f"to: write EPSG:{block.origin.crs_epsg}+5773, or the right vertical CRS, into its first line."
        )
    return replace(block, origin=replace(block.origin, vertical_epsg=vertical_crs(asked)))


def check_heights(block: Block) -> None:
    """Refuse heights of products that cannot be told, before the long steps.

    Raises:
        InputError: the grid of the vertical CRS is missing, or does not reach this place.
    """
    if block.origin is not None and block.metric:
        crs_from_enu(np.zeros((1, 3)), block.origin)


def heights_of(block: Block) -> str | None:
    """What the products' heights refer to: ``EPSG:5773``, ``ellipsoidal``, ``controls`` (as they have them); or None.

    Heights of GPS are taken as over the ellipsoid, which not every receiver writes.
    """
    if block.origin is None or not block.metric:
        return None
    if block.origin.vertical_epsg is not None:
        return f"EPSG:{block.origin.vertical_epsg}"
    return "controls" if _held_by_controls(block) else "ellipsoidal"


def heights_text(heights: str | None) -> str:
    """What heights refer to, in words; see :func:`heights_of`."""
    kinds = {"ellipsoidal": "ellipsoidal heights", "controls": "heights as the ground control has them"}
    return "" if heights is None else kinds.get(heights, f"heights in {heights}")


def _held_by_controls(block: Block) -> bool:
    return block.survey is not None and block.survey.sigma_m is not None
