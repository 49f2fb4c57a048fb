"""The multi-view transformer: windows attend within a view, then to its neighbours (GMFlow, UniMatch)."""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .layers import attention, fixed, to_map, to_tokens
from .windows import join_windows, region_mask, shift_back, split_windows

POSITION_TEMPERATURE = 10000.0
POSITION_EPSILON = 1e-6


class MultiViewTransformer(nn.Module):
    """Matching features that know of the other views."""

    def __init__(self, channels: int, layers: int, ffn_ratio: int, splits: int) -> None:
        super().__init__()
        self.splits = splits
        self.layers = nn.ModuleList(TransformerBlock(channels, ffn_ratio) for _ in range(layers))

    def forward(self, features: Tensor, neighbours: Tensor) -> Tensor:
        """Features [views, channels, h, w], neighbours [views, n] -> features of the same shape.

        h and w must be multiples of the number of splits a side; odd layers attend in windows shifted by half.
        """
        _, channels, height, width = features.shape
        rows, columns = height // self.splits, width // self.splits
        position = sine_position(rows, columns, channels, features).repeat(1, self.splits, self.splits)
        tokens = to_tokens(features + position)
        plain = WindowGrid(height, width, rows, columns, None)
        shifted = plain._replace(mask=region_mask(height, width, rows, columns, features))
        for index, block in enumerate(self.layers):
            tokens = block(tokens, neighbours, shifted if index % 2 else plain)
        return to_map(tokens, height, width)


class WindowGrid(NamedTuple):
    """How a layer's tokens are cut into windows; with a mask [windows, tokens, tokens] they are shifted by half."""

    height: int
    width: int
    rows: int
    columns: int
    mask: Tensor | None

    def split(self, tokens: Tensor) -> Tensor:
        """[n, h * w, channels] -> [n, windows, rows * columns, channels]."""
        image = tokens.reshape(-1, self.height, self.width, fixed(tokens.shape[2]))
        if self.mask is not None:
            image = shift_back(image, self.rows // 2, self.columns // 2)
        return split_windows(image, self.rows, self.columns)

    def join(self, windows: Tensor) -> Tensor:
        """The inverse of `split`."""
        image = join_windows(windows, self.height, self.width, self.rows, self.columns)
        if self.mask is not None:
            image = shift_back(image, self.height - self.rows // 2, self.width - self.columns // 2)
        return image.reshape(-1, self.height * self.width, fixed(image.shape[3]))


class TransformerBlock(nn.Module):
    """Self-attention, then cross-attention to the neighbours with a feed-forward network."""

    def __init__(self, channels: int, ffn_ratio: int) -> None:
        super().__init__()
        self.self_attn = WindowAttention(channels)
        self.cross_attn = WindowAttention(channels)
        self.mlp1 = nn.Linear(2 * channels, 2 * channels * ffn_ratio, bias=False)
        self.mlp2 = nn.Linear(2 * channels * ffn_ratio, channels, bias=False)
        self.norm = nn.LayerNorm(channels)

    def forward(self, tokens: Tensor, neighbours: Tensor, grid: WindowGrid) -> Tensor:
        """Tokens [views, h * w, channels] -> the same shape. The neighbours are seen as they were before the block."""
        source = tokens + self.self_attn(tokens, tokens, None, grid)
        message = self.cross_attn(source, tokens, neighbours, grid)
        message = self.mlp2(F.gelu(self.mlp1(torch.cat([source, message], dim=-1))))
        return source + self.norm(message)


class WindowAttention(nn.Module):
    """Single-head attention of each window to the same window of its own view or of the neighbours."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.q_proj = nn.Linear(channels, channels, bias=False)
        self.k_proj = nn.Linear(channels, channels, bias=False)
        self.v_proj = nn.Linear(channels, channels, bias=False)
        self.merge = nn.Linear(channels, channels, bias=False)
        self.norm = nn.LayerNorm(channels)

    def forward(self, source: Tensor, target: Tensor, neighbours: Tensor | None, grid: WindowGrid) -> Tensor:
        """source and target [views, h * w, channels] -> message of the same shape."""
        q = grid.split(self.q_proj(source))  # [views, windows, tokens, channels]
        k, v = grid.split(self.k_proj(target)), grid.split(self.v_proj(target))
        mask = grid.mask
        if neighbours is not None:
            # The windows of all neighbours as one sequence [views, windows, tokens * n, channels], neighbours fastest.
            # The releases tile the mask all the same, so that with two neighbours or more it hides other tokens than
            # those that the shift brought together. The weights were trained with it.
            k, v = (x[neighbours].permute(0, 2, 3, 1, 4).flatten(2, 3) for x in (k, v))
            mask = None if mask is None else mask.repeat(1, 1, neighbours.shape[1])
        return self.norm(self.merge(grid.join(attention(q, k, v, mask))))


def sine_position(rows: int, columns: int, channels: int, like: Tensor) -> Tensor:
    """DETR's sine position embedding of a window, [channels, rows, columns]; y fills the first half of them."""
    half = channels // 2
    index = torch.arange(half, device=like.device)
    frequency = POSITION_TEMPERATURE ** (2 * (index // 2).to(like.dtype) / half)
    even = index % 2 == 0

    def axis(length: int) -> Tensor:  # [half, length]
        steps = torch.arange(1, length + 1, device=like.device).to(like.dtype)
        angle = steps / (steps[-1:] + POSITION_EPSILON) * (2 * math.pi) / frequency[:, None]
        return torch.where(even[:, None], angle.sin(), angle.cos())

    y = axis(rows)[:, :, None].expand(-1, -1, columns)
    x = axis(columns)[:, None, :].expand(-1, rows, -1)
    return torch.cat([y, x])
