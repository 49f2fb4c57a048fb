"""Choices that a training run is given; importing them loads no PyTorch."""

from dataclasses import dataclass
from enum import StrEnum


class Objective(StrEnum):
    """Supervision of the network: true depth, rendered novel views, or both."""

    DEPTH = "depth"
    PHOTOMETRIC = "photometric"
    BOTH = "both"


class Part(StrEnum):
    """Which part of the network is trained."""

    ALL = "all"
    HEAD = "head"


class PerceptualKind(StrEnum):
    """The perceptual distance that is added to the squared error of rendered views."""

    LPIPS = "lpips"
    LITE0 = "lite0"
    NONE = "none"


class Precision(StrEnum):
    """Arithmetic of convolutions and attention in training."""

    FLOAT32 = "float32"
    BF16 = "bf16"


class Device(StrEnum):
    """Where the network is trained; scenes are rendered and Gaussians composited on the CPU in any case."""

    CPU = "cpu"
    CUDA = "cuda"


@dataclass(frozen=True)
class Resources:
    """What a run is computed with. Its result depends on this by rounding alone, so that a resumed run may have others.

    processes: data-parallel processes, at most the batch size. threads: of PyTorch and of compositing, in each process.
    device: where the network is trained; scenes are rendered and Gaussians composited on the CPU in any case.
    together: how many scenes of two views the network takes at once. loaders: processes that render scenes, with one
    process that trains; 0 for a thread of each that trains.
    """

    processes: int = 1
    threads: int = 1
    device: Device = Device.CPU
    together: int = 1
    loaders: int = 0


@dataclass(frozen=True)
class OptionalTerms:
    """Terms of the loss that are left out where their value is 0.

    pm_loss: weight of PM-Loss beside the squared error of rendered views (`objectives.pointmap`). consistency: weight
    of the multi-view consistency beside it (`objectives.consistency`). aperture: diameter of the lens with which the
    target views of captures are rendered, in scene units, near being 1; 0 for a pinhole (`objectives.defocus`).
    """

    pm_loss: float = 0.0
    consistency: float = 0.0
    aperture: float = 0.0


NO_TERMS = OptionalTerms()

# Gaussians that are only rendered at the context's size leave gaps where a viewer shows them larger.
TARGET_ZOOM = 4
# Context views that are rendered beside the novel views, where the run has no number of its own.
INPUT_VIEWS = {Part.ALL: 1, Part.HEAD: 2}


@dataclass(frozen=True)
class TargetViews:
    """The views of a scene that training renders and compares with images.

    zoom: two are novel views, one of the context images' size, the other a crop of an image from 2 to `zoom` times as
    large; with a zoom of 1 both have their size. inputs: how many context views are rendered beside them, at most all.
    """

    zoom: int = TARGET_ZOOM
    inputs: int = INPUT_VIEWS[Part.ALL]
