"""Small flights on disk."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from small_flight import CAMERA, ORIGIN, some_poses, textured

from overfly.flights.flight import Frame
from overfly.flights.write import write_flight
from overfly.geodesy import Origin
from overfly.geometry import Camera


@pytest.fixture
def make_flight(tmp_path: Path) -> Callable[..., tuple[Path, list[Frame]]]:
    """Writes a synthetic flight of ``n`` frames and gives its folder and frames."""

    def make(n: int = 4, camera: Camera = CAMERA, origin: Origin | None = ORIGIN, **more) -> tuple[Path, list[Frame]]:
        root = tmp_path / "flight"
        images = [textured(i, camera.height, camera.width) for i in range(n)]
        frames = write_flight(root, images, [camera] * n, some_poses(n), origin=origin, **more)
        return root, frames

    return make
