"""Gather attention of epipolar layers for training; it stores no gathered features.

On a CPU the sums are compiled with numba. On a GPU the rows of a pixel's candidates are a bag of `embedding_bag`, whose
kernels sum them without storing them, and the gradient of the table is a kernel of numba's.
"""

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ...model.common.gather_attention import GatherAttention
from ...model.idesplat.network import IDESplat
from ...runtime.system.compilation import compiled
from .cuda_scatter import scatter_add

# The type of device that has compiled sums of its own here.
CPU = "cpu"
# `embedding_bag`'s number of the mode that sums.
SUM_MODE = 0

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
    if pixels.device.type != CPU:
        return bag_dot(pixels, table, rows)
    out = torch.empty(rows.shape, dtype=pixels.dtype)
    _compiled_dot(pixels.numpy(), table.numpy(), rows.numpy(), out.numpy())
    return out


def _weighted_sum(weights: Tensor, table: Tensor, rows: Tensor) -> Tensor:
    """out[p, i] = sum over c of weights[p, c, i] * table[rows[p, c, i]]."""
    if weights.device.type != CPU:
        return bag_weighted_sum(weights, table, rows)
    out = table.new_zeros(rows.shape[0], rows.shape[2], table.shape[1])
    _compiled_weighted_sum(weights.numpy(), table.numpy(), rows.numpy(), out.numpy())
    return out


def _scatter_add(weights: Tensor, pixels: Tensor, table: Tensor, rows: Tensor) -> Tensor:
    """The gradient of the table: out[rows[p, c, i]] += weights[p, c, i] * pixels[p, i]."""
    out = torch.zeros_like(table)
    if weights.device.type != CPU:
        scatter_add(_by_pixel(weights), pixels.flatten(0, 1), _by_pixel(rows), out)
        return out
    _compiled_scatter_add(weights.numpy(), pixels.numpy(), rows.numpy(), out.numpy())
    return out


def bag_dot(pixels: Tensor, table: Tensor, rows: Tensor) -> Tensor:
    """As `_dot`, by the function that gives `embedding_bag` the gradient of its weights."""
    pairs, candidates, count = rows.shape
    bags = _by_pixel(rows)
    number = torch.arange(len(bags), dtype=rows.dtype, device=rows.device)
    dot = torch.ops.aten._embedding_bag_per_sample_weights_backward(
        *(pixels.flatten(0, 1), table, bags.flatten(), number * candidates),
        *(number.repeat_interleave(candidates), SUM_MODE),
    )
    return dot.reshape(pairs, count, candidates).transpose(1, 2).contiguous()


def bag_weighted_sum(weights: Tensor, table: Tensor, rows: Tensor) -> Tensor:
    """As `_weighted_sum`, by `embedding_bag`."""
    total = F.embedding_bag(_by_pixel(rows), table, mode="sum", per_sample_weights=_by_pixel(weights))
    return total.reshape(rows.shape[0], rows.shape[2], table.shape[1])


def _by_pixel(of_candidates: Tensor) -> Tensor:
    """[pairs, candidates, h * w] -> [pairs * h * w, candidates]."""
    return of_candidates.transpose(1, 2).flatten(0, 1).contiguous()


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
