"""Every size of the networks, as frozen configurations, and the presets of the released checkpoints."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class ViTConfig:
    """A DINOv2 vision transformer; the defaults are ViT-S, as in Depth Anything V2 small."""

    dim: int = 384
    depth: int = 12
    heads: int = 6
    mlp_ratio: int = 4
    patch: int = 14
    # Patches per side that the position embedding was trained on (518 / 14).
    grid: int = 37
    # Blocks whose normalised output the DPT head reads.
    out_indices: tuple[int, int, int, int] = (2, 5, 8, 11)


@dataclass(frozen=True)
class DPTConfig:
    """The dense prediction head atop the ViT."""

    features: int = 64
    # Channels of the four reassembled maps, finest first.
    channels: tuple[int, int, int, int] = (48, 96, 192, 384)
    # Channels before the single disparity channel.
    disparity_channels: int = 32


@dataclass(frozen=True)
class PhotoConfig:
    """The monocular branch on the frozen features of EfficientNet-Lite0."""

    # Channels of its pyramid, which is fused at a quarter of the image's size.
    features: int = 32
    # Channels of the coarsest map as it is handed on.
    channels: int = 64
    # Channels before the single disparity channel.
    disparity_channels: int = 16


@dataclass(frozen=True)
class UNetConfig:
    """The U-Net that regularises costs: `levels` resolutions, cross-view attention at the coarsest."""

    channels: int
    levels: int
    heads: int = 4
    # Pixels of a block that become channels, a side: a large map of few channels is slow to convolve.
    shuffle: int = 1

    @property
    def side(self) -> int:
        """Height and width of its maps must be multiples of this, to halve evenly."""
        return self.shuffle * 2 ** (self.levels - 1)


@dataclass(frozen=True)
class DPBUConfig:
    """One depth probability boosting unit."""

    channels: int
    candidates: int
    # The unit's resolution over that of the first unit, and the division of the candidates' interval that goes with it.
    scale: int
    unet: UNetConfig


@dataclass(frozen=True)
class FocusConfig:
    """The Gaussian focused module: window attention that keeps ever fewer neighbours."""

    channels: int = 256
    heads: int = 4
    window: int = 16
    # Neighbours kept by each layer; odd layers work on shifted windows.
    topk: tuple[int, ...] = (256, 256, 128, 128, 64, 64)


@dataclass(frozen=True)
class DepthScaleConfig:
    """One scale of DepthSplat's depth: its candidates, and the U-Net that regularises their costs."""

    candidates: int
    unet: UNetConfig


@dataclass(frozen=True)
class UpsamplerConfig:
    """DepthSplat's two DPT heads, which bring depth and features to image size."""

    # Channels of the four reassembled maps, finest first.
    channels: tuple[int, int, int, int] = (48, 96, 192, 384)
    depth_features: int = 32
    features: int = 64


