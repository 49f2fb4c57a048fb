"""Photographs and cameras to depth, Gaussians, splat files and views, without PyTorch.

The names below load their module when first used, so that importing the package costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from . import startup as startup

if TYPE_CHECKING:
    from .cameras.camera import Camera
    from .cameras.io import read_cameras
    from .errors import InputError
    from .inference.predictor import Prediction, Runner
    from .rendering.rasterizer import rasterize
    from .splats.formats.ply import read_ply, write_ply
    from .splats.gaussians import Gaussians
    from .splats.io import read_offset, read_scene, write_scene

_MODULE_OF = {
    "Camera": "cameras.camera",
    "Gaussians": "splats.gaussians",
    "InputError": "errors",
    "Prediction": "inference.predictor",
    "Runner": "inference.predictor",
    "rasterize": "rendering.rasterizer",
    "read_cameras": "cameras.io",
    "read_offset": "splats.io",
    "read_ply": "splats.formats.ply",
    "read_scene": "splats.io",
    "write_ply": "splats.formats.ply",
    "write_scene": "splats.io",
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
