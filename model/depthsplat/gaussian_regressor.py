"""DepthSplat's last stage: each pixel's raw Gaussian parameters and Gaussian."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..common.gaussian_adapter import BASE_PARAMETERS, GaussianAdapter
from ..common.geometry import Cameras
from ..common.outputs import ModelOutput
from .config import DepthSplatConfig
from .depth_stage import DepthStageOutput
from .encoder import PyramidFeatures
from .upsampler import Upsampler


class GaussianRegressor(nn.Module):
    """Feature upsampler, regressor, Gaussian head and adapter."""

    def __init__(self, config: DepthSplatConfig) -> None:
        super().__init__()
        features, channels = config.upsampler.features, config.regressor_channels
        self.depth_stride = config.depth_stride
        self.upsampler = Upsampler(config, features)
        # Image, depth, the largest probability of a candidate (match confidence), features.
        self.regressor1 = nn.Conv2d(3 + 1 + 1 + features, channels, 3, padding=1)
        self.regressor2 = nn.Conv2d(channels, channels, 3, padding=1)
        parameters = BASE_PARAMETERS + 3 * config.sh_coefficients
        self.head1 = nn.Conv2d(channels + 3 + features + 1, parameters, 3, padding=1, padding_mode="replicate")
        self.head2 = nn.Conv2d(parameters, parameters, 3, padding=1, padding_mode="replicate")
        self.adapter = GaussianAdapter(config)

    def forward(
        self, images: Tensor, cameras: Cameras, encoded: PyramidFeatures, scales: tuple[DepthStageOutput, ...]
    ) -> ModelOutput:
        """Images [views, 3, H, W] in [0, 1], and what the stages before returned -> depth and Gaussians."""
        depth = 1 / scales[-1].inverse_depth_full
        features = self.upsampler(encoded, [scale.features_mv for scale in scales])
        certainty = scales[-1].probability.amax(1, keepdim=True)
        certainty = F.interpolate(certainty, scale_factor=float(self.depth_stride), mode="nearest")
        regressed = F.gelu(self.regressor1(torch.cat([images, depth, certainty, features], dim=1)))
        regressed = self.regressor2(regressed)
        raw = self.head2(F.gelu(self.head1(torch.cat([regressed, images, features, certainty], dim=1))))
        return ModelOutput(depth[:, 0], self.adapter(raw, depth[:, 0], images, cameras), features, raw)
