"""Small DepthSplat networks."""

from dataclasses import replace

from idesplat.model.config import UNetConfig, ViTConfig
from idesplat.model.depthsplat.config import DepthScaleConfig, DepthSplatConfig, UpsamplerConfig

VIT = ViTConfig(dim=48, depth=4, heads=2, out_indices=(0, 1, 2, 3))


SMALL = DepthSplatConfig(
    backbone_channels=(8, 16, 16),
    feature_channels=16,
    transformer_layers=2,
    vit=VIT,
    scales=(
        DepthScaleConfig(candidates=16, unet=UNetConfig(16, levels=3, heads=2)),
        DepthScaleConfig(candidates=8, unet=UNetConfig(8, levels=4, heads=2)),
    ),
    upsampler=UpsamplerConfig(channels=(8, 12, 16, 20), depth_features=8, features=12),
    regressor_channels=8,
)


ONE_SCALE = replace(SMALL, scales=SMALL.scales[:1])
