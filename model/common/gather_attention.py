"""Gather attention: scores and weighted sums of each pixel with a few rows of a table.

The table holds the features of all pixels of all views, one a row. rows[p, c, x] is the row of pixel x's candidate c:

    gathered_dot:           score[p, c, x] = <query[p, x], table[rows[p, c, x]]>
    gathered_weighted_sum:  sum[p, x] = sum_c probability[p, c, x] table[rows[p, c, x]]

These are the sparse matrix products of the released CUDA extension, as standard operators.
"""

from collections.abc import Callable

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
    starts = range(0, candidates, chunk)
    scores = [(F.embedding(rows[:, start : start + chunk], table) * queries).sum(-1) for start in starts]
    return torch.cat(scores, dim=1)


def gathered_weighted_sum(probability: Tensor, table: Tensor, rows: Tensor, chunk: int = CHUNK) -> Tensor:
    """The table's rows [pairs, candidates, h * w] summed by probability: [pairs, h * w, channels]."""
    probability = probability[..., None]
    candidates = static_dim(rows.shape[1])
    if candidates <= chunk:
        return (F.embedding(rows, table) * probability).sum(1)
    total = torch.zeros_like(probability[:, 0])
    for start in range(0, candidates, chunk):
        part = slice(start, start + chunk)
        total = total + (F.embedding(rows[:, part], table) * probability[:, part]).sum(1)
    return total
