"""The CNN feature pyramid (GMFlow's residual encoder, the releases' backbone.py)."""

import torch.nn.functional as F
from torch import Tensor, nn


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions with instance normalisation and a shortcut, itself convolved where the shape changes."""

    def __init__(self, in_channels: int, channels: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(in_channels, channels, 3, stride, padding=1, bias=False)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        changes = stride != 1 or in_channels != channels
        self.shortcut = nn.Conv2d(in_channels, channels, 1, stride) if changes else None

    def forward(self, x: Tensor) -> Tensor:
        """[n, in_channels, h, w] -> [n, channels, h / stride, w / stride]."""
        y = F.relu(F.instance_norm(self.conv1(x)))
        y = F.relu(F.instance_norm(self.conv2(y)))
        if self.shortcut is not None:
            x = F.instance_norm(self.shortcut(x))
        return F.relu(x + y)


class Backbone(nn.Module):
    """Images to feature maps at `stride`, at half of it, and at half the image's size."""

    def __init__(self, channels: tuple[int, int, int], out_channels: int, stride: int) -> None:
        super().__init__()
        fine, middle, coarse = channels
        self.conv1 = nn.Conv2d(3, fine, 7, stride=2, padding=3, bias=False)
        self.layer1 = self._layer(fine, fine, 1)
        self.layer2 = self._layer(fine, middle, stride // 4)
        self.layer3 = self._layer(middle, coarse, 2)
        self.conv2 = nn.Conv2d(coarse, out_channels, 1)

    @staticmethod
    def _layer(in_channels: int, channels: int, stride: int) -> nn.Sequential:
        return nn.Sequential(ResidualBlock(in_channels, channels, stride), ResidualBlock(channels, channels, 1))

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Normalised images [views, 3, H, W] -> three maps, coarsest first.

        [views, out_channels, h, w], [views, middle, 2h, 2w] and [views, fine, H / 2, W / 2].
        """
        finest = self.layer1(F.relu(F.instance_norm(self.conv1(images))))
        finer = self.layer2(finest)
        return self.conv2(self.layer3(finer)), finer, finest
