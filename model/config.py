"""Configuration that every network shares: the ViT, its DPT head, U-Nets, and what all encoders have."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
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
    out_indices: tuple[int, int, int, int] = (2, 5, 8, 11)


@dataclass(frozen=True)
class DPTConfig:
    """The dense prediction (DPT) head on the ViT."""

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

    @property
    def side(self) -> int:
        """Height and width of its maps must be multiples of this, to halve evenly."""
        return int(2 ** (self.levels - 1))


@dataclass(frozen=True)
class EncoderConfig(ABC):
    """What all networks have: the encoder, the Gaussians' parameters, and the cameras and images of the training."""

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
    # Whether Gaussians' scales are predicted in pixels at their depth, and not in scene units as in the releases. The
    # focal length is no input, so scales in scene units fit one field of view and one image size.
    scale_in_pixels: bool = False
    # Whether Gaussians' scales and rotations are predicted in the frame of the surface that the depth map shows, and
    # not in the camera's as in the releases: slanted surfaces then have no gaps for other views.
    surface_frame: bool = False
    # The depth range it was trained with, in scene units.
    near: float = 0.5
    far: float = 100.0
    # The image size it was trained at; if it was trained at several, the one with the best quality.
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
