"""Gather attention: scores and weighted sums of each pixel with a few rows of a table.

The table holds the features of all pixels of all views, one a row. rows[p, c, x] is the row of pixel x's candidate c:

    gathered_dot:           score[p, c, x] = <query[p, x], table[rows[p, c, x]]>
    gathered_weighted_sum:  sum[p, x] = sum_c probability[p, c, x] table[rows[p, c, x]]

These are the sparse matrix products of the released CUDA extension, as standard operators.
"""

from collections.abc import Callable
from functools import reduce

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .layers import static_dim

GatherOperation = Callable[[Tensor, Tensor, Tensor], Tensor]
# Candidates gathered at a time, which bounds memory to this many copies of the features.
CHUNK = 8


class GatherAttention(nn.Module):
    """The two operations as attributes, which training on a CPU and the export replace by their own."""

    def __init__(self, gathers: int, block: int) -> None:
        """gathers: values gathered a pixel. block: a number of pixels of which every map has a multiple."""
        super().__init__()
        self.gathers, self.block = gathers, block
        self.gathered_dot: GatherOperation = gathered_dot
        self.gathered_weighted_sum: GatherOperation = gathered_weighted_sum


def pixel_table(tokens: Tensor) -> Tensor:
    """All views' pixels as rows, and a last row of zeros for "outside": [views * h * w + 1, channels]."""
    rows = tokens.flatten(0, 1)
    return torch.cat([rows, torch.zeros_like(rows[:1])])


def gathered_dot(queries: Tensor, table: Tensor, rows: Tensor, chunk: int = CHUNK) -> Tensor:
    """Inner products of queries [pairs, h * w, channels] with the table's rows: [pairs, candidates, h * w].

    chunk: candidates gathered at a time.
    """
    queries = queries[:, None]
    candidates = static_dim(rows.shape[1])
    if candidates <= chunk:
        return (F.embedding(rows, table) * queries).sum(-1)
    parts = _chunks(rows, chunk)
    return torch.cat([(F.embedding(rows.index_select(1, part), table) * queries).sum(-1) for part in parts], dim=1)


def gathered_weighted_sum(probability: Tensor, table: Tensor, rows: Tensor, chunk: int = CHUNK) -> Tensor:
    """The table's rows [pairs, candidates, h * w] summed by probability: [pairs, h * w, channels]."""
    probability = probability[..., None]
    candidates = static_dim(rows.shape[1])
    if candidates <= chunk:
        return (F.embedding(rows, table) * probability).sum(1)
    products = (
        (F.embedding(rows.index_select(1, part), table) * probability.index_select(1, part)).sum(1)
        for part in _chunks(rows, chunk)
    )
    return reduce(torch.add, products)


def _chunks(rows: Tensor, chunk: int) -> tuple[Tensor, ...]:
    """The candidates' indices, a few at a time.

    Selected by index, not sliced: ONNX Runtime makes one Split of such slices, and WebGPU has none of integers.
    """
    return torch.arange(static_dim(rows.shape[1]), device=rows.device).split(chunk)
