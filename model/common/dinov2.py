"""The DINOv2 vision transformer (Oquab et al. 2023), as Depth Anything V2 uses it."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..config import ViTConfig
from .layers import attention, to_map, to_tokens

NORM_EPSILON = 1e-6
# DINOv2 adds this to the target size when it interpolates the position embedding; its weights were trained so.
INTERPOLATION_OFFSET = 0.1
# The cubic convolution coefficient of torch's bicubic interpolation.
CUBIC = -0.75


class Attention(nn.Module):
    """Multi-head self-attention."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads, self.head_channels = heads, dim // heads
        self.qkv = nn.Linear(dim, 3 * dim)
        self.proj = nn.Linear(dim, dim)

    def forward(self, x: Tensor) -> Tensor:
        """[n, tokens, dim] -> the same shape."""
        qkv = self.qkv(x).reshape(x.shape[0], -1, 3 * self.heads, self.head_channels).transpose(1, 2)
        q, k, v = qkv.split(self.heads, dim=1)  # [n, heads, tokens, dim / heads]
        return self.proj(attention(q, k, v).transpose(1, 2).reshape(x.shape[0], -1, self.heads * self.head_channels))


class Block(nn.Module):
    """A pre-norm transformer block with layer scale."""

    def __init__(self, dim: int, heads: int, mlp_ratio: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(dim, NORM_EPSILON)
        self.attn = Attention(dim, heads)
        self.scale1 = nn.Parameter(torch.ones(dim))
        self.norm2 = nn.LayerNorm(dim, NORM_EPSILON)
        self.fc1 = nn.Linear(dim, dim * mlp_ratio)
        self.fc2 = nn.Linear(dim * mlp_ratio, dim)
        self.scale2 = nn.Parameter(torch.ones(dim))

    def forward(self, x: Tensor) -> Tensor:
        """[n, tokens, dim] -> the same shape."""
        x = x + self.scale1 * self.attn(self.norm1(x))
        return x + self.scale2 * self.fc2(F.gelu(self.fc1(self.norm2(x))))


class DinoV2(nn.Module):
    """Images -> the normalised patch tokens of four blocks."""

    def __init__(self, config: ViTConfig) -> None:
        super().__init__()
        self.config = config
        self.patch_embed = nn.Conv2d(3, config.dim, config.patch, stride=config.patch)
        self.cls_token = nn.Parameter(torch.zeros(1, 1, config.dim))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + config.grid**2, config.dim))
        self.blocks = nn.ModuleList(Block(config.dim, config.heads, config.mlp_ratio) for _ in range(config.depth))
        self.norm = nn.LayerNorm(config.dim, NORM_EPSILON)
        nn.init.trunc_normal_(self.pos_embed, std=0.02)

    def forward(self, images: Tensor) -> list[Tensor]:
        """Normalised images [n, 3, H, W], multiples of the patch -> four maps [n, dim, H / patch, W / patch]."""
        patches = self.patch_embed(images)
        count, _, rows, columns = patches.shape
        x = torch.cat([self.cls_token.expand(count, -1, -1), to_tokens(patches)], dim=1)
        x = x + self._position_embedding(rows, columns)
        maps = []
        for index, block in enumerate(self.blocks):
            x = block(x)
            if index in self.config.out_indices:
                maps.append(to_map(self.norm(x)[:, 1:], rows, columns))
        return maps

    def _position_embedding(self, rows: int, columns: int) -> Tensor:
        """The trained grid of position embeddings, resized bicubically: [1, 1 + rows * columns, dim]."""
        grid = self.config.grid
        square = self.pos_embed[0, 1:].reshape(grid, -1)  # [grid, grid * dim]: two dimensions, which OpenVINO needs
        # At the trained size the embedding is taken as it is: without the offset the weights are the identity.
        ones = square.new_ones
        trained = ((ones(rows).sum() == grid) & (ones(columns).sum() == grid)).to(square.dtype)
        offset = INTERPOLATION_OFFSET * (1 - trained)
        vertical = _cubic_weights(rows, grid, offset, square)
        horizontal = _cubic_weights(columns, grid, offset, square)
        resized = horizontal @ (vertical @ square).unflatten(1, (grid, -1))  # [rows, columns, dim]
        return torch.cat([self.pos_embed[:, :1], resized.flatten(0, 1)[None]], dim=1)


def _cubic_weights(out_size: int, in_size: int, offset: Tensor, like: Tensor) -> Tensor:
    """Bicubic interpolation along one axis as a matrix [out_size, in_size], equal to torch's with clamped borders.

    ONNX's Resize takes either a size or a scale, and the releases use a scale that differs from the ratio of the sizes.
    """
    steps = torch.arange(out_size, device=like.device).to(like.dtype)
    position = (steps + 0.5) * (in_size / (like.new_ones(out_size).sum() + offset)) - 0.5
    base = position.floor()
    columns = torch.arange(in_size, device=like.device).to(like.dtype)
    shifts = torch.arange(-1, 3, device=like.device).to(like.dtype)
    distance = ((position - base)[:, None] - shifts).abs()  # [out_size, 4]
    near = ((CUBIC + 2) * distance - (CUBIC + 3)) * distance**2 + 1
    far = ((CUBIC * distance - 5 * CUBIC) * distance + 8 * CUBIC) * distance - 4 * CUBIC
    weight = torch.where(distance <= 1, near, far)
    source = (base[:, None] + shifts).clamp(0, in_size - 1)
    return (weight[..., None] * (source[..., None] == columns).to(like.dtype)).sum(1)
