"""What ground control and error propagation say about a block: the surveyor's numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from overfly.geometry import Array

CONTROL = ("split", "all", "none")
"""What ground control points may do."""


@dataclass(frozen=True)
class SurveyedPoint:
    """A ground control point after the adjustment.

    Attributes:
        name: as in the file.
        role: "control" held the block, "check" was kept out of every fit, "unused" could not serve.
        place: surveyed position in the block's frame, metres.
        residual: triangulated minus surveyed, east, north, up in metres; None where it could not be triangulated.
        pixels: mean distance of the triangulated point from where it was clicked; None likewise.
        images: number of images it was triangulated from.
    """

    name: str
    role: str
    place: tuple[float, float, float]
    residual: tuple[float, float, float] | None = None
    pixels: float | None = None
    images: int = 0


@dataclass(frozen=True)
class Survey:
    """All ground control points of a block.

    Attributes:
        points: in the order of the file.
        sigma_m: standard deviation that the controls were given, horizontal and vertical, metres, by their own
            spread; None where none was used.
        gps_shift_m: GPS minus controls, east, north, up in metres; None without GPS.
    """

    points: tuple[SurveyedPoint, ...]
    sigma_m: tuple[float, float] | None = None
    gps_shift_m: tuple[float, float, float] | None = None

    def rms(self, role: str) -> dict[str, float] | None:
        """RMS residuals x, y, z (metres) and pixels of the points of a role; None without any."""
        chosen = [p for p in self.points if p.role == role and p.residual is not None]
        if not chosen:
            return None
        residuals = np.array([p.residual for p in chosen], float)
        away = np.sqrt((residuals**2).mean(0))
        pixels = float(np.sqrt(np.mean([p.pixels**2 for p in chosen if p.pixels is not None])))
        return {
            "points": len(chosen),
            **{f"{axis}_m": round(float(v), 4) for axis, v in zip("xyz", away, strict=True)},
            "pixels": round(pixels, 3),
        }

    def summary(self) -> dict[str, Any]:
        """For map.json."""
        return {
            "controls": self.rms("control"),
            "checks": self.rms("check"),
            "sigma_m": self.sigma_m,
            "gps_shift_m": self.gps_shift_m,
            "points": [asdict(point) for point in self.points],
        }


def survey_from(content: dict[str, Any] | None) -> Survey | None:
    """What :func:`dataclasses.asdict` wrote to JSON."""
    if content is None:
        return None

    def three(values: Sequence[float] | None) -> Any:
        return None if values is None else tuple(values)

    points = [
        SurveyedPoint(**{**p, "place": three(p["place"]), "residual": three(p["residual"])}) for p in content["points"]
    ]
    return Survey(tuple(points), three(content["sigma_m"]), three(content["gps_shift_m"]))


@dataclass(frozen=True, eq=False)
class Precision:
    """Standard deviations of the cameras from the adjustment, scaled by its variance of unit weight.

    Attributes:
        position_m: [n, 3] east, north, up, metres; None where the estimate fails.
        rotation_deg: [n, 3] about the cameras' axes, degrees; None likewise.
        focal: of the focal length, as a share; the largest of all cameras.
        why_not: the reason where there is no estimate.
    """

    position_m: Array | None = None
    rotation_deg: Array | None = None
    focal: float | None = None
    why_not: str | None = None

    def to_json(self) -> dict[str, Any]:
        """For block.json."""
        listed = {n: None if (v := getattr(self, n)) is None else v.tolist() for n in ("position_m", "rotation_deg")}
        return {**listed, "focal": self.focal, "why_not": self.why_not}

    def summary(self) -> dict[str, Any]:
        """For map.json: median and worst over the cameras."""
        if self.position_m is None or self.rotation_deg is None:
            return {"why_not": self.why_not}
        flat, up = np.linalg.norm(self.position_m[:, :2], axis=1), self.position_m[:, 2]
        turn = self.rotation_deg.max(1)
        return {
            name: {"median": round(float(np.median(v)), 4), "worst": round(float(v.max()), 4)}
            for name, v in (("horizontal_m", flat), ("vertical_m", up), ("rotation_deg", turn))
        } | {"focal_share": None if self.focal is None else round(self.focal, 5)}


def precision_from(content: dict[str, Any] | None) -> Precision | None:
    """What :meth:`Precision.to_json` made."""
    if content is None:
        return None
    position, rotation = (None if content[n] is None else np.array(content[n]) for n in ("position_m", "rotation_deg"))
    return Precision(position, rotation, content["focal"], content["why_not"])
