"""The Gaussian focused module (GFM): window attention that keeps fewer neighbours of each pixel from layer to layer.

IDESplat, section 4. Layers alternate between plain and shifted windows. With B the attention of the layer two before,
which has the same windows (1 in the first two layers), a layer's attention is

    A = top-k(Norm(softmax(Q K^T / sqrt(d) + position bias) * B)).

Neighbours that B has pruned stay pruned: their score is -inf. Weights below the k-th largest are set to zero, without
renormalisation, as in the released code.
"""

import torch
from torch import Tensor, nn

from ..common.layers import ConvFFN, DepthwiseConv, MapLayerNorm, static_dim, to_map, to_tokens
from ..common.windows import join_windows, region_mask, split_windows
from .config import FocusConfig

EPSILON = 1e-10


class GaussianFocusedModule(nn.Module):
    """Layers with plain and shifted windows in turn; each passes its attention to the next with the same windows."""

    def __init__(self, config: FocusConfig, ffn_ratio: int, ffn_kernel: int) -> None:
        super().__init__()
        self.window = config.window
        self.layers = nn.ModuleList(
            FocusedLayer(config, index, ffn_ratio, ffn_kernel) for index in range(len(config.topk))
        )

    def forward(self, x: Tensor) -> Tensor:
        """[views, channels, h, w] -> the same shape; h and w are padded by reflection to whole windows, and cropped."""
        height, width = x.shape[2:]
        window = self.window
        padded_height = (height + window - 1) // window * window
        padded_width = (width + window - 1) // window * window
        x = torch.cat([x, x.flip(2)], dim=2)[:, :, :padded_height]
        x = torch.cat([x, x.flip(3)], dim=3)[:, :, :, :padded_width]
        mask = region_mask(padded_height, padded_width, window, window, x)
        attention: list[Tensor | None] = [None, None]
        for index, layer in enumerate(self.layers):
            x, attention[index % 2] = layer(x, attention[index % 2], mask)
        return x[:, :, :height, :width]


class FocusedLayer(nn.Module):
    """One layer of the module, followed by a convolutional feed-forward layer.

    The releases gather the kept neighbours in a CUDA kernel. Windows are small, so here the attention stays dense, with
    zeros where a neighbour is pruned: the same sums with standard operators.
    """

    position_index: Tensor

    def __init__(self, config: FocusConfig, index: int, ffn_ratio: int, ffn_kernel: int) -> None:
        super().__init__()
        channels, self.window, self.heads = config.channels, config.window, config.heads
        self.head_channels = channels // self.heads
        tokens = self.window**2
        self.shifted = index % 2 == 1
        self.topk = config.topk[index]
        self.prunes = self.topk < (config.topk[index - 2] if index >= 2 else tokens)
        # Whether the layer two before has pruned neighbours.
        self.pruned = index >= 2 and config.topk[index - 2] < tokens
        self.norm1 = nn.LayerNorm(channels)
        self.q_proj = nn.Linear(channels, channels)
        self.k_proj = nn.Linear(channels, channels)
        self.v_proj = nn.Linear(channels, channels)
        self.v_depthwise = DepthwiseConv(channels, ffn_kernel)
        self.position_bias = nn.Parameter(torch.zeros((2 * self.window - 1) ** 2, self.heads))
        nn.init.trunc_normal_(self.position_bias, std=0.02)
        self.register_buffer("position_index", relative_position_index(self.window), persistent=False)
        self.proj = nn.Linear(channels, channels)
        self.norm2 = MapLayerNorm(channels)
        self.ffn = ConvFFN(channels, ffn_ratio, ffn_kernel)

    def forward(self, x: Tensor, before: Tensor | None, mask: Tensor) -> tuple[Tensor, Tensor]:
        """x [views, channels, h, w], before [views, windows, heads, tokens, tokens] or None -> x and this attention."""
        height, width = x.shape[2:]
        normed = self.norm1(to_tokens(x))
        value = self.v_proj(normed)
        local = to_tokens(self.v_depthwise(to_map(value, height, width)))
        parts = [self.q_proj(normed), self.k_proj(normed), value, local]
        q, k, v, local = self._split(torch.cat(parts, dim=-1), height, width).split(self.heads, dim=2)
        attention = self._attend(q, k, before, mask)
        x = x + to_map(self.proj(self._join(attention @ v + local, height, width)), height, width)
        return x + self.ffn(self.norm2(x)), attention

    def _attend(self, q: Tensor, k: Tensor, before: Tensor | None, mask: Tensor) -> Tensor:
        """Attention over the neighbours that are left; of these the `topk` strongest stay."""
        scores = (q * self.head_channels**-0.5) @ k.transpose(-1, -2)  # [views, windows, heads, tokens, tokens]
        scores = scores + self.position_bias[self.position_index].permute(2, 0, 1)
        if before is not None and self.pruned:
            # From here on the releases omit the window mask: what it excluded has next to no weight in `before`.
            scores = torch.where(before > 0, scores, -torch.inf)
        elif self.shifted:
            scores = scores + mask[:, None]
        attention = scores.softmax(-1)
        if before is not None:
            product = attention * before + EPSILON
            if self.pruned:
                product = torch.where(before > 0, product, 0.0)
            attention = product / (product.sum(-1, keepdim=True) + EPSILON)
        if self.prunes:
            # The k-th largest weight; unsorted top-k takes half the time.
            weakest = attention.topk(self.topk, dim=-1, sorted=False).values.amin(-1, keepdim=True)
            # A product with zero or one: ONNX Runtime's Where takes seven times as long.
            attention = attention * (attention >= weakest).to(attention.dtype)
        return attention

    def _split(self, tokens: Tensor, height: int, width: int) -> Tensor:
        """[views, h * w, channels] -> [views, windows, heads, tokens, head channels], shifted in odd layers.

        With the channels of several tensors, the heads are those of all.
        """
        channels = static_dim(tokens.shape[2])
        image = tokens.reshape(-1, height, width, channels)
        windows = split_windows(image, self.window, self.window, self.shifted)
        heads = channels // self.head_channels
        return windows.reshape(tokens.shape[0], -1, self.window**2, heads, self.head_channels).transpose(2, 3)

    def _join(self, windows: Tensor, height: int, width: int) -> Tensor:
        """The inverse of `_split`."""
        windows = windows.transpose(2, 3).reshape(-1, self.window**2, self.heads * self.head_channels)
        image = join_windows(windows, height, width, self.window, self.window, self.shifted)
        return image.reshape(-1, height * width, self.heads * self.head_channels)


def relative_position_index(window: int) -> Tensor:
    """Row of the position bias table for each pair of a window's tokens, [tokens, tokens] (Swin)."""
    steps = torch.arange(window)
    y, x = steps.repeat_interleave(window), steps.repeat(window)
    return (y[:, None] - y + window - 1) * (2 * window - 1) + (x[:, None] - x + window - 1)
