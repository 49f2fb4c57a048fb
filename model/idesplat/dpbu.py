"""Depth probability boosting units (DPBUs): epipolar attention layers whose probabilities multiply.

IDESplat, section 2. Over the M = 2 layers of a DPBU, with A_m the depth probability of layer m,

    P_0 = 1,    P_m = Norm(P_{m-1} * A_m),

so that candidates on which the layers agree gain probability. Norm makes the candidates' probabilities sum to one. The
expected inverse depth is sum_m P(x, m) d_m.

Section 3: three DPBUs run from coarse to fine, at twice the resolution each time, with candidates in a narrower range
around the inverse depth of the DPBU before. (The paper adds an expected offset to that inverse depth. The released
code, and this, takes the expectation over absolute inverse depths: the same where the probabilities sum to one.)
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from ..common.geometry import Cameras, denormalize_intrinsics, warp_indices
from ..common.layers import ConcatConv1x1, Upsample2x, resize, static_dim
from .config import DPBUConfig, IDESplatConfig
from .encoder import EncoderFeatures
from .epipolar_attention import EpipolarAttention


class DPBUOutput(NamedTuple):
    """What a DPBU returns."""

    features: Tensor  # [views, channels, h, w] after the attention
    context: Tensor  # [views, context channels, h, w] before it, upsampled from DPBU to DPBU
    inverse_depth_first: Tensor  # [views, 1, h, w] after the first layer alone
    inverse_depth: Tensor  # [views, 1, h, w]
    probability: Tensor  # [views, candidates, h, w], mean over the neighbours
    candidates: Tensor  # [views, candidates, h, w] inverse depths


class DPBU(nn.Module):
    """A depth probability boosting unit: the part that all three share."""

    def __init__(self, config: IDESplatConfig, unit: DPBUConfig) -> None:
        super().__init__()
        self.candidates = unit.candidates
        self.first = EpipolarAttention(config, unit)
        self.second = EpipolarAttention(config, unit)

    def boost(
        self,
        features: Tensor,
        context: Tensor,
        coarse_inverse_depth: Tensor,
        candidates: Tensor,
        neighbours: Tensor,
        cameras: Cameras,
    ) -> DPBUOutput:
        """Run two WIEA layers over the same warp indices.

        features: [views, channels, h, w]. context: passed on. coarse_inverse_depth: [views, 1, h, w].
        candidates: inverse depths, [views, candidates, h, w]. neighbours: [views, n].
        """
        height, width = features.shape[2:]
        pixels = denormalize_intrinsics(cameras.intrinsics, width, height)
        rows = warp_indices(candidates, pixels, cameras.extrinsics, neighbours)
        features, prior = self.first(features, coarse_inverse_depth, rows, None)
        first_depth, _ = expectation(prior, candidates)
        features, posterior = self.second(features, first_depth, rows, prior)
        inverse_depth, probability = expectation(posterior, candidates)
        return DPBUOutput(features, context, first_depth, inverse_depth, probability, candidates)


class CoarseDPBU(DPBU):
    """The first DPBU: candidates over the whole range; its coarse inverse depth is the monocular disparity."""

    def __init__(self, config: IDESplatConfig, unit: DPBUConfig) -> None:
        super().__init__(config, unit)
        parts = (config.feature_channels, config.feature_channels, *config.mono_channels)
        self.merge = ConcatConv1x1(parts, unit.channels)

    def forward(self, encoded: EncoderFeatures, cameras: Cameras) -> DPBUOutput:
        """Encoder features -> features and inverse depth at the encoder's resolution."""
        size = encoded.features_cnn.shape[2:]
        at_size = [encoded.features_cnn, encoded.features_mv, encoded.features_mono]
        context = self.merge(at_size, [encoded.mono_out], *size)
        farthest, nearest = cameras.inverse_range()
        steps = torch.linspace(0, 1, self.candidates, dtype=context.dtype, device=context.device)[None, :, None, None]
        candidates = (farthest + steps * (nearest - farthest)).expand(-1, -1, *size)
        return self.boost(context, context, encoded.mono_disparity, candidates, encoded.neighbours, cameras)


class RefinementDPBU(DPBU):
    """The second or third DPBU: twice the resolution, candidates around the inverse depth of the DPBU before."""

    def __init__(self, config: IDESplatConfig, unit: DPBUConfig, before: DPBUConfig, context: int) -> None:
        """before: the previous DPBU's configuration. context: the channels of its context."""
        super().__init__(config, unit)
        # Intervals of the candidates' spacing in the whole range: the coarse DPBU's, divided by the scale.
        self.intervals = (config.dpbus[0].candidates - 1) * unit.scale
        self.upsample_features = Upsample2x(before.channels)
        self.upsample_context = Upsample2x(context)
        # The CNN has a map at the second DPBU's resolution; the third upsamples it.
        cnn = config.backbone_channels[1]
        self.upsample_cnn = Upsample2x(cnn) if unit.scale > 2 else nn.Identity()
        cnn = cnn // 2 if unit.scale > 2 else cnn
        self.merge = ConcatConv1x1((before.channels // 2, context // 2, cnn, *config.mono_channels), unit.channels)

    def forward(self, encoded: EncoderFeatures, before: DPBUOutput, cameras: Cameras) -> DPBUOutput:
        """Encoder features and the DPBU before -> features and inverse depth at twice its resolution."""
        context = self.upsample_context(before.context)
        size = context.shape[2:]
        at_size = [self.upsample_features(before.features), context, self.upsample_cnn(encoded.features_cnn_fine)]
        features = self.merge(at_size, [encoded.features_mono, encoded.mono_out], *size)
        coarse_inverse_depth = resize(before.inverse_depth, *size)
        candidates = self.candidates_around(coarse_inverse_depth, cameras)
        return self.boost(features, context, coarse_inverse_depth, candidates, encoded.neighbours, cameras)

    def candidates_around(self, coarse_inverse_depth: Tensor, cameras: Cameras) -> Tensor:
        """Evenly spaced candidates [views, candidates, h, w] around the coarse inverse depth, in the depth range."""
        farthest, nearest = cameras.inverse_range()
        half = (self.candidates - 1) / 2
        reach = (nearest - farthest) / self.intervals * half
        low = torch.maximum(coarse_inverse_depth - reach, farthest)
        high = torch.minimum(coarse_inverse_depth + reach, nearest)
        steps = torch.linspace(
            -half, half, self.candidates, dtype=coarse_inverse_depth.dtype, device=coarse_inverse_depth.device
        )[None, :, None, None]
        return (low + high) / 2 + steps * ((high - low) / (self.candidates - 1))


def expectation(probability: Tensor, candidates: Tensor) -> tuple[Tensor, Tensor]:
    """Expected inverse depth [views, 1, h, w] and mean probability over the neighbours, [views, candidates, h, w].

    probability: [pairs, candidates, h * w]. candidates: inverse depths, [views, candidates, h, w].
    """
    views, _, height, width = candidates.shape
    count = static_dim(candidates.shape[1])
    probability = probability.reshape(views, -1, count, height * width).mean(1).reshape(-1, count, height, width)
    return (probability * candidates).sum(1, keepdim=True), probability
