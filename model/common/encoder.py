"""What the encoders share: a CNN pyramid, the multi-view transformer, and the ViT's maps."""

import torch
from torch import Tensor, nn

from ..config import EncoderConfig
from .backbone import Backbone
from .dinov2 import DinoV2
from .layers import resize
from .mv_transformer import MultiViewTransformer

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


class ViewEncoder(nn.Module):
    """CNN pyramid, multi-view transformer and, where a family adds it, the ViT."""

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        self.neighbours = config.neighbours
        self.backbone = Backbone(config.backbone_channels, config.feature_channels, config.feature_stride)
        self.transformer = MultiViewTransformer(
            config.feature_channels, config.transformer_layers, config.transformer_ffn_ratio, config.attention_splits
        )
        self.vit: DinoV2 | None = None

    def mono_maps(self, images: Tensor) -> list[Tensor]:
        """Normalised images -> the ViT's maps at `out_indices`, [views, ViT channels, patch rows, patch columns]."""
        assert self.vit is not None
        patch = self.vit.config.patch
        rows, columns = images.shape[2] // patch, images.shape[3] // patch
        return self.vit(resize(images, rows * patch, columns * patch))


def normalize_images(images: Tensor) -> Tensor:
    """RGB in [0, 1] -> normalised by ImageNet's mean and standard deviation, [views, 3, H, W]."""
    mean = torch.tensor(IMAGENET_MEAN, dtype=images.dtype, device=images.device)[:, None, None]
    std = torch.tensor(IMAGENET_STD, dtype=images.dtype, device=images.device)[:, None, None]
    return (images - mean) / std
