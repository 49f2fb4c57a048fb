"""Photographs and cameras to depth, Gaussians, splat files and views, without PyTorch.

The names below load their module when first used, so that importing the package costs nothing.
"""

import warnings
from importlib import import_module
from typing import TYPE_CHECKING

from . import startup as startup

if TYPE_CHECKING:
    from .cameras.camera import Camera
    from .cameras.io import read_cameras
    from .errors import InputError
    from .inference.bundled_model import bundled_model
    from .inference.metadata import ModelMetadata
    from .inference.predictor import Prediction, Predictor
    from .rendering.rasterizer import rasterize
    from .rendering.render import render
    from .splats.formats.ply import read_ply, write_ply
    from .splats.gaussians import Gaussians
    from .splats.io import read_offset, read_splats, write_splats

_MODULE_OF = {
    "Camera": "cameras.camera",
    "Gaussians": "splats.gaussians",
    "InputError": "errors",
    "ModelMetadata": "inference.metadata",
    "Prediction": "inference.predictor",
    "Predictor": "inference.predictor",
    "bundled_model": "inference.bundled_model",
    "rasterize": "rendering.rasterizer",
    "read_cameras": "cameras.io",
    "read_offset": "splats.io",
    "read_ply": "splats.formats.ply",
    "read_splats": "splats.io",
    "render": "rendering.render",
    "write_ply": "splats.formats.ply",
    "write_splats": "splats.io",
}

__all__ = [
    "Camera",
    "Gaussians",
    "InputError",
    "ModelMetadata",
    "Prediction",
    "Predictor",
    "bundled_model",
    "rasterize",
    "read_cameras",
    "read_offset",
    "read_ply",
    "read_splats",
    "render",
    "write_ply",
    "write_splats",
]


def __getattr__(name: str) -> object:
    """Load a public name from its module, once."""
    if name == "Runner":
        warnings.warn("Runner is now called Predictor", DeprecationWarning, stacklevel=2)
        name = "Predictor"
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f".{_MODULE_OF[name]}", __name__), name)
    globals()[name] = value
    return value
