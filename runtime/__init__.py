"""Photographs and cameras to depth, Gaussians, splat files and views, without PyTorch.

The names below load their module when first used, so that importing the package costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from . import startup as startup

if TYPE_CHECKING:
    from .cameras import Camera, read_cameras
    from .errors import InputError
    from .formats import read_offset, read_scene, write_scene
    from .gaussians import Gaussians
    from .ply import read_ply, write_ply
    from .rasterizer import rasterize
    from .runner import Prediction, Runner

_MODULE_OF = {
    "Camera": "cameras",
    "Gaussians": "gaussians",
    "InputError": "errors",
    "Prediction": "runner",
    "Runner": "runner",
    "rasterize": "rasterizer",
    "read_cameras": "cameras",
    "read_offset": "formats",
    "read_ply": "ply",
    "read_scene": "formats",
    "write_ply": "ply",
    "write_scene": "formats",
}

__all__ = [
    "Camera",
    "Gaussians",
    "InputError",
    "Prediction",
    "Runner",
    "rasterize",
    "read_cameras",
    "read_offset",
    "read_ply",
    "read_scene",
    "write_ply",
    "write_scene",
]


def __getattr__(name: str) -> object:
    """Load a public name from its module, once."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f".{_MODULE_OF[name]}", __name__), name)
    globals()[name] = value
    return value
