"""IDESplat's presets: the released networks, and smaller ones for CPUs that are trained from scratch."""

from dataclasses import replace

from ..config import DPTConfig, UNetConfig, ViTConfig
from .config import DPBUConfig, FocusConfig, IDESplatConfig, PhotoConfig

# Every part in small, for CPUs: 3.0 million parameters, trained from scratch, the ViT along.
_TINY = IDESplatConfig(
    backbone_channels=(24, 32, 48),
    feature_channels=48,
    transformer_layers=4,
    transformer_ffn_ratio=2,
    # Sixteen windows: at 256x256 they are 16 tokens a side, four times less work than with the releases' four.
    attention_splits=4,
    vit=ViTConfig(dim=96, depth=4, heads=3, grid=18, out_indices=(0, 1, 2, 3)),
    dpt=DPTConfig(features=32, channels=(24, 48, 96, 96), disparity_channels=16),
    dpbus=(
        DPBUConfig(channels=64, candidates=97, scale=1, unet=UNetConfig(channels=40, levels=3)),
        DPBUConfig(channels=32, candidates=25, scale=2, unet=UNetConfig(channels=16, levels=4)),
        DPBUConfig(channels=8, candidates=9, scale=4, unet=UNetConfig(channels=8, levels=5)),
    ),
    residual_unet=UNetConfig(channels=8, levels=5),
    focus=FocusConfig(channels=48, window=8, topk=(64, 64, 32, 32)),
    # Procedural surfaces hardly shine: bands above the first would learn little, and double the .ply file.
    sh_degree=1,
    scale_in_pixels=True,
    # Training makes splats at a picture's border as large as they may be, to cover what no view sees; in views
    # between, they cover what another photograph shows.
    scale_max=1.5,
    # Its scenes have the unit in which near is 1, and far lies between 2 and 200.
    near=1.0,
    trained_views=(2, 3),
    other_sides=(128,),
)
# The same with a Gaussian head that is shown what other views see at a pixel's place.
_TINY_CROSS_VIEW = replace(_TINY, cross_view_channels=16)
# That on photographic features, and without maps of many pixels and few channels: 2.5 million parameters, and 0.7
# million of EfficientNet-Lite0.
_LITE = replace(
    _TINY_CROSS_VIEW,
    photo=PhotoConfig(),
    dpbus=(
        *_TINY.dpbus[:2],
        DPBUConfig(channels=8, candidates=9, scale=4, unet=UNetConfig(channels=16, levels=4, shuffle=2)),
    ),
    residual_unet=UNetConfig(channels=16, levels=4, shuffle=2),
    trained_views=(2, 4),
)

PRESETS = {
    "idesplat-re10k": IDESplatConfig(),
    "idesplat-acid": IDESplatConfig(),
    "idesplat-dl3dv": IDESplatConfig(feature_stride=8, far=200.0, height=256, width=448, trained_views=(2, 6)),
    "idesplat-tiny": _TINY,
    "idesplat-tiny-cross-view": _TINY_CROSS_VIEW,
    "idesplat-lite": _LITE,
}
