"""Overfly: the aerial images of one drone flight become a measured 3D map."""

__version__ = "0.1.0"
