"""DepthSplat's upsamplers: DPT heads that concatenate CNN and matching features with the ViT's (dpt_head.py)."""

from collections.abc import Sequence
from typing import TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..common.dpt import DPT
from ..common.layers import resize
from .config import DepthSplatConfig
from .encoder import MONO_STRIDE, PyramidFeatures

# Image size over that of the three pyramid maps with which others are concatenated, finest first.
STRIDES = (2, 4, 8)
# Channels before the residual of the inverse depth.
RESIDUAL_CHANNELS = 16

T = TypeVar("T")


class Upsampler(DPT):
    """Encoder and matching features to features at image size."""

    def __init__(self, config: DepthSplatConfig, features: int, with_depth: bool = False) -> None:
        channels = config.upsampler.channels
        super().__init__(config.vit.dim, channels, features)
        fine, middle, _ = config.backbone_channels
        cnn_channels = (fine, middle, config.feature_channels)
        self.cnn_strides = (STRIDES[0], config.feature_stride // 2, config.feature_stride)
        scales = range(len(config.scales))
        joining = [config.feature_channels // 2**scale for scale in scales]
        self.joining_strides = [config.feature_stride // 2**scale for scale in scales]
        if with_depth:
            joining.append(1)
            self.joining_strides.append(config.depth_stride)
        self.merges = nn.ModuleList()
        for stride, count in zip(STRIDES, channels[:3], strict=True):
            joined = sum(_at(stride, cnn_channels, self.cnn_strides)) + sum(_at(stride, joining, self.joining_strides))
            self.merges.append(nn.Conv2d(joined + count, count, 1))

    def forward(self, encoded: PyramidFeatures, joining: list[Tensor]) -> Tensor:
        """Encoder features and further maps to concatenate -> [views, features, H, W].

        joining: the matching features of each scale and, for the depth upsampler, the last scale's inverse depth.
        """
        cnn = (encoded.features_cnn_finest, encoded.features_cnn_fine, encoded.features_cnn)
        factor = MONO_STRIDE // STRIDES[0]
        height, width = cnn[0].shape[2] // factor, cnn[0].shape[3] // factor
        mono = (encoded.mono_1, encoded.mono_2, encoded.mono_3, encoded.mono_4)
        # The releases resize before the 1x1 convolution; the two commute, and this order is less work.
        projected = [resize(project(x), height, width) for project, x in zip(self.projects, mono, strict=True)]
        pyramid = self.reassemble(*projected)
        for level, stride in enumerate(STRIDES):
            joined = _at(stride, joining, self.joining_strides)
            # Order of the released weights: the finest map comes last, the others before what is concatenated.
            parts = [*joined, pyramid[level]] if level == 0 else [pyramid[level], *joined]
            pyramid[level] = self.merges[level](torch.cat([*_at(stride, cnn, self.cnn_strides), *parts], dim=1))
        return self.fuse(pyramid)


class DepthUpsampler(Upsampler):
    """The learned residual of the bilinearly upsampled inverse depth."""

    def __init__(self, config: DepthSplatConfig) -> None:
        features = config.upsampler.depth_features
        super().__init__(config, features, with_depth=True)
        self.residual1 = nn.Conv2d(features, features // 2, 3, padding=1, padding_mode="replicate")
        self.residual2 = nn.Conv2d(features // 2, RESIDUAL_CHANNELS, 3, padding=1, padding_mode="replicate")
        self.residual3 = nn.Conv2d(RESIDUAL_CHANNELS, 1, 1)
        nn.init.zeros_(self.residual3.weight)
        nn.init.zeros_(self.residual3.bias)  # type: ignore[arg-type]

    def forward(self, encoded: PyramidFeatures, joining: list[Tensor]) -> Tensor:
        """As for `Upsampler` -> the residual of the inverse depth, [views, 1, H, W]."""
        x = F.gelu(self.residual1(super().forward(encoded, joining)))
        return self.residual3(F.gelu(self.residual2(x)))


def _at(stride: int, items: Sequence[T], strides: Sequence[int]) -> list[T]:
    """The items of one stride."""
    return [item for item, its_stride in zip(items, strides, strict=True) if its_stride == stride]
