"""DepthSplat as the registry and the export know it."""

import re

from ..common.network import Network
from ..family import FP16_TOLERANCE, INT8_TOLERANCE, ErrorQuantiles, Family, QuantizableLayers, Tolerance
from .config import DepthSplatConfig
from .keys import rename_released
from .network import DepthSplat, DepthSplatDepth
from .presets import PRESETS

_STAGE = ErrorQuantiles(1e-4, 1e-3, 2e-3)


def build(config: DepthSplatConfig) -> Network:
    """The network with Gaussians, or the depth-only one."""
    return DepthSplat(config) if config.gaussians else DepthSplatDepth(config)


DEPTHSPLAT = Family(
    name="DepthSplat",
    config=DepthSplatConfig,
    presets=PRESETS,
    build=build,
    rename_released=rename_released,
    quantizable=QuantizableLayers(
        matmuls=re.compile(r"/encoder/(vit/blocks\.|transformer/)"),
        convolutions=re.compile(r"/(encoder/(vit|backbone)|depth)/|/gaussians/(upsampler|regressor\d|head1)/"),
    ),
    # The warp is bilinear, so that rounding moves no pixel far.
    tolerances={
        "float32": Tolerance(encoder=_STAGE, stage=_STAGE, end_to_end=ErrorQuantiles(1e-3, 1e-2, 5e-2)),
        "fp16": FP16_TOLERANCE,
        "int8": INT8_TOLERANCE,
        "int8-qdq": INT8_TOLERANCE,
    },
)
