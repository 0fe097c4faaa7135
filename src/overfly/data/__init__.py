"""Windows and flights as training data: synthetic flights, the user's own, and the one DataModule for both.

Nothing heavy is imported before a name is used: mapping needs the window geometry alone.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from overfly.data.folder import FolderFlights
    from overfly.data.module import FlightDataModule
    from overfly.data.synthetic import SyntheticFlights

__all__ = ["FlightDataModule", "FolderFlights", "SyntheticFlights"]

_HOME = {"FlightDataModule": "module", "FolderFlights": "folder", "SyntheticFlights": "synthetic"}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