@dataclass(frozen=True)
class EncoderConfig(ABC):
    """What both networks have: the encoder, the Gaussians' parameters, and the cameras and images of the training."""

    # Image size over the coarsest feature map's, 4 or 8.
    feature_stride: int = 4
    # CNN channels at its three resolutions, finest first.
    backbone_channels: tuple[int, int, int] = (64, 96, 128)
    # Channels of the matching features (CNN output, multi-view transformer).
    feature_channels: int = 128
    transformer_layers: int = 6
    transformer_ffn_ratio: int = 4
    # The multi-view transformer attends within this many windows a side.
    attention_splits: int = 2
    vit: ViTConfig = ViTConfig()
    # Each view is matched with this many of its nearest views; with three views or fewer, with all others.
    neighbours: int = 2
    sh_degree: int = 2
    scale_min: float = 1e-10
    scale_max: float = 3.0
    # Whether Gaussians' scales are predicted in pixels at their depth, and not in scene units as in the releases: the
    # network is not told the focal length, so that in scene units it serves one field of view and one image size.
    scale_in_pixels: bool = False
    # The depth range it was trained with, in scene units.
    near: float = 0.5
    far: float = 100.0
    # The image size it was trained at; a network that was trained at others, too, does best at this one.
    height: int = 256
    width: int = 256
    # The fewest and the most views it was trained with, and the shortest and longest side of its images.
    trained_views: tuple[int, int] = (2, 2)
    other_sides: tuple[int, ...] = ()

    @property
    def trained_sides(self) -> tuple[int, int]:
        """The shortest and the longest side of the images it was trained with, in pixels."""
        sides = (self.height, self.width, *self.other_sides)
        return min(sides), max(sides)

    @property
    @abstractmethod
    def unets(self) -> Iterator[tuple[int, UNetConfig]]:
        """The U-Nets that regularise costs, each with its maps' resolution over that of the coarsest."""

    @property
    def size_multiple(self) -> int:
        """Height and width must be multiples of this: every U-Net and the shifted attention windows halve evenly."""
        windows = 2 * self.attention_splits * self.feature_stride
        return max(windows, *(self.feature_stride // scale * unet.side for scale, unet in self.unets))

    def smallest_map(self, scale: int) -> int:
        """Pixels of the smallest map of `scale` times the coarsest resolution; all such maps have multiples of them."""
        return (self.size_multiple * scale // self.feature_stride) ** 2

    @property
    def sh_coefficients(self) -> int:
        """Spherical-harmonic coefficients a colour channel."""
        return (self.sh_degree + 1) ** 2


@dataclass(frozen=True)
class IDESplatConfig(EncoderConfig):
    """IDESplat. The defaults are the released RealEstate10K network; the other presets differ as `PRESETS` says."""

    dpt: DPTConfig = DPTConfig()
    # In place of the ViT and its DPT head.
    photo: PhotoConfig | None = None
    dpbus: tuple[DPBUConfig, DPBUConfig, DPBUConfig] = (
        DPBUConfig(channels=256, candidates=257, scale=1, unet=UNetConfig(channels=32, levels=3)),
        DPBUConfig(channels=64, candidates=129, scale=2, unet=UNetConfig(channels=16, levels=4)),
        DPBUConfig(channels=32, candidates=65, scale=4, unet=UNetConfig(channels=8, levels=5)),
    )
    residual_unet: UNetConfig = UNetConfig(channels=32, levels=5)
    # Expansion and depthwise kernel of the feed-forward layers after epipolar and window attention.
    ffn_ratio: int = 2
    ffn_kernel: int = 5
    focus: FocusConfig = FocusConfig()
    # Hidden channels of the Gaussian head's second input, what other views show at a pixel's place; 0: it has none.
    cross_view_channels: int = 0

    @property
    def unets(self) -> Iterator[tuple[int, UNetConfig]]:
        """Those of the three units."""
        return ((unit.scale, unit.unet) for unit in self.dpbus)

    @property
    def mono_channels(self) -> tuple[int, int]:
        """Channels of the monocular branch's coarse and fine features."""
        return (self.vit.dim, self.dpt.features) if self.photo is None else (self.photo.channels, self.photo.features)


@dataclass(frozen=True)
class DepthSplatConfig(EncoderConfig):
    """DepthSplat. The defaults are the released small RealEstate10K network, of one scale."""

    # One scale, or two: the second at twice the resolution, around the inverse depth of the first.
    scales: tuple[DepthScaleConfig, ...] = (
        DepthScaleConfig(candidates=128, unet=UNetConfig(channels=128, levels=3, heads=4)),
    )
    upsampler: UpsamplerConfig = UpsamplerConfig()
    # Channels of the two convolutions before the Gaussian head.
    regressor_channels: int = 64
    # The depth-only checkpoints have no Gaussian stage.
    gaussians: bool = True

    @property
    def depth_stride(self) -> int:
        """Image size over that of the last scale's inverse depth."""
        return self.feature_stride // 2 ** (len(self.scales) - 1)

    @property
    def unets(self) -> Iterator[tuple[int, UNetConfig]]:
        """Those of its scales."""
        return ((2**index, scale.unet) for index, scale in enumerate(self.scales))


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

PRESETS: dict[str, IDESplatConfig | DepthSplatConfig] = {
    "idesplat-re10k": IDESplatConfig(),
    "idesplat-acid": IDESplatConfig(),
    "idesplat-dl3dv": IDESplatConfig(feature_stride=8, far=200.0, height=256, width=448, trained_views=(2, 6)),
    "idesplat-tiny": _TINY,
    "idesplat-tiny-cross-view": _TINY_CROSS_VIEW,
    "idesplat-lite": _LITE,
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
