"""A monocular branch for small networks: a feature pyramid on EfficientNet-Lite0, and relative disparity."""

import torch.nn.functional as F
from torch import Tensor, nn

from ..common.dpt import TINY, Fusion
from .config import PhotoConfig
from .efficientnet import CHANNELS, EfficientNetLite0

# Of the backbone's maps, the pyramid has those at strides 4, 8 and 16.
LEVELS = slice(1, 4)


class PhotoBranch(nn.Module):
    """In place of the ViT and its DPT head."""

    def __init__(self, config: PhotoConfig) -> None:
        super().__init__()
        features = config.features
        self.network = EfficientNetLite0()
        self.project = nn.Conv2d(CHANNELS[-1], config.channels, 1)
        self.laterals = nn.ModuleList(nn.Conv2d(count, features, 1) for count in CHANNELS[LEVELS])
        self.fusions = nn.ModuleList(Fusion(features, lateral=level < 2) for level in range(3))
        self.disparity1 = nn.Conv2d(features, config.disparity_channels, 3, padding=1)
        self.disparity2 = nn.Conv2d(config.disparity_channels, 1, 1)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Images [views, 3, H, W] in [0, 1] -> coarse features, fine features, relative disparity.

        [views, channels, H / 16, W / 16], [views, features, H / 4, W / 4] and [views, 1, H / 4, W / 4], the last in
        [0, 1], with 1 the largest over all views.
        """
        # Magnitudes differ widely between images; a trial of training without this normalisation diverged.
        maps = [F.group_norm(x, 1) for x in self.network(images)[LEVELS]]
        fine, middle, coarse = (lateral(x) for lateral, x in zip(self.laterals, maps, strict=True))
        path = self.fusions[2](coarse, None, *middle.shape[2:])
        path = self.fusions[1](path, middle, *fine.shape[2:])
        features = self.fusions[0](path, fine, *fine.shape[2:])
        disparity = F.softplus(self.disparity2(F.relu(self.disparity1(features))))
        return self.project(maps[-1]), features, disparity / disparity.amax().clamp(min=TINY)
