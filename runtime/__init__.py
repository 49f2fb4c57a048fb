"""Images and cameras to depth, Gaussians, splat files and rendered views, without PyTorch.

The public names are those of `idesplat`.
"""

import warnings
from importlib import import_module

from . import startup as startup

# These were public names of this package.
_MOVED = {
    **{name: name for name in ("Camera", "Gaussians", "InputError", "Prediction", "rasterize", "read_cameras")},
    **{name: name for name in ("read_offset", "read_ply", "write_ply")},
    "Runner": "Predictor",
    "read_scene": "read_splats",
    "write_scene": "write_splats",
}


def __getattr__(name: str) -> object:
    """A name of `idesplat` under which this package had it, for one more version."""
    if name not in _MOVED:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    public = __name__.rpartition(".")[0]
    warnings.warn(f"{__name__}.{name} is now {public}.{_MOVED[name]}", DeprecationWarning, stacklevel=2)
    return getattr(import_module(public), _MOVED[name])
