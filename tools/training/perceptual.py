"""A perceptual distance on the features of EfficientNet-Lite0, where LPIPS's own weights are not at hand."""

import torch.nn.functional as F
from torch import Tensor

from ...model.idesplat.efficientnet import EfficientNetLite0
from .initialization import load_photographic_weights

# Of the network's maps, those at strides 2, 4 and 8.
LEVELS = slice(0, 3)


class PhotographicDistance:
    """As LPIPS without learnt weights: squared differences of unit-length features, averaged over maps and pixels."""

    def __init__(self) -> None:
        """Load the network; raises InputError if the package with its weights is not installed."""
        self.network = EfficientNetLite0().requires_grad_(False)
        load_photographic_weights(self.network)

    def __call__(self, rendered: Tensor, truth: Tensor) -> Tensor:
        """Images [n, 3, H, W] in [0, 1], multiples of 16 pixels -> their mean distance, a scalar."""
        pairs = zip(self.network(rendered)[LEVELS], self.network(truth)[LEVELS], strict=True)
        distances = [squared_distance(found, wanted) for found, wanted in pairs]
        return sum(distances[1:], distances[0]) / len(distances)


def squared_distance(first: Tensor, second: Tensor) -> Tensor:
    """The mean over pixels of |a / |a| - b / |b||^2 for feature maps a and b [n, channels, h, w]."""
    difference = F.normalize(first, dim=1) - F.normalize(second, dim=1)
    return difference.square().sum(1).mean()
