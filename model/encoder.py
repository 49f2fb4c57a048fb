"""What is known of the views before any depth: matching features, monocular features and relative disparity."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from .backbone import Backbone
from .config import IDESplatConfig
from .dinov2 import DinoV2
from .dpt import DPTHead
from .geometry import nearest_views
from .layers import resize
from .mv_transformer import MultiViewTransformer

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


class Encoded(NamedTuple):
    """The encoder's maps; h and w are the image's size over the feature stride."""

    neighbours: Tensor  # [views, n], the views that each is matched with
    features_cnn: Tensor  # [views, feature channels, h, w]
    features_cnn_fine: Tensor  # [views, cnn channels, 2h, 2w]
    features_mv: Tensor  # [views, feature channels, h, w]
    features_mono: Tensor  # [views, ViT channels, h, w]
    mono_out: Tensor  # [views, DPT channels, 8 * patch rows, 8 * patch columns]
    mono_disparity: Tensor  # [views, 1, h, w], relative


class Encoder(nn.Module):
    """CNN pyramid, multi-view transformer, and Depth Anything V2 as the monocular branch."""

    def __init__(self, config: IDESplatConfig) -> None:
        super().__init__()
        self.config = config
        self.backbone = Backbone(config.backbone_channels, config.feature_channels, config.feature_stride)
        self.transformer = MultiViewTransformer(
            config.feature_channels, config.transformer_layers, config.transformer_ffn_ratio, config.attention_splits
        )
        self.vit = DinoV2(config.vit)
        self.dpt = DPTHead(config.vit.dim, config.vit.patch, config.dpt)

    def forward(self, images: Tensor, extrinsics: Tensor) -> Encoded:
        """Images [views, 3, H, W] in [0, 1], extrinsics [views, 4, 4] -> the encoder's maps."""
        neighbours = nearest_views(extrinsics, self.config.neighbours)
        images = normalise(images)
        cnn, cnn_fine = self.backbone(images)
        mv = self.transformer(cnn, neighbours)

        patch = self.config.vit.patch
        rows, columns = images.shape[2] // patch, images.shape[3] // patch
        maps = self.vit(resize(images, rows * patch, columns * patch))
        mono_out = self.dpt.features(maps)
        size = cnn.shape[2:]
        disparity = resize(self.dpt.disparity(mono_out, rows, columns), *size)
        return Encoded(neighbours, cnn, cnn_fine, mv, resize(maps[-1], *size), mono_out, disparity)


def normalise(images: Tensor) -> Tensor:
    """RGB in [0, 1] -> ImageNet's mean and deviation, [views, 3, H, W]."""
    mean = torch.tensor(IMAGENET_MEAN, dtype=images.dtype, device=images.device)[:, None, None]
    std = torch.tensor(IMAGENET_STD, dtype=images.dtype, device=images.device)[:, None, None]
    return (images - mean) / std
