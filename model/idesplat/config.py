"""IDESplat's configuration."""

from collections.abc import Iterator
from dataclasses import dataclass, field

from ..config import DPTConfig, EncoderConfig, UNetConfig


@dataclass(frozen=True)
class PhotoConfig:
    """The monocular branch on the features of EfficientNet-Lite0."""

    # Channels of its pyramid, which is fused at a quarter of the image's size.
    features: int = 32
    # Channels of the coarsest map in the branch's output.
    channels: int = 64
    # Channels before the single disparity channel.
    disparity_channels: int = 16


@dataclass(frozen=True)
class DPBUConfig:
    """One depth probability boosting unit."""

    channels: int
    candidates: int
    # Resolution over that of the first DPBU; the candidates' range is narrower by the same factor.
    scale: int
    unet: UNetConfig


@dataclass(frozen=True)
class FocusConfig:
    """The Gaussian focused module: window attention that keeps fewer neighbours from layer to layer."""

    channels: int = 256
    heads: int = 4
    window: int = 16
    # Neighbours kept by each layer; odd layers work on shifted windows.
    topk: tuple[int, ...] = (256, 256, 128, 128, 64, 64)


@dataclass(frozen=True)
class IDESplatConfig(EncoderConfig):
    """IDESplat. The defaults are the released RealEstate10K network; presets.py has the others."""

    dpt: DPTConfig = field(default=DPTConfig())
    # In place of the ViT and its DPT head.
    photo: PhotoConfig | None = None
    dpbus: tuple[DPBUConfig, DPBUConfig, DPBUConfig] = (
        DPBUConfig(channels=256, candidates=257, scale=1, unet=UNetConfig(channels=32, levels=3)),
        DPBUConfig(channels=64, candidates=129, scale=2, unet=UNetConfig(channels=16, levels=4)),
        DPBUConfig(channels=32, candidates=65, scale=4, unet=UNetConfig(channels=8, levels=5)),
    )
    residual_unet: UNetConfig = field(default=UNetConfig(channels=32, levels=5))
    # Expansion and depthwise kernel of the feed-forward layers after epipolar and window attention.
    ffn_ratio: int = 2
    ffn_kernel: int = 5
    focus: FocusConfig = FocusConfig()
    # Hidden channels of the head that compares a pixel with its projections in other views; 0: no such head.
    cross_view_channels: int = 0

    @property
    def unets(self) -> Iterator[tuple[int, UNetConfig]]:
        """The U-Nets of the three DPBUs."""
        return ((unit.scale, unit.unet) for unit in self.dpbus)

    @property
    def mono_channels(self) -> tuple[int, int]:
        """Channels of the monocular branch's coarse and fine features."""
        return (self.vit.dim, self.dpt.features) if self.photo is None else (self.photo.channels, self.photo.features)
