"""The U-Net that regularises cost volumes, with cross-view attention at its coarsest level (the releases' ldm_unet)."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..config import UNetConfig
from .layers import GROUPS, attention, softmax


def group_norm(channels: int) -> nn.GroupNorm:
    """Eight groups where they fit, else four, as in the releases' util.py."""
    return nn.GroupNorm(GROUPS if channels % GROUPS == 0 else GROUPS // 2, channels)


class ResBlock(nn.Module):
    """Two normalised, activated 3x3 convolutions and a shortcut."""

    def __init__(self, in_channels: int, channels: int) -> None:
        super().__init__()
        self.norm1 = group_norm(in_channels)
        self.conv1 = nn.Conv2d(in_channels, channels, 3, padding=1)
        self.norm2 = group_norm(channels)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)
        self.shortcut = nn.Conv2d(in_channels, channels, 1) if in_channels != channels else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        """[n, in_channels, h, w] -> [n, channels, h, w]."""
        y = self.conv1(F.silu(self.norm1(x)))
        return self.shortcut(x) + self.conv2(F.silu(self.norm2(y)))


class CrossViewAttention(nn.Module):
    """Every pixel of a group of views attends to every pixel of all of them."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads, self.head_channels = heads, channels // heads
        self.norm = group_norm(channels)
        self.qkv = nn.Conv1d(channels, 3 * channels, 1)
        self.proj_out = nn.Conv1d(channels, channels, 1)

    def forward(self, x: Tensor, views: int) -> Tensor:
        """[groups * views, channels, h, w] -> the same shape."""
        height, width = x.shape[2:]
        pixels = height * width
        qkv = self.qkv(self.norm(x.flatten(2)))  # [groups * views, 3 * channels, pixels]
        qkv = qkv.reshape(-1, views, self.heads, 3, self.head_channels, pixels).permute(0, 3, 2, 1, 5, 4)
        q, k, v = qkv.reshape(-1, 3 * self.heads, views * pixels, self.head_channels).split(self.heads, dim=1)
        out = attention(q, k, v)  # [groups, heads, views * pixels, channels / heads]
        out = out.reshape(-1, self.heads, views, pixels, self.head_channels).permute(0, 2, 1, 4, 3)
        out = out.reshape(-1, self.heads * self.head_channels, pixels)  # [groups * views, channels, pixels]
        return x + self.proj_out(out).reshape(x.shape)


class UNet(nn.Module):
    """A U-Net with as many channels at every level; height and width must be divisible by 2^(levels - 1)."""

    def __init__(self, config: UNetConfig) -> None:
        super().__init__()
        channels, last = config.channels, config.levels - 1
        self.conv_in = nn.Conv2d(channels, channels, 3, padding=1)
        self.down_blocks = nn.ModuleList(ResBlock(channels, channels) for _ in range(config.levels))
        self.downsamples = nn.ModuleList(nn.Conv2d(channels, channels, 3, stride=2, padding=1) for _ in range(last))
        self.down_attention = CrossViewAttention(channels, config.heads)
        self.middle = nn.ModuleList(ResBlock(channels, channels) for _ in range(2))
        # Two blocks a level, coarsest first: the output and the downsampled input of a level are both skip connections.
        self.up_blocks = nn.ModuleList(ResBlock(2 * channels, channels) for _ in range(2 * config.levels))
        self.up_attention = nn.ModuleList(CrossViewAttention(channels, config.heads) for _ in range(2))
        self.upsamples = nn.ModuleList(nn.Conv2d(channels, channels, 3, padding=1) for _ in range(last))
        self.norm_out = group_norm(channels)
        self.conv_out = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor, views: int) -> Tensor:
        """[groups * views, channels, h, w] -> the same shape."""
        last = len(self.downsamples)
        x = self.conv_in(x)
        skips = [x]
        for level, block in enumerate(self.down_blocks):
            x = block(x)
            if level == last:
                x = self.down_attention(x, views)
            skips.append(x)
            if level < last:
                x = self.downsamples[level](x)
                skips.append(x)
        for block in self.middle:
            x = block(x)
        for index, block in enumerate(self.up_blocks):
            x = block(torch.cat([x, skips.pop()], dim=1))
            if index < 2:
                x = self.up_attention[index](x, views)
            if index % 2 and index // 2 < last:
                x = self.upsamples[index // 2](F.interpolate(x, scale_factor=2.0, mode="nearest"))
        return self.conv_out(F.silu(self.norm_out(x)))


class CostRegulariser(nn.Module):
    """Costs and further features of a pixel -> a score for each candidate, by the U-Net."""

    def __init__(self, in_channels: int, candidates: int, config: UNetConfig) -> None:
        super().__init__()
        self.conv_in = nn.Conv2d(in_channels, config.channels, 3, padding=1)
        self.norm_in = nn.GroupNorm(GROUPS, config.channels)
        self.unet = UNet(config)
        self.conv_out = nn.Conv2d(config.channels, candidates, 3, padding=1)

    def forward(self, x: Tensor, views: int) -> Tensor:
        """[groups * views, in_channels, h, w] -> probabilities [groups * views, candidates, h, w]."""
        return softmax(self.scores(x, views), dim=1)

    def scores(self, x: Tensor, views: int) -> Tensor:
        """The same before the softmax."""
        scores: Tensor = self.conv_out(self.unet(F.gelu(self.norm_in(self.conv_in(x))), views))
        return scores
