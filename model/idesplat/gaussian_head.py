"""IDESplat's last stage: final depth, focused features, and each pixel's Gaussian.

The final inverse depth is a weighted sum of the three DPBUs' and a residual head's (released code, mv_unimatch.py):

    w = clamp(0.1 w_1 + 0.1 w_2 + 0.4 w_3 + 0.4 w_residual, 1 / far, 1 / near),

each resized bilinearly to the image, and depth = 1 / w.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..common.encoder import normalize_images
from ..common.gaussian_adapter import BASE_PARAMETERS, GaussianAdapter
from ..common.geometry import Cameras
from ..common.layers import resize
from ..common.outputs import ModelOutput
from ..common.unet import CostRegulariser
from .config import IDESplatConfig
from .cross_view import CHANNELS, cross_view_features
from .dpbu import DPBUOutput
from .encoder import EncoderFeatures
from .focused_attention import GaussianFocusedModule

# Of the three DPBUs' and the residual head's inverse depth.
INVERSE_DEPTH_WEIGHTS = (0.1, 0.1, 0.4, 0.4)
# Side of the pixel blocks that become channels (pixel unshuffle).
SHUFFLE = 4
# Feature channels per channel of conv_image.
IMAGE_CHANNEL_DIVISOR = 16


class HeadInputs(NamedTuple):
    """Inputs of the Gaussian head from earlier stages; h and w are the image's size over the feature stride."""

    inverse_depth: Tensor  # [views, 1, H, W], the final one
    features_cnn: Tensor  # [views, feature channels, h, w]
    context: Tensor  # [views, channels, h, w] of the first DPBU
    features_last: Tensor  # [views, channels, 4h, 4w] of the third DPBU
    neighbours: Tensor  # [views, n]


class CrossViewHead(nn.Module):
    """A correction of the raw parameters from the neighbouring views (cross_view.py); it starts at zero."""

    def __init__(self, channels: int, parameters: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(CHANNELS, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, parameters, 3, padding=1)
        nn.init.zeros_(self.conv2.weight)
        nn.init.zeros_(self.conv2.bias)  # type: ignore[arg-type]

    def forward(self, images: Tensor, cameras: Cameras, inputs: HeadInputs) -> Tensor:
        """Images [views, 3, H, W] in [0, 1] -> [views, parameters, H, W]."""
        compared = cross_view_features(images, inputs.inverse_depth, cameras, inputs.neighbours)
        return self.conv2(F.gelu(self.conv1(compared)))


class GaussianStage(nn.Module):
    """Residual depth head, depth fusion, Gaussian focused module, Gaussian head and adapter."""

    def __init__(self, config: IDESplatConfig) -> None:
        super().__init__()
        last, channels = config.dpbus[2], config.feature_channels
        self.residual = CostRegulariser(last.channels + last.candidates + 1, last.candidates, config.residual_unet)
        block = SHUFFLE**2
        image_channels = channels // IMAGE_CHANNEL_DIVISOR
        fused = (image_channels + last.channels + 1) * block + channels + config.dpbus[0].channels
        self.conv_image = nn.Conv2d(3, image_channels, 1)
        self.fuse = nn.Conv2d(fused, config.focus.channels, 1)
        self.focus = GaussianFocusedModule(config.focus, config.ffn_ratio, config.ffn_kernel)
        self.expand = nn.Conv2d(config.focus.channels, block * channels, 1)
        parameters = BASE_PARAMETERS + 3 * config.sh_coefficients
        self.head1 = nn.Conv2d(channels, parameters, 3, padding=1, padding_mode="replicate")
        self.head2 = nn.Conv2d(parameters, parameters, 3, padding=1, padding_mode="replicate")
        self.cross_view = CrossViewHead(config.cross_view_channels, parameters) if config.cross_view_channels else None
        self.adapter = GaussianAdapter(config)

    def forward(
        self,
        images: Tensor,
        cameras: Cameras,
        encoded: EncoderFeatures,
        dpbus: tuple[DPBUOutput, DPBUOutput, DPBUOutput],
    ) -> ModelOutput:
        """Images [views, 3, H, W] in [0, 1], and what the stages before returned -> depth and Gaussians."""
        return self.predict(images, cameras, self.head_inputs(images, cameras, encoded, dpbus))

    def head_inputs(
        self,
        images: Tensor,
        cameras: Cameras,
        encoded: EncoderFeatures,
        dpbus: tuple[DPBUOutput, DPBUOutput, DPBUOutput],
    ) -> HeadInputs:
        """Everything up to the final inverse depth, which stays constant while only the Gaussian head is trained."""
        inverse_depth = self.fused_inverse_depth(dpbus, cameras, *images.shape[2:])
        return HeadInputs(inverse_depth, encoded.features_cnn, dpbus[0].context, dpbus[2].features, encoded.neighbours)

    def predict(self, images: Tensor, cameras: Cameras, inputs: HeadInputs) -> ModelOutput:
        """Focused module, Gaussian head and adapter."""
        features = self.pixel_features(normalize_images(images), inputs)
        raw = self.head2(F.gelu(self.head1(features)))
        if self.cross_view is not None:
            raw = raw + self.cross_view(images, cameras, inputs)
        depth = 1 / inputs.inverse_depth[:, 0]
        return ModelOutput(depth, self.adapter(raw, depth, images, cameras), features, raw)

    def fused_inverse_depth(
        self, dpbus: tuple[DPBUOutput, DPBUOutput, DPBUOutput], cameras: Cameras, height: int, width: int
    ) -> Tensor:
        """The weighted sum of the DPBUs' and the residual head's inverse depth, clamped: [views, 1, height, width]."""
        last = dpbus[2]
        known = torch.cat([last.features, last.probability, last.inverse_depth], dim=1)
        probability = self.residual(known, last.features.shape[0])
        residual = (probability * last.candidates).sum(1, keepdim=True)
        maps = [*(dpbu.inverse_depth for dpbu in dpbus), residual]
        fused = torch.zeros_like(maps[0][:, :, :1, :1])
        for weight, x in zip(INVERSE_DEPTH_WEIGHTS, maps, strict=True):
            fused = fused + weight * resize(x, height, width)
        farthest, nearest = cameras.inverse_range()
        return torch.minimum(torch.maximum(fused, farthest), nearest)

    def pixel_features(self, images: Tensor, inputs: HeadInputs) -> Tensor:
        """The focused features of each pixel, [views, feature channels, H, W]; images are normalised."""
        size, full_size = inputs.features_cnn.shape[2:], images.shape[2:]
        parts = [
            resize(F.pixel_unshuffle(self.conv_image(images), SHUFFLE), *size),
            inputs.features_cnn,
            inputs.context,
            F.pixel_unshuffle(inputs.features_last, SHUFFLE),
            resize(F.pixel_unshuffle(inputs.inverse_depth, SHUFFLE), *size),
        ]
        focused = self.focus(self.fuse(torch.cat(parts, dim=1)))
        return resize(F.pixel_shuffle(self.expand(focused), SHUFFLE), *full_size)
