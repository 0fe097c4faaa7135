"""How accurate a flight can be: the formulas that check and plan share."""

from __future__ import annotations

import math

from overfly.mapping.needs import SIZE

SIGMA_PX = 0.3
"""How well a point of good texture is matched, pixels (one sigma)."""

SIGMA_OF = f"points matched to {SIGMA_PX} px in images of at most {SIZE} px (overfly map --size)"
"""What the expected sigma supposes."""


def sigma_z_m(gsd_m: float, base_to_height: float, sigma_px: float = SIGMA_PX) -> float:
    """Standard deviation of a height from one pair of images, metres.

    The normal case of photogrammetry, sigma_z = (Z / B) * (Z / c) * sigma_px with distance Z, base B and focal length
    c in pixels, so Z / c is the ground sampling distance (Kraus, Photogrammetry, vol. 1, accuracy of the normal case).

    Args:
        gsd_m: metres per pixel on the ground.
        base_to_height: B / Z.
        sigma_px: of the matching.

    It is the inner precision of points that match well: neither plants in the wind nor the error of GPS are in it.
    """
    return gsd_m / base_to_height * sigma_px if base_to_height > 0 else math.inf


def sigma_xy_m(gsd_m: float, sigma_px: float = SIGMA_PX) -> float:
    """Standard deviation in plan under the camera, metres: Z / c * sigma_px (same source as :func:`sigma_z_m`)."""
    return gsd_m * sigma_px
