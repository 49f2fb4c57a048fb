"""EfficientNet-Lite0 up to stride 16, with ImageNet weights whose batch normalisation is folded into convolutions."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

# What the weights were trained with: (255 * image - 127) / 128.
MEAN, STD = 127 / 255, 128 / 255
BATCH_NORM_EPSILON = 1e-3
STEM_CHANNELS = 32
# Kernel, stride, expansion, output channels of the blocks.
BLOCKS = (
    (3, 1, 1, 16),
    *((3, 2, 6, 24), (3, 1, 6, 24)),
    *((5, 2, 6, 40), (5, 1, 6, 40)),
    *((3, 2, 6, 80), (3, 1, 6, 80), (3, 1, 6, 80)),
    *((5, 1, 6, 112), (5, 1, 6, 112), (5, 1, 6, 112)),
)
# The blocks whose outputs are the features, their strides and channels.
OUT_INDICES = (0, 2, 4, 10)
STRIDES = (2, 4, 8, 16)
CHANNELS = tuple(BLOCKS[index][3] for index in OUT_INDICES)


class SamePaddedConv2d(nn.Conv2d):
    """A convolution padded as TensorFlow pads maps of even size: with stride 2, one pixel more after than before."""

    def forward(self, x: Tensor) -> Tensor:
        """[n, channels, h, w] -> [n, channels, h / stride, w / stride]; h and w are multiples of the stride."""
        total = self.kernel_size[0] - self.stride[0]
        before, after = total // 2, total - total // 2
        return super().forward(F.pad(x, (before, after, before, after)) if total else x)


class InvertedResidual(nn.Module):
    """MBConv without squeeze and excitation: 1x1 expansion, depthwise convolution, 1x1 projection."""

    def __init__(self, in_channels: int, kernel: int, stride: int, expansion: int, channels: int) -> None:
        super().__init__()
        hidden = expansion * in_channels
        self.expand = nn.Conv2d(in_channels, hidden, 1) if expansion > 1 else None
        self.depthwise = SamePaddedConv2d(hidden, hidden, kernel, stride, groups=hidden)
        self.project = nn.Conv2d(hidden, channels, 1)
        self.shortcut = stride == 1 and in_channels == channels

    def forward(self, x: Tensor) -> Tensor:
        """[n, in_channels, h, w] -> [n, channels, h / stride, w / stride]."""
        y = x if self.expand is None else F.relu6(self.expand(x))
        y = self.project(F.relu6(self.depthwise(y)))
        return x + y if self.shortcut else y


class EfficientNetLite0(nn.Module):
    """Images to feature maps at strides 2, 4, 8 and 16."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = SamePaddedConv2d(3, STEM_CHANNELS, 3, 2)
        self.blocks = nn.ModuleList()
        channels = STEM_CHANNELS
        for kernel, stride, expansion, out_channels in BLOCKS:
            self.blocks.append(InvertedResidual(channels, kernel, stride, expansion, out_channels))
            channels = out_channels

    def forward(self, images: Tensor) -> list[Tensor]:
        """Images [n, 3, H, W] in [0, 1], H and W multiples of 16 -> maps [n, CHANNELS[i], H / STRIDES[i], ...]."""
        x = F.relu6(self.stem((images - MEAN) / STD))
        maps = []
        for index, block in enumerate(self.blocks):
            x = block(x)
            if index in OUT_INDICES:
                maps.append(x)
        return maps


def fold_batch_norms(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The published state dict -> that of `EfficientNetLite0`: each convolution times the normalisation behind it."""
    folded = {}
    convolutions = {"stem": ("_conv_stem", "_bn0")}
    for index in range(len(BLOCKS)):
        theirs = f"_blocks.{index}."
        for name, convolution, norm in (
            ("expand", "_expand_conv", "_bn0"),
            ("depthwise", "_depthwise_conv", "_bn1"),
            ("project", "_project_conv", "_bn2"),
        ):
            if f"{theirs}{convolution}.weight" in tensors:
                convolutions[f"blocks.{index}.{name}"] = theirs + convolution, theirs + norm
    for name, (convolution, norm) in convolutions.items():
        scale = tensors[f"{norm}.weight"] / torch.sqrt(tensors[f"{norm}.running_var"] + BATCH_NORM_EPSILON)
        folded[f"{name}.weight"] = tensors[f"{convolution}.weight"] * scale[:, None, None, None]
        folded[f"{name}.bias"] = tensors[f"{norm}.bias"] - tensors[f"{norm}.running_mean"] * scale
    return folded
