"""Photographs and cameras to depth, Gaussians, splat files and views, without PyTorch.

The names below load their module when first used, so that importing the package costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .rasterizer import rasterize

_MODULE_OF = {
    "rasterize": "rasterizer",
}

__all__ = ["rasterize"]


def __getattr__(name: str) -> object:
    """Load a public name from its module, once."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f".{_MODULE_OF[name]}", __name__), name)
    globals()[name] = value
    return value
