"""Every size of the networks, as frozen configurations, and the presets of the released checkpoints."""

from dataclasses import dataclass


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
    taps: tuple[int, int, int, int] = (2, 5, 8, 11)


@dataclass(frozen=True)
class DPTConfig:
    """The dense prediction head atop the ViT."""

    features: int = 64
    # Channels of the four reassembled maps, finest first.
    channels: tuple[int, int, int, int] = (48, 96, 192, 384)
    # Channels before the single disparity channel.
    disparity_channels: int = 32


@dataclass(frozen=True)
class UNetConfig:
    """The U-Net that regularises costs: `levels` resolutions, cross-view attention at the coarsest."""

    channels: int
    levels: int
    heads: int = 4


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
class IDESplatConfig:
    """IDESplat. The defaults are the released RealEstate10K network; the other presets differ as `PRESETS` says."""

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
    dpt: DPTConfig = DPTConfig()
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
    # Each view is matched with this many of its nearest views; with three views or fewer, with all others.
    neighbours: int = 2
    sh_degree: int = 2
    scale_min: float = 1e-10
    scale_max: float = 3.0
    # The depth range it was trained with, in scene units.
    near: float = 0.5
    far: float = 100.0
    # The image size it was trained at.
    height: int = 256
    width: int = 256

    @property
    def size_multiple(self) -> int:
        """Height and width must be multiples of this: every U-Net and the attention windows halve evenly."""
        return max(self.feature_stride // unit.scale * 2 ** (unit.unet.levels - 1) for unit in self.dpbus)

    @property
    def sh_coefficients(self) -> int:
        """Spherical-harmonic coefficients a colour channel."""
        return (self.sh_degree + 1) ** 2


PRESETS: dict[str, IDESplatConfig] = {
    "idesplat-re10k": IDESplatConfig(),
    "idesplat-acid": IDESplatConfig(),
    "idesplat-dl3dv": IDESplatConfig(feature_stride=8, far=200.0, height=256, width=448),
}
