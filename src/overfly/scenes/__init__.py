"""Scenes: landscapes whose geometry is known, procedural or from a file, and the renderer that photographs them.

Nothing heavy is imported before a name is used: ``STYLES`` costs nothing, ``Renderer`` imports the kernels.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from overfly.scenes.appearance import Appearance
    from overfly.scenes.renderer import Rendered, Renderer
    from overfly.scenes.scene import STYLES, Scene, load_scene, make_scene, open_scene

__all__ = [
    "STYLES",
    "Appearance",
    "Rendered",
    "Renderer",
    "Scene",
    "load_scene",
    "make_scene",
    "open_scene",
]

_HOME = {"Appearance": "appearance", "Rendered": "renderer", "Renderer": "renderer"}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME.get(name, 'scene')}"), name)
