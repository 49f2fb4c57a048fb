"""The multi-view transformer (UniMatch, Xu et al. 2023, after GMFlow): self- and cross-attention within windows.

Each block has self-attention in a view, cross-attention to the same windows of its neighbours, and a feed-forward
layer over both, x + norm(MLP([x, message])). Odd blocks have windows that are shifted by half.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .layers import attention, static_dim
from .windows import Regions, join_windows, split_windows

POSITION_TEMPERATURE = 10000.0
POSITION_EPSILON = 1e-6


class MultiViewTransformer(nn.Module):
    """CNN features to matching features, which depend on the neighbouring views."""

    def __init__(self, channels: int, layers: int, ffn_ratio: int, splits: int) -> None:
        super().__init__()
        self.splits = splits
        self.layers = nn.ModuleList(TransformerBlock(channels, ffn_ratio) for _ in range(layers))

    def forward(self, features: Tensor, neighbours: Tensor) -> Tensor:
        """Features [views, channels, h, w], neighbours [views, n] -> features of the same shape.

        h and w must be multiples of twice the number of windows a side.
        """
        _, channels, height, width = features.shape
        rows, columns = height // self.splits, width // self.splits
        position = sine_position(rows, columns, channels, features).repeat(1, self.splits, self.splits)
        image = (features + position).permute(0, 2, 3, 1)
        regions = Regions(self.splits, rows, columns)
        for index, block in enumerate(self.layers):
            shifted = index % 2 == 1
            windows = split_windows(image, rows, columns, shifted)
            windows = block(windows, neighbours, regions if shifted else None)
            image = join_windows(windows, height, width, rows, columns, shifted)
        return image.permute(0, 3, 1, 2)


class TransformerBlock(nn.Module):
    """Self-attention, then cross-attention to the neighbours with a feed-forward network."""

    def __init__(self, channels: int, ffn_ratio: int) -> None:
        super().__init__()
        self.self_attn = WindowAttention(channels)
        self.cross_attn = WindowAttention(channels)
        self.mlp1 = nn.Linear(2 * channels, 2 * channels * ffn_ratio, bias=False)
        self.mlp2 = nn.Linear(2 * channels * ffn_ratio, channels, bias=False)
        self.norm = nn.LayerNorm(channels)

    def forward(self, windows: Tensor, neighbours: Tensor, regions: Regions | None) -> Tensor:
        """Windows [views, windows, tokens, channels] -> the same shape; the neighbours' are those before the block."""
        source = windows + self.self_attn(windows, windows, None, regions)
        message = self.cross_attn(source, windows, neighbours, regions)
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

    def forward(self, source: Tensor, target: Tensor, neighbours: Tensor | None, regions: Regions | None) -> Tensor:
        """source and target [views, windows, tokens, channels] -> message of the same shape.

        With regions (of windows that were shifted), tokens attend within these alone.
        """
        channels = static_dim(source.shape[-1])
        q = self.q_proj(source)
        # Keys and values side by side, so that an exported graph rearranges them once.
        kv = F.linear(target, torch.cat([self.k_proj.weight, self.v_proj.weight]))
        if neighbours is not None:
            # The windows of all neighbours as one sequence [views, windows, tokens * n, channels], neighbours fastest.
            # The releases repeat the mask of regions over it as if neighbours were slowest, so that with two neighbours
            # or more a region is masked with other tokens' regions. The weights were trained with that.
            kv = kv[neighbours].permute(0, 2, 3, 1, 4).flatten(2, 3)
        if regions is None:
            message = attention(q, *kv.split(channels, dim=-1))
        else:
            groups = zip(regions.split(q), regions.split(kv), strict=True)
            message = regions.join([attention(queries, *both.split(channels, dim=-1)) for queries, both in groups])
        return self.norm(self.merge(message))


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
