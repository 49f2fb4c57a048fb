"""IDESplat's encoder: CNN and matching features, and a monocular branch with its relative disparity."""

from collections.abc import Callable
from typing import NamedTuple

from torch import Tensor

from ..common.dinov2 import DinoV2
from ..common.dpt import DPTHead
from ..common.encoder import ViewEncoder, normalize_images
from ..common.geometry import nearest_views
from ..common.layers import resize
from .config import IDESplatConfig
from .photographic_branch import PhotoBranch


class EncoderFeatures(NamedTuple):
    """What the encoder returns; h and w are the image's size over the feature stride."""

    neighbours: Tensor  # [views, n], the views that each is matched with
    features_cnn: Tensor  # [views, feature channels, h, w]
    features_cnn_fine: Tensor  # [views, cnn channels, 2h, 2w]
    features_mv: Tensor  # [views, feature channels, h, w]
    features_mono: Tensor  # [views, ViT channels, h, w]
    mono_out: Tensor  # [views, DPT channels, 8 * patch rows, 8 * patch columns]; without the ViT h, w
    mono_disparity: Tensor  # [views, 1, h, w], relative


class Encoder(ViewEncoder):
    """Its monocular branch is Depth Anything V2 with its DPT head, or EfficientNet-Lite0 (photographic_branch.py)."""

    def __init__(self, config: IDESplatConfig) -> None:
        super().__init__(config)
        # Replaced in training, where the views can be of several scenes.
        self.nearest_views: Callable[[Tensor, int], Tensor] = nearest_views
        self.photo = PhotoBranch(config.photo) if config.photo is not None else None
        if self.photo is None:
            self.vit = DinoV2(config.vit)
            self.dpt = DPTHead(config.vit.dim, config.vit.patch, config.dpt)

    def forward(self, images: Tensor, extrinsics: Tensor) -> EncoderFeatures:
        """Images [views, 3, H, W] in [0, 1], extrinsics [views, 4, 4] -> the encoder's features."""
        neighbours = self.nearest_views(extrinsics, self.neighbours)
        normalised = normalize_images(images)
        cnn, cnn_fine, _ = self.backbone(normalised)
        mv = self.transformer(cnn, neighbours)
        size = cnn.shape[2:]
        if self.photo is not None:
            mono, mono_out, disparity = self.photo(images)
        else:
            maps = self.mono_maps(normalised)
            mono, mono_out = maps[-1], self.dpt.features(maps)
            disparity = self.dpt.disparity(mono_out, *mono.shape[2:])
        return EncoderFeatures(neighbours, cnn, cnn_fine, mv, resize(mono, *size), mono_out, resize(disparity, *size))
