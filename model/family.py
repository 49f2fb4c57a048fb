"""What a network family tells the rest of the project, as one object in each family's package.

Export, tools and checkpoint loading ask this object; none of them chooses by the type of a network or by the name of a
preset. A new family is a package with such an object, and a line in registry.py.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from torch import Tensor

from .common.network import Network
from .config import EncoderConfig


class ErrorQuantiles(NamedTuple):
    """Quantiles of one tensor's errors, or bounds on them, in standard deviations of a channel."""

    median: float
    percentile_99: float
    percentile_99_9: float


# A channel's standard deviation counts for at least this fraction of its tensor's root mean square. float32 rounds sums
# of the tensor's magnitude; that error (6e-8 of it, times the square root of some thousand terms) is then below 1e-2.
MIN_DEVIATION = 1e-3
# int8 has 256 values for the range of a whole tensor, some 20 root mean squares where a transformer has outliers. Each
# rounding is off by 0.02 of one, a dozen in a row by a tenth, whatever the deviation of the channel is.
MIN_DEVIATION_INT8 = 0.25


@dataclass(frozen=True)
class Tolerance:
    """Parity bounds: of the encoder and the other stages, each fed with the network's own tensors, and end to end.

    min_deviation: lower limit of a channel's standard deviation, in root mean squares of its tensor.
    scale_free: tensors that are defined up to a scale, which the comparison divides out.
    """

    encoder: ErrorQuantiles
    stage: ErrorQuantiles
    end_to_end: ErrorQuantiles
    min_deviation: float = MIN_DEVIATION
    scale_free: tuple[str, ...] = ()


# Bounds of the lower precisions, which hold for every network so far; docs/parity.md says where each comes from.
_FP16 = ErrorQuantiles(2e-2, 2e-1, 1.0)
_INT8 = ErrorQuantiles(5e-1, 2.0, 4.0)
FP16_TOLERANCE = Tolerance(_FP16, _FP16, ErrorQuantiles(1e-1, 5e-1, 1.0))
INT8_TOLERANCE = Tolerance(_INT8, _INT8, _INT8, MIN_DEVIATION_INT8)


@dataclass(frozen=True)
class QuantizableLayers:
    """The layers that may run in fp16 or int8, as patterns of the graph's node names, which begin with a stage's name.

    All else stays in float32: inputs and outputs, geometry, monocular depth, gather attention, softmax and norms.
    """

    matmuls: re.Pattern[str]
    convolutions: re.Pattern[str]


@dataclass(frozen=True)
class Family:
    """One network architecture in all of its sizes."""

    name: str
    # The type of its configurations, by which a network is known to be of this family.
    config: type[EncoderConfig]
    presets: Mapping[str, EncoderConfig]
    build: Callable[[Any], Network]
    # A checkpoint's tensors -> the same by this project's names.
    rename_released: Callable[[dict[str, Tensor]], dict[str, Tensor]]
    quantizable: QuantizableLayers
    # By precision: float32, fp16, int8, int8-qdq.
    tolerances: Mapping[str, Tolerance]
