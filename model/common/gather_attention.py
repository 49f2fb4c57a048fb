"""Products of pixels with the few rows of a table that each of them picks.

A table holds the features of all pixels of all views, one a row; a pixel picks those rows that its candidates fall on.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .layers import static_dim

# Candidates gathered at once: it bounds the memory to this many copies of the features.
CHUNK = 8


class GatherAttention(nn.Module):
    """The two products as a part of a network, where training on a CPU and the export put others in their place."""

    def __init__(self, gathers: int, block: int) -> None:
        """gathers: the numbers that a pixel gathers for a product. block: pixels that every map has a multiple of."""
        super().__init__()
        self.gathers, self.block = gathers, block
        self.gathered_dot, self.gathered_weighted_sum = gathered_dot, gathered_weighted_sum


def pixel_table(tokens: Tensor) -> Tensor:
    """All views' pixels as rows, and a last row of zeros for what lies outside: [views * h * w + 1, channels]."""
    rows = tokens.flatten(0, 1)
    return torch.cat([rows, torch.zeros_like(rows[:1])])


def gathered_dot(queries: Tensor, table: Tensor, rows: Tensor) -> Tensor:
    """Inner products of queries [pairs, h * w, channels] with the table's rows: [pairs, candidates, h * w]."""
    queries = queries[:, None]
    starts = range(0, static_dim(rows.shape[1]), CHUNK)
    scores = [(F.embedding(rows[:, start : start + CHUNK], table) * queries).sum(-1) for start in starts]
    return torch.cat(scores, dim=1)


def gathered_weighted_sum(probability: Tensor, table: Tensor, rows: Tensor) -> Tensor:
    """The table's rows [pairs, candidates, h * w] summed by probability: [pairs, h * w, channels]."""
    probability = probability[..., None]
    total = torch.zeros_like(probability[:, 0])
    for start in range(0, static_dim(rows.shape[1]), CHUNK):
        chunk = slice(start, start + CHUNK)
        total = total + (F.embedding(rows[:, chunk], table) * probability[:, chunk]).sum(1)
    return total
