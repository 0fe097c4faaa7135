"""Camera presets against the makers' fields of view and ground distances (research table of presets)."""

from __future__ import annotations

import numpy as np
import pytest

from overfly.errors import InputError
from overfly.flights.cameras import CAMERAS, camera_preset, find_preset, focal35_mm


@pytest.mark.parametrize(
    ("name", "fov", "gsd_cm", "footprint"),
    [
        ("phantom4", (81, 65), 6.4, (256, 192)),
        ("p4p", (74, 53), 4.1, (225, 150)),
        ("mavic2pro", (66, 46), 3.5, (193, 129)),
        ("mavic3e", (70, 56), 4.0, (211, 159)),
        ("p1", (54, 38), 1.9, (154, 103)),
    ],
)
def test_full_size_matches_the_published_figures(name, fov, gsd_cm, footprint):
    camera = camera_preset(name)
    assert np.allclose(camera.fov_deg, fov, atol=0.8)
    assert 100 * 150 / camera.fx == pytest.approx(gsd_cm, abs=0.06)
    assert (150 / camera.fx * camera.width, 150 / camera.fy * camera.height) == pytest.approx(footprint, abs=1.0)


def test_width_alone_keeps_the_aspect_and_the_field_of_view():
    camera = camera_preset("p4p", 800)
    assert (camera.width, camera.height) == (800, 533)
    assert camera.fx == camera.fy == pytest.approx(8.8 / 13.2 * 800)
    assert (camera.cx, camera.cy) == (400, 266.5)


def test_another_aspect_is_cut_from_the_middle():
    cut = camera_preset("p4p", 256, 192)
    assert cut.fov_deg[1] == pytest.approx(camera_preset("p4p").fov_deg[1])
    assert cut.fov_deg[0] < camera_preset("p4p").fov_deg[0]
    wide = camera_preset("phantom3", 1600, 900)
    assert wide.fov_deg[0] == pytest.approx(camera_preset("phantom3").fov_deg[0])


def test_names_models_and_35_mm():
    assert find_preset("FC6310") is CAMERAS["p4p"]
    assert round(focal35_mm(camera_preset("p4p", 800))) == 24
    assert round(focal35_mm(camera_preset("phantom4"))) == 20
    with pytest.raises(InputError, match=r"'p4' is unknown.*p4p"):
        camera_preset("p4")


@pytest.mark.parametrize("size", [0, -5, 1.5, True, 10**7])
def test_absurd_sizes_are_refused(size):
    with pytest.raises(InputError, match="whole pixels"):
        camera_preset("p4p", size)
