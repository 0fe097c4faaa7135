"""Windows and flights as training data: synthetic flights, the user's own, and the one DataModule for both."""

from overfly.data.folder import FolderFlights
from overfly.data.module import FlightDataModule
from overfly.data.synthetic import SyntheticFlights

__all__ = ["FlightDataModule", "FolderFlights", "SyntheticFlights"]
