"""DepthSplat's depth at one scale: cost volume, U-Net regularisation, and the expected inverse depth.

With probabilities P over candidate inverse depths w_m, the inverse depth is sum_m P(x, m) w_m.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..common.gather_attention import GatherAttention
from ..common.geometry import Cameras
from ..common.layers import Upsample2x, resize, softmax
from ..common.unet import CostRegulariser
from .config import DepthSplatConfig
from .cost_volume import CORNERS, cost_volume
from .encoder import PyramidFeatures
from .upsampler import DepthUpsampler


class DepthStageOutput(NamedTuple):
    """What a scale returns."""

    features_mv: Tensor  # [views, channels, h, w], the matching features at its resolution
    inverse_depth: Tensor  # [views, 1, h, w]
    probability: Tensor  # [views, candidates, h, w]
    # At image size: bilinear and, at the last scale, corrected by the learned upsampler: [views, 1, H, W].
    inverse_depth_full: Tensor


class DepthOutput(NamedTuple):
    """The output of the depth-only network, and the scale that it comes from."""

    depth: Tensor  # [views, H, W], metric z-depth
    scale: DepthStageOutput

    def named_outputs(self) -> dict[str, Tensor]:
        """The network's output as exported graphs name it."""
        return {"depth": self.depth}


class DepthStage(nn.Module):
    """The part that both scales share."""

    def __init__(self, config: DepthSplatConfig, scale: int) -> None:
        super().__init__()
        unet = config.scales[scale].unet
        self.candidates = config.scales[scale].candidates
        self.stride = config.feature_stride // 2**scale
        cnn = (config.feature_channels, config.backbone_channels[1])[scale]
        matching = config.feature_channels // 2**scale
        self.gather_attention = GatherAttention(CORNERS * self.candidates * matching, config.smallest_map(2**scale))
        inputs = self.candidates + cnn + matching + config.vit.dim // 2**scale
        self.regulariser = CostRegulariser(inputs, unet.channels, unet)
        self.shortcut = nn.Conv2d(inputs, unet.channels, 1)
        self.head1 = nn.Conv2d(unet.channels, 2 * unet.channels, 3, padding=1, padding_mode="replicate")
        self.head2 = nn.Conv2d(2 * unet.channels, self.candidates, 3, padding=1, padding_mode="replicate")
        self.upsampler = DepthUpsampler(config) if scale == len(config.scales) - 1 else None

    def match(
        self, cnn: Tensor, mv: Tensor, mono: Tensor, candidates: Tensor, cameras: Cameras, neighbours: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Features and candidate inverse depths [views, candidates, h, w] -> inverse depth and probability.

        cnn, mv, mono: maps [views, channels, h, w] of CNN, multi-view transformer and ViT. neighbours: [views, n].
        """
        costs = cost_volume(mv, candidates, cameras, neighbours, self.gather_attention)
        known = torch.cat([costs, cnn, mv, mono], dim=1)
        regular = self.regulariser.scores(known, known.shape[0]) + self.shortcut(known)
        probability = softmax(self.head2(F.gelu(self.head1(regular))), dim=1)
        return (probability * candidates).sum(1, keepdim=True), probability

    def at_image_size(
        self, inverse_depth: Tensor, encoded: PyramidFeatures, features_mv: list[Tensor], cameras: Cameras
    ) -> Tensor:
        """Inverse depth [views, 1, h, w] -> [views, 1, H, W]."""
        height, width = inverse_depth.shape[2:]
        full = resize(inverse_depth, height * self.stride, width * self.stride)
        if self.upsampler is None:
            return full
        farthest, nearest = cameras.inverse_range()
        residual = self.upsampler(encoded, [*features_mv, inverse_depth])
        return torch.minimum(torch.maximum(full + residual, farthest), nearest)


class CoarseDepth(DepthStage):
    """The first scale: candidates over the whole range."""

    def __init__(self, config: DepthSplatConfig) -> None:
        super().__init__(config, scale=0)

    def forward(self, encoded: PyramidFeatures, cameras: Cameras) -> DepthStageOutput:
        """Encoder features -> inverse depth at the encoder's resolution."""
        mv = encoded.features_mv
        farthest, nearest = cameras.inverse_range()
        steps = torch.linspace(0, 1, self.candidates, dtype=mv.dtype, device=mv.device)[None, :, None, None]
        candidates = (farthest + steps * (nearest - farthest)).expand(-1, -1, *mv.shape[2:])
        inverse_depth, probability = self.match(
            encoded.features_cnn, mv, encoded.features_mono, candidates, cameras, encoded.neighbours
        )
        full = self.at_image_size(inverse_depth, encoded, [mv], cameras)
        return DepthStageOutput(mv, inverse_depth, probability, full)


class FineDepth(DepthStage):
    """The second scale: twice the resolution, candidates around the inverse depth of the first."""

    def __init__(self, config: DepthSplatConfig) -> None:
        super().__init__(config, scale=1)
        # Twice the first scale's number of intervals in the whole range: this scale's are half as wide.
        self.intervals = 2 * (config.scales[0].candidates - 1)
        self.upsample_mv = Upsample2x(config.feature_channels)
        self.upsample_mono = Upsample2x(config.vit.dim)

    def forward(self, encoded: PyramidFeatures, before: DepthStageOutput, cameras: Cameras) -> DepthStageOutput:
        """Encoder features and the first scale -> inverse depth at twice its resolution."""
        mv = self.upsample_mv(encoded.features_mv)
        # As in the releases, no gradient flows through the candidates to the scale before.
        coarse_inverse_depth = resize(before.inverse_depth, *mv.shape[2:]).detach()
        candidates = self.candidates_around(coarse_inverse_depth, cameras)
        mono = self.upsample_mono(encoded.features_mono)
        inverse_depth, probability = self.match(
            encoded.features_cnn_fine, mv, mono, candidates, cameras, encoded.neighbours
        )
        full = self.at_image_size(inverse_depth, encoded, [encoded.features_mv, mv], cameras)
        return DepthStageOutput(mv, inverse_depth, probability, full)

    def candidates_around(self, coarse_inverse_depth: Tensor, cameras: Cameras) -> Tensor:
        """Evenly spaced candidates [views, candidates, h, w] around the coarse inverse depth, in the depth range."""
        farthest, nearest = cameras.inverse_range()
        interval = (nearest - farthest) / self.intervals
        half = self.candidates // 2
        low = torch.maximum(coarse_inverse_depth - interval * half, farthest)
        high = torch.minimum(coarse_inverse_depth + interval * (half - 1), nearest)
        steps = torch.linspace(
            0, 1, self.candidates, dtype=coarse_inverse_depth.dtype, device=coarse_inverse_depth.device
        )[None, :, None, None]
        return low + steps * (high - low)
