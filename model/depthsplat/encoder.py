"""DepthSplat's encoder: CNN, matching and ViT features, with the maps that its upsamplers read."""

from typing import NamedTuple

from torch import Tensor

from ..common.dinov2 import DinoV2
from ..common.encoder import ViewEncoder, normalize_images
from ..common.geometry import nearest_views
from ..common.layers import resize
from .config import DepthSplatConfig

# Image size over that of the ViT's maps as DepthSplat uses them.
MONO_STRIDE = 8


class PyramidFeatures(NamedTuple):
    """What the encoder returns; h and w are the image's size over the feature stride."""

    neighbours: Tensor  # [views, n], the views that each is matched with
    features_cnn: Tensor  # [views, feature channels, h, w]
    features_cnn_fine: Tensor  # [views, middle channels, 2h, 2w]
    features_cnn_finest: Tensor  # [views, fine channels, H / 2, W / 2]
    features_mv: Tensor  # [views, feature channels, h, w]
    features_mono: Tensor  # [views, ViT channels, h, w]
    # The ViT's maps at `out_indices`, each [views, ViT channels, patch rows, patch columns].
    mono_1: Tensor
    mono_2: Tensor
    mono_3: Tensor
    mono_4: Tensor


class PyramidEncoder(ViewEncoder):
    """It returns the maps of every resolution, which the upsamplers of depth and features read."""

    def __init__(self, config: DepthSplatConfig) -> None:
        super().__init__(config)
        self.vit = DinoV2(config.vit)
        # The releases resize the ViT's maps to this stride first, and from there to a finer feature stride.
        self.upsampling = MONO_STRIDE // config.feature_stride

    def forward(self, images: Tensor, extrinsics: Tensor) -> PyramidFeatures:
        """Images [views, 3, H, W] in [0, 1], extrinsics [views, 4, 4] -> the encoder's features."""
        neighbours = nearest_views(extrinsics, self.neighbours)
        images = normalize_images(images)
        cnn, cnn_fine, cnn_finest = self.backbone(images)
        mv = self.transformer(cnn, neighbours)
        maps = self.mono_maps(images)
        mono = resize(maps[-1], images.shape[2] // MONO_STRIDE, images.shape[3] // MONO_STRIDE)
        if self.upsampling > 1:
            mono = resize(mono, *cnn.shape[2:])
        return PyramidFeatures(neighbours, cnn, cnn_fine, cnn_finest, mv, mono, *maps)
