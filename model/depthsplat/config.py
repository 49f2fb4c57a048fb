"""DepthSplat's configuration."""

from collections.abc import Iterator
from dataclasses import dataclass

from ..config import EncoderConfig, UNetConfig


@dataclass(frozen=True)
class DepthScaleConfig:
    """One scale of DepthSplat's depth: its candidates, and the U-Net that regularises their costs."""

    candidates: int
    unet: UNetConfig


@dataclass(frozen=True)
class UpsamplerConfig:
    """DepthSplat's two DPT heads, which upsample depth and features to image size."""

    # Channels of the four reassembled maps, finest first.
    channels: tuple[int, int, int, int] = (48, 96, 192, 384)
    depth_features: int = 32
    features: int = 64


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
        """The U-Nets of its scales."""
        return ((2**index, scale.unet) for index, scale in enumerate(self.scales))
