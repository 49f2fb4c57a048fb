"""What is known of the views before any depth: features of a CNN, of matching across views, and of a ViT."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from ..config import DepthSplatConfig, EncoderConfig, IDESplatConfig
from .backbone import Backbone
from .dinov2 import DinoV2
from .dpt import DPTHead
from .geometry import nearest_views
from .layers import resize
from .mv_transformer import MultiViewTransformer
from .photographic_branch import PhotoBranch

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
# Image size over that of the ViT's maps as DepthSplat uses them.
MONO_STRIDE = 8


class EncoderFeatures(NamedTuple):
    """IDESplat's encoder's maps; h and w are the image's size over the feature stride."""

    neighbours: Tensor  # [views, n], the views that each is matched with
    features_cnn: Tensor  # [views, feature channels, h, w]
    features_cnn_fine: Tensor  # [views, cnn channels, 2h, 2w]
    features_mv: Tensor  # [views, feature channels, h, w]
    features_mono: Tensor  # [views, ViT channels, h, w]
    mono_out: Tensor  # [views, DPT channels, 8 * patch rows, 8 * patch columns]; of photographic features h, w
    mono_disparity: Tensor  # [views, 1, h, w], relative


class PyramidFeatures(NamedTuple):
    """DepthSplat's encoder's maps; h and w are the image's size over the feature stride."""

    neighbours: Tensor  # [views, n], the views that each is matched with
    features_cnn: Tensor  # [views, feature channels, h, w]
    features_cnn_fine: Tensor  # [views, middle channels, 2h, 2w]
    features_cnn_finest: Tensor  # [views, fine channels, H / 2, W / 2]
    features_mv: Tensor  # [views, feature channels, h, w]
    features_mono: Tensor  # [views, ViT channels, h, w]
    # The four tapped blocks, each [views, ViT channels, patch rows, patch columns].
    mono_1: Tensor
    mono_2: Tensor
    mono_3: Tensor
    mono_4: Tensor


class ViewEncoder(nn.Module):
    """What both networks' encoders share: CNN pyramid, multi-view transformer and ViT."""

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        self.neighbours = config.neighbours
        self.backbone = Backbone(config.backbone_channels, config.feature_channels, config.feature_stride)
        self.transformer = MultiViewTransformer(
            config.feature_channels, config.transformer_layers, config.transformer_ffn_ratio, config.attention_splits
        )
        self.vit: DinoV2 | None = None

    def mono_maps(self, images: Tensor) -> list[Tensor]:
        """Normalised images -> the four tapped maps of the ViT, [views, ViT channels, patch rows, patch columns]."""
        assert self.vit is not None
        patch = self.vit.config.patch
        rows, columns = images.shape[2] // patch, images.shape[3] // patch
        return self.vit(resize(images, rows * patch, columns * patch))


class Encoder(ViewEncoder):
    """IDESplat's: Depth Anything V2 is the monocular branch, with its head, or else photographic features."""

    def __init__(self, config: IDESplatConfig) -> None:
        super().__init__(config)
        self.photo = PhotoBranch(config.photo) if config.photo is not None else None
        if self.photo is None:
            self.vit = DinoV2(config.vit)
            self.dpt = DPTHead(config.vit.dim, config.vit.patch, config.dpt)

    def forward(self, images: Tensor, extrinsics: Tensor) -> EncoderFeatures:
        """Images [views, 3, H, W] in [0, 1], extrinsics [views, 4, 4] -> the encoder's maps."""
        neighbours = nearest_views(extrinsics, self.neighbours)
        normalised = normalise(images)
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


class PyramidEncoder(ViewEncoder):
    """DepthSplat's: it hands on the maps of every resolution, for upsampling what is predicted."""

    def __init__(self, config: DepthSplatConfig) -> None:
        super().__init__(config)
        self.vit = DinoV2(config.vit)
        # The releases bring the ViT's maps to this stride first, and from there to a finer feature stride.
        self.growth = MONO_STRIDE // config.feature_stride

    def forward(self, images: Tensor, extrinsics: Tensor) -> PyramidFeatures:
        """Images [views, 3, H, W] in [0, 1], extrinsics [views, 4, 4] -> the encoder's maps."""
        neighbours = nearest_views(extrinsics, self.neighbours)
        images = normalise(images)
        cnn, cnn_fine, cnn_finest = self.backbone(images)
        mv = self.transformer(cnn, neighbours)
        maps = self.mono_maps(images)
        mono = resize(maps[-1], images.shape[2] // MONO_STRIDE, images.shape[3] // MONO_STRIDE)
        if self.growth > 1:
            mono = resize(mono, *cnn.shape[2:])
        return PyramidFeatures(neighbours, cnn, cnn_fine, cnn_finest, mv, mono, *maps)


def normalise(images: Tensor) -> Tensor:
    """RGB in [0, 1] -> ImageNet's mean and deviation, [views, 3, H, W]."""
    mean = torch.tensor(IMAGENET_MEAN, dtype=images.dtype, device=images.device)[:, None, None]
    std = torch.tensor(IMAGENET_STD, dtype=images.dtype, device=images.device)[:, None, None]
    return (images - mean) / std
