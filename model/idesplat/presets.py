"""IDESplat's presets: the released networks, and smaller ones for CPUs that are trained from scratch."""

from dataclasses import replace

from ..config import DPTConfig, UNetConfig, ViTConfig
from .config import DPBUConfig, FocusConfig, IDESplatConfig, PhotoConfig

# Every part at a small size, for CPUs: 3.0 million parameters, trained from scratch including the ViT.
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
    # Synthetic surfaces are almost diffuse: SH degrees above 1 would learn little, and double the .ply file.
    sh_degree=1,
    scale_in_pixels=True,
    # Training makes Gaussians at the image border as large as this allows, to cover what no view sees. From views in
    # between they would occlude what another view shows.
    scale_max=1.5,
    # Its training scenes are scaled so that near is 1; far is then between 2 and 200.
    near=1.0,
    trained_views=(2, 3),
    other_sides=(128,),
)
# With a head that compares each pixel with its projections in other views.
_TINY_CROSS_VIEW = replace(_TINY, cross_view_channels=16)
# With EfficientNet-Lite0 features in place of the ViT, as many channels as the ViT has: 2.3 million parameters, and 0.7
# million of EfficientNet-Lite0. All other parts are those of _TINY_CROSS_VIEW, so that its weights are a start. One in
# twenty of its scenes has four views; in use, groups of three are better.
_LITE = replace(_TINY_CROSS_VIEW, photo=PhotoConfig(channels=_TINY.vit.dim))
# With scales and rotations in the surface's frame. No other tensor differs, so that weights of _LITE are a start.
_LITE_SURFACE = replace(_LITE, surface_frame=True)

PRESETS = {
    "idesplat-re10k": IDESplatConfig(),
    "idesplat-acid": IDESplatConfig(),
    "idesplat-dl3dv": IDESplatConfig(feature_stride=8, far=200.0, height=256, width=448, trained_views=(2, 6)),
    "idesplat-tiny": _TINY,
    "idesplat-tiny-cross-view": _TINY_CROSS_VIEW,
    "idesplat-lite": _LITE,
    "idesplat-lite-surface": _LITE_SURFACE,
}
