"""Small layers and tensor helpers that several modules share."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

GROUPS = 8


def resize(x: Tensor, height: int, width: int) -> Tensor:
    """Resize maps [n, channels, h, w] bilinearly with aligned corners, as all of the releases' resizing is done."""
    return F.interpolate(x, (height, width), mode="bilinear", align_corners=True)


def softmax(x: Tensor, dim: int) -> Tensor:
    """Softmax in elementary operators: ONNX Runtime's CPU kernel is ten times slower along any axis but the last."""
    exponentials = (x - x.amax(dim, keepdim=True)).exp()
    return exponentials / exponentials.sum(dim, keepdim=True)


def static_dim(size: int) -> int:
    """A size that the architecture fixes, as a plain integer, which an exported graph holds as a constant."""
    return int(size)


def attention(q: Tensor, k: Tensor, v: Tensor, mask: Tensor | None = None) -> Tensor:
    """Scaled dot-product attention over the last two axes, with a constant scale in an export."""
    return F.scaled_dot_product_attention(q, k, v, attn_mask=mask, scale=static_dim(q.shape[-1]) ** -0.5)


def repeat_views(x: Tensor, neighbours: int) -> Tensor:
    """Each view's entry repeated for each of its neighbours: [views, ...] -> [views * neighbours, ...]."""
    return x[:, None].expand(-1, neighbours, *[-1] * (x.dim() - 1)).flatten(0, 1)


def to_tokens(x: Tensor) -> Tensor:
    """[n, channels, h, w] -> [n, h * w, channels]."""
    return x.flatten(2).transpose(1, 2)


def to_map(tokens: Tensor, height: int, width: int) -> Tensor:
    """[n, h * w, channels] -> [n, channels, h, w]."""
    return tokens.transpose(1, 2).reshape(-1, static_dim(tokens.shape[2]), height, width)


class Upsample2x(nn.Sequential):
    """Twice the resolution, half the channels (the releases' vit_fpn.py at scale 2)."""

    def __init__(self, channels: int) -> None:
        half = channels // 2
        super().__init__(
            nn.ConvTranspose2d(channels, half, 2, stride=2), nn.GELU(), nn.Conv2d(half, half, 3, padding=1)
        )


class ConcatConv1x1(nn.Module):
    """A 1x1 convolution of the concatenation of maps that are resized to one size.

    A 1x1 convolution and a bilinear resize commute, so each map is convolved at its own, often lower, resolution and
    resized afterwards.
    """

    def __init__(self, in_channels: tuple[int, ...], out_channels: int) -> None:
        super().__init__()
        self.in_channels = in_channels
        self.conv = nn.Conv2d(sum(in_channels), out_channels, 1)

    def forward(self, at_size: list[Tensor], to_resize: list[Tensor], height: int, width: int) -> Tensor:
        """Maps of the target size, then maps to resize, in the order of `in_channels` -> [n, out_channels, h, w]."""
        weights = self.conv.weight.split(self.in_channels, dim=1)
        whole = torch.cat(at_size, dim=1)
        merged = F.conv2d(whole, torch.cat(weights[: len(at_size)], dim=1), self.conv.bias)
        for part, weight in zip(to_resize, weights[len(at_size) :], strict=True):
            merged = merged + resize(F.conv2d(part, weight), height, width)
        return merged


class MapLayerNorm(nn.LayerNorm):
    """Layer normalisation over the channels of maps, in elementary operators.

    ONNX Runtime's CPU kernel normalises one pixel after another, which takes five times as long with 8 channels.
    """

    def forward(self, x: Tensor) -> Tensor:
        """[n, channels, h, w] -> the same shape; in float32, as autocast computes layer normalisation."""
        x = x.float()
        centred = x - x.mean(1, keepdim=True)
        deviation = (centred.square().mean(1, keepdim=True) + self.eps).sqrt()
        return centred / deviation * self.weight[:, None, None] + self.bias[:, None, None]


class MapLinear(nn.Linear):
    """A linear layer over the channels of maps, which is a 1x1 convolution."""

    def forward(self, x: Tensor) -> Tensor:
        """[n, in_features, h, w] -> [n, out_features, h, w]."""
        return F.conv2d(x, self.weight[:, :, None, None], self.bias)


class DepthwiseConv(nn.Module):
    """A depthwise convolution and GELU."""

    def __init__(self, channels: int, kernel: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, channels, kernel, padding=kernel // 2, groups=channels)

    def forward(self, x: Tensor) -> Tensor:
        """[n, channels, h, w] -> the same shape."""
        return F.gelu(self.conv(x))


class ConvFFN(nn.Module):
    """The feed-forward layer after epipolar and window attention, with a depthwise convolution in the hidden layer.

    The releases compute its linear layers on tokens; on maps ONNX Runtime needs no change of layout.
    """

    def __init__(self, channels: int, ratio: int, kernel: int) -> None:
        super().__init__()
        self.fc1 = MapLinear(channels, channels * ratio)
        self.depthwise = DepthwiseConv(channels * ratio, kernel)
        self.fc2 = MapLinear(channels * ratio, channels)

    def forward(self, x: Tensor) -> Tensor:
        """[n, channels, h, w] -> the same shape."""
        hidden = F.gelu(self.fc1(x))
        return self.fc2(hidden + self.depthwise(hidden))
