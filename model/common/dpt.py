"""The dense prediction transformer's decoder (DPT, Ranftl et al. 2021), and Depth Anything V2's head on it."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..config import DPTConfig
from .layers import resize

# Lower limit of the largest disparity: an untrained head returns zeros instead of NaN.
TINY = 1e-12


class ResidualConvUnit(nn.Module):
    """Two activated 3x3 convolutions and a shortcut."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """[n, channels, h, w] -> the same shape."""
        return self.conv2(F.relu(self.conv1(F.relu(x)))) + x


class Fusion(nn.Module):
    """Adds a finer map to the decoder path, and resizes the sum to the next finer size."""

    def __init__(self, channels: int, lateral: bool) -> None:
        super().__init__()
        self.lateral = ResidualConvUnit(channels) if lateral else None
        self.unit = ResidualConvUnit(channels)
        self.out_conv = nn.Conv2d(channels, channels, 1)

    def forward(self, path: Tensor, lateral: Tensor | None, height: int, width: int) -> Tensor:
        """Maps [n, channels, h, w] -> [n, channels, height, width]."""
        if self.lateral is not None and lateral is not None:
            path = path + self.lateral(lateral)
        # The releases resize before the 1x1 convolution; the two commute, and this order is a quarter of the work.
        return resize(self.out_conv(self.unit(path)), height, width)


class DPT(nn.Module):
    """Four ViT maps -> features at eight times their resolution."""

    def __init__(self, dim: int, channels: tuple[int, int, int, int], features: int) -> None:
        """dim: of the ViT's tokens. channels: of the four reassembled maps, finest first."""
        super().__init__()
        self.projects = nn.ModuleList(nn.Conv2d(dim, count, 1) for count in channels)
        self.upsample4 = nn.ConvTranspose2d(channels[0], channels[0], 4, stride=4)
        self.upsample2 = nn.ConvTranspose2d(channels[1], channels[1], 2, stride=2)
        self.downsample = nn.Conv2d(channels[3], channels[3], 3, stride=2, padding=1)
        self.laterals = nn.ModuleList(nn.Conv2d(count, features, 3, padding=1, bias=False) for count in channels)
        self.fusions = nn.ModuleList(Fusion(features, lateral=level < 3) for level in range(4))

    def reassemble(self, first: Tensor, second: Tensor, third: Tensor, fourth: Tensor) -> list[Tensor]:
        """Projected maps [n, channels, rows, columns] -> a pyramid of 4, 2, 1 and 1/2 times their size."""
        return [self.upsample4(first), self.upsample2(second), third, self.downsample(fourth)]

    def fuse(self, pyramid: list[Tensor]) -> Tensor:
        """The pyramid -> [n, features, 8 * rows, 8 * columns]."""
        pyramid = [lateral(x) for lateral, x in zip(self.laterals, pyramid, strict=True)]
        path = self.fusions[3](pyramid[3], None, *pyramid[2].shape[2:])
        path = self.fusions[2](path, pyramid[2], *pyramid[1].shape[2:])
        path = self.fusions[1](path, pyramid[1], *pyramid[0].shape[2:])
        height, width = pyramid[0].shape[2:]
        return self.fusions[0](path, pyramid[0], 2 * height, 2 * width)


class DPTHead(DPT):
    """Depth Anything V2's head: features, and relative disparity at image size."""

    def __init__(self, dim: int, patch: int, config: DPTConfig) -> None:
        super().__init__(dim, config.channels, config.features)
        self.patch = patch
        features = config.features
        self.disparity1 = nn.Conv2d(features, features // 2, 3, padding=1)
        self.disparity2 = nn.Conv2d(features // 2, config.disparity_channels, 3, padding=1)
        self.disparity3 = nn.Conv2d(config.disparity_channels, 1, 1)

    def features(self, maps: list[Tensor]) -> Tensor:
        """Four maps [n, dim, rows, columns] -> [n, features, 8 * rows, 8 * columns]."""
        projected = [project(x) for project, x in zip(self.projects, maps, strict=True)]
        return self.fuse(self.reassemble(*projected))

    def disparity(self, features: Tensor, rows: int, columns: int) -> Tensor:
        """Relative disparity in [0, 1], the largest over all views being 1: [n, 1, rows * patch, columns * patch].

        The releases invert the head's output and divide by the maximum over all views at once (depth_anything/dpt.py).
        """
        x = resize(self.disparity1(features), rows * self.patch, columns * self.patch)
        depth = F.relu(self.disparity3(F.relu(self.disparity2(x))))
        disparity = torch.where(depth == 0, 0.0, 1 / depth)
        return disparity / disparity.max().clamp(min=TINY)
