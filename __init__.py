"""Feed-forward 3D Gaussian splatting: released checkpoints to ONNX, images to splats.

The public interface. A name loads its module when it is first used, so that importing the package costs nothing.
"""

import warnings
from importlib import import_module
from typing import TYPE_CHECKING

# Absolute: pytest also imports this file by itself, without a package, where the checkout's folder is called `a-b`.
from idesplat.runtime import startup as startup

if TYPE_CHECKING:
    from .export.pipeline import export_checkpoint
    from .runtime.batch.reconstructor import SceneReconstructor
    from .runtime.batch.run import batch
    from .runtime.cameras.camera import Camera
    from .runtime.cameras.io import read_cameras, write_cameras
    from .runtime.errors import InputError
    from .runtime.inference.bundled_model import bundled_model
    from .runtime.inference.metadata import ModelMetadata
    from .runtime.inference.predictor import Prediction, Predictor
    from .runtime.inference.predictor import Predictor as Runner
    from .runtime.reconstruction.pipeline import reconstruct
    from .runtime.reconstruction.result import Reconstruction
    from .runtime.rendering.rasterizer import rasterize
    from .runtime.rendering.render import render
    from .runtime.sfm.estimate import estimate_cameras
    from .runtime.splats.formats.ply import read_ply, write_ply
    from .runtime.splats.gaussians import Gaussians
    from .runtime.splats.io import read_offset, read_splats, write_splats
    from .tools.evaluation.evaluate import evaluate

    __version__: str

_MODULE_OF = {
    "Camera": "runtime.cameras.camera",
    "Gaussians": "runtime.splats.gaussians",
    "InputError": "runtime.errors",
    "ModelMetadata": "runtime.inference.metadata",
    "Prediction": "runtime.inference.predictor",
    "Predictor": "runtime.inference.predictor",
    "SceneReconstructor": "runtime.batch.reconstructor",
    "Reconstruction": "runtime.reconstruction.result",
    "batch": "runtime.batch.run",
    "bundled_model": "runtime.inference.bundled_model",
    "estimate_cameras": "runtime.sfm.estimate",
    "export_checkpoint": "export.pipeline",
    "evaluate": "tools.evaluation.evaluate",
    "rasterize": "runtime.rendering.rasterizer",
    "read_cameras": "runtime.cameras.io",
    "read_offset": "runtime.splats.io",
    "read_ply": "runtime.splats.formats.ply",
    "read_splats": "runtime.splats.io",
    "reconstruct": "runtime.reconstruction.pipeline",
    "render": "runtime.rendering.render",
    "write_cameras": "runtime.cameras.io",
    "write_ply": "runtime.splats.formats.ply",
    "write_splats": "runtime.splats.io",
}

__all__ = [
    "Camera",
    "Gaussians",
    "InputError",
    "ModelMetadata",
    "Prediction",
    "Predictor",
    "Reconstruction",
    "Runner",
    "SceneReconstructor",
    "__version__",
    "batch",
    "bundled_model",
    "estimate_cameras",
    "evaluate",
    "export_checkpoint",
    "rasterize",
    "read_cameras",
    "read_offset",
    "read_ply",
    "read_splats",
    "reconstruct",
    "render",
    "write_cameras",
    "write_ply",
    "write_splats",
]


def __getattr__(name: str) -> object:
    """Load a public name from its module, once."""
    value: object
    if name == "Runner":
        warnings.warn("Runner is now called Predictor", DeprecationWarning, stacklevel=2)
        return __getattr__("Predictor")
    if name == "__version__":
        value = import_module("importlib.metadata").version("idesplat")
    elif name in _MODULE_OF:
        value = getattr(import_module(f".{_MODULE_OF[name]}", __name__), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
