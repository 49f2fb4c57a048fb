"""Choices that a training run is given; importing them loads no PyTorch."""

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
