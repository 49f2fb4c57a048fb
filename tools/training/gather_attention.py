"""Gather attention of epipolar layers for training; it stores no gathered features.

On a CPU the sums are compiled with numba, elsewhere they are the network's own, in larger chunks.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...model.common import gather_attention as networks
from ...model.common.gather_attention import GatherAttention
from ...model.idesplat.network import IDESplat
from ...runtime.system.compilation import compiled

# The type of device that the sums are compiled for. Elsewhere so many candidates are gathered at a time, which bounds
# memory to this many copies of the features.
COMPILED_FOR, CHUNK = "cpu", 32

_compiled = compiled(fastmath={"contract", "arcp", "nsz", "reassoc"})


def use_training_gather_attention(model: IDESplat) -> IDESplat:
    """Replace the gather attention of all epipolar layers by this one: the same sums, on a CPU ten times as fast."""
    for module in model.modules():
        if isinstance(module, GatherAttention):
            module.gathered_dot, module.gathered_weighted_sum = gathered_dot, gathered_weighted_sum
    return model


class _GatheredDot(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, queries: Tensor, table: Tensor, rows: Tensor) -> Tensor:
        queries, table, rows = queries.contiguous(), table.contiguous(), rows.contiguous()
        ctx.save_for_backward(queries, table, rows)
        return _dot(queries, table, rows)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:
        queries, table, rows = ctx.saved_tensors
        gradient = gradients[0].contiguous()
        return _weighted_sum(gradient, table, rows), _scatter_add(gradient, queries, table, rows), None


class _GatheredWeightedSum(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, probability: Tensor, table: Tensor, rows: Tensor) -> Tensor:
        probability, table, rows = probability.contiguous(), table.contiguous(), rows.contiguous()
        ctx.save_for_backward(probability, table, rows)
        return _weighted_sum(probability, table, rows)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:
        probability, table, rows = ctx.saved_tensors
        gradient = gradients[0].contiguous()
        return _dot(gradient, table, rows), _scatter_add(probability, gradient, table, rows), None


def gathered_dot(queries: Tensor, table: Tensor, rows: Tensor) -> Tensor:
    """As `GatherAttention.gathered_dot`."""
    return _GatheredDot.apply(queries, table, rows)


def gathered_weighted_sum(probability: Tensor, table: Tensor, rows: Tensor) -> Tensor:
    """As `GatherAttention.gathered_weighted_sum`."""
    return _GatheredWeightedSum.apply(probability, table, rows)


def _dot(pixels: Tensor, table: Tensor, rows: Tensor) -> Tensor:
    """out[p, c, i] = pixels[p, i] . table[rows[p, c, i]]."""
    if pixels.device.type != COMPILED_FOR:
        return networks.gathered_dot(pixels, table, rows, CHUNK)
    out = torch.empty(rows.shape, dtype=pixels.dtype)
    _compiled_dot(pixels.numpy(), table.numpy(), rows.numpy(), out.numpy())
    return out


def _weighted_sum(weights: Tensor, table: Tensor, rows: Tensor) -> Tensor:
    """out[p, i] = sum over c of weights[p, c, i] * table[rows[p, c, i]]."""
    if weights.device.type != COMPILED_FOR:
        return networks.gathered_weighted_sum(weights, table, rows, CHUNK)
    out = table.new_zeros(rows.shape[0], rows.shape[2], table.shape[1])
    _compiled_weighted_sum(weights.numpy(), table.numpy(), rows.numpy(), out.numpy())
    return out


def _scatter_add(weights: Tensor, pixels: Tensor, table: Tensor, rows: Tensor) -> Tensor:
    """The gradient of the table: out[rows[p, c, i]] += weights[p, c, i] * pixels[p, i]."""
    out = torch.zeros_like(table)
    if weights.device.type == COMPILED_FOR:
        _compiled_scatter_add(weights.numpy(), pixels.numpy(), rows.numpy(), out.numpy())
        return out
    for some_weights, some_rows in zip(weights.split(CHUNK, dim=1), rows.split(CHUNK, dim=1), strict=True):
        out.index_add_(0, some_rows.flatten(), (some_weights[..., None] * pixels[:, None]).flatten(0, 2))
    return out


@_compiled
def _compiled_dot(pixels: np.ndarray, table: np.ndarray, rows: np.ndarray, out: np.ndarray) -> None:
    """out[p, c, i] = pixels[p, i] . table[rows[p, c, i]]."""
    pairs, candidates, count = rows.shape
    for p in range(pairs):
        for i in range(count):
            for c in range(candidates):
                row = rows[p, c, i]
                total = np.float32(0)
                for k in range(table.shape[1]):
                    total += pixels[p, i, k] * table[row, k]
                out[p, c, i] = total


@_compiled
def _compiled_weighted_sum(weights: np.ndarray, table: np.ndarray, rows: np.ndarray, out: np.ndarray) -> None:
    """out[p, i] += weights[p, c, i] * table[rows[p, c, i]], summed over c."""
    pairs, candidates, count = rows.shape
    for p in range(pairs):
        for i in range(count):
            for c in range(candidates):
                row, weight = rows[p, c, i], weights[p, c, i]
                for k in range(table.shape[1]):
                    out[p, i, k] += weight * table[row, k]


@_compiled
def _compiled_scatter_add(weights: np.ndarray, pixels: np.ndarray, rows: np.ndarray, out: np.ndarray) -> None:
    """out[rows[p, c, i]] += weights[p, c, i] * pixels[p, i]."""
    pairs, candidates, count = rows.shape
    for p in range(pairs):
        for i in range(count):
            for c in range(candidates):
                row, weight = rows[p, c, i], weights[p, c, i]
                for k in range(pixels.shape[2]):
                    out[row, k] += weight * pixels[p, i, k]
