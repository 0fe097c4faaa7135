"""Flights: plans whose overlap is measured, flight folders, and the readers of foreign camera formats.

Heavy modules are imported when a name is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from overfly.flights.calibration import read_calibration, with_calibration
    from overfly.flights.cameras import CAMERAS, CameraPreset, camera_preset, find_preset
    from overfly.flights.colmap import read_colmap
    from overfly.flights.flight import ControlPoint, Flight, Frame, Gps
    from overfly.flights.folder import read_flight
    from overfly.flights.launch import fly
    from overfly.flights.noise import NOISE, PoseNoise, noise_model
    from overfly.flights.plan import PATHS, Plan, plan_flight
    from overfly.flights.transforms import write_transforms
    from overfly.flights.write import write_flight

_HOME = {
    "read_calibration": "calibration",
    "with_calibration": "calibration",
    "CAMERAS": "cameras",
    "CameraPreset": "cameras",
    "camera_preset": "cameras",
    "find_preset": "cameras",
    "read_colmap": "colmap",
    "ControlPoint": "flight",
    "Flight": "flight",
    "Frame": "flight",
    "Gps": "flight",
    "read_flight": "folder",
    "NOISE": "noise",
    "PoseNoise": "noise",
    "noise_model": "noise",
    "PATHS": "plan",
    "Plan": "plan",
    "plan_flight": "plan",
    "write_transforms": "transforms",
    "write_flight": "write",
    "fly": "launch",
}

__all__ = [
    "CAMERAS",
    "NOISE",
    "PATHS",
    "CameraPreset",
    "ControlPoint",
    "Flight",
    "Frame",
    "Gps",
    "Plan",
    "PoseNoise",
    "camera_preset",
    "find_preset",
    "fly",
    "noise_model",
    "plan_flight",
    "read_calibration",
    "read_colmap",
    "read_flight",
    "with_calibration",
    "write_flight",
    "write_transforms",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
