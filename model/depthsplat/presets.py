"""DepthSplat's presets: the released networks, with and without Gaussians."""

from dataclasses import replace

from ..config import UNetConfig, ViTConfig
from .config import DepthScaleConfig, DepthSplatConfig, UpsamplerConfig

TWO_SCALES = (
    DepthScaleConfig(candidates=128, unet=UNetConfig(channels=128, levels=3, heads=4)),
    DepthScaleConfig(candidates=32, unet=UNetConfig(channels=64, levels=4, heads=2)),
)
VIT_BASE = ViTConfig(dim=768, heads=12)
VIT_LARGE = ViTConfig(dim=1024, depth=24, heads=16, out_indices=(4, 11, 17, 23))
UPSAMPLER_BASE = UpsamplerConfig(channels=(96, 192, 384, 768), depth_features=48, features=96)
UPSAMPLER_LARGE = UpsamplerConfig(channels=(128, 256, 512, 1024), depth_features=64, features=128)

_SMALL = DepthSplatConfig()
_SMALL_8 = replace(_SMALL, feature_stride=8)
_BASE = DepthSplatConfig(scales=TWO_SCALES, vit=VIT_BASE, upsampler=UPSAMPLER_BASE)
_BASE_8 = replace(_BASE, feature_stride=8)
_LARGE = DepthSplatConfig(scales=TWO_SCALES, vit=VIT_LARGE, upsampler=UPSAMPLER_LARGE)

PRESETS = {
    "depthsplat-small-re10k": _SMALL,
    "depthsplat-base-re10k": _BASE,
    "depthsplat-large-re10k": _LARGE,
    "depthsplat-base-re10k-256x448": replace(_BASE_8, height=256, width=448),
    "depthsplat-base-dl3dv": replace(_BASE_8, far=200.0, height=256, width=448, trained_views=(2, 6)),
    "depthsplat-small-re10kdl3dv": replace(
        _SMALL_8, far=200.0, scale_max=0.1, height=448, width=768, trained_views=(4, 10)
    ),
    "depthsplat-base-re10kdl3dv": replace(
        _BASE_8, far=200.0, scale_max=0.1, height=448, width=768, trained_views=(2, 6)
    ),
    "depthsplat-depth-small": replace(_SMALL_8, gaussians=False, height=352, width=640, trained_views=(2, 8)),
    "depthsplat-depth-base": replace(_BASE_8, gaussians=False, height=352, width=640, trained_views=(2, 8)),
}
