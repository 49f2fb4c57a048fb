"""IDESplat as the registry and the export know it."""

import re
from dataclasses import replace

from ..family import FP16_TOLERANCE, INT8_TOLERANCE, ErrorQuantiles, Family, QuantizableLayers, Tolerance
from .config import IDESplatConfig
from .keys import rename_released
from .network import IDESplat
from .presets import PRESETS

# Relative disparity is divided by its largest value, which is the inverse of the smallest number that a ReLU lets
# through: the scale is a matter of rounding, the shape is not.
SCALE_FREE = ("encoder.mono_disparity",)

IDESPLAT = Family(
    name="IDESplat",
    config=IDESplatConfig,
    presets=PRESETS,
    build=IDESplat,
    rename_released=rename_released,
    # Of the Gaussian head, the cost regulariser of the residual depth and the first convolution.
    quantizable=QuantizableLayers(
        matmuls=re.compile(r"/encoder/(vit/blocks\.|transformer/)"),
        convolutions=re.compile(r"/(encoder/(vit|backbone)|dpbu\d)/|/gaussians/(residual|head1)/"),
    ),
    tolerances={
        # The warp takes the nearest pixel: where a projection falls within rounding of the border between two, the
        # graph may take the other. Relative disparity is an inverse, of numbers that come close to zero, so that the
        # encoder's 99.9th percentile has a wide bound.
        "float32": Tolerance(
            encoder=ErrorQuantiles(1e-4, 1e-3, 2e-1),
            stage=ErrorQuantiles(5e-3, 1e-1, 3e-1),
            end_to_end=ErrorQuantiles(5e-2, 5e-1, 1.0),
            scale_free=SCALE_FREE,
        ),
        "fp16": replace(FP16_TOLERANCE, scale_free=SCALE_FREE),
        "int8": replace(INT8_TOLERANCE, scale_free=SCALE_FREE),
        "int8-qdq": replace(INT8_TOLERANCE, scale_free=SCALE_FREE),
    },
)
