"""Bilinear sampling in parts: gather the four pixels around each position, then interpolate.

ONNX's GridSample is slow on CPUs and missing in some runtimes; integer gathers are everywhere.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor


def bordered(features: Tensor) -> Tensor:
    """Maps [n, channels, h, w] with a border of zeros: the padding of samples outside."""
    return F.pad(features, (1, 1, 1, 1))


def corners_around(x: Tensor, y: Tensor, height: int, width: int) -> tuple[list[Tensor], Tensor, Tensor]:
    """Indices of the four pixels around x and y in a bordered map, upper ones first, and the offsets from left and top.

    x, y: in [-1, width] and [-1, height].
    """
    left, top = x.floor().clamp(max=width - 1), y.floor().clamp(max=height - 1)
    row = width + 2
    upper_left = ((top + 1) * row + left + 1).to(torch.int32)
    return [upper_left, upper_left + 1, upper_left + row, upper_left + row + 1], x - left, y - top


def interpolate(around: Sequence[Tensor], across: Tensor, down: Tensor) -> Tensor:
    """Bilinear interpolation between four values in the order of `corners_around`."""
    upper_left, upper_right, lower_left, lower_right = around
    upper = upper_left + across * (upper_right - upper_left)
    lower = lower_left + across * (lower_right - lower_left)
    return upper + down * (lower - upper)
