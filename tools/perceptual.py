"""Perceptual distances between rendered and true images: LPIPS, and one on the features of EfficientNet-Lite0."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from ..model.idesplat.efficientnet import OUT_INDICES, EfficientNetLite0
from ..runtime.errors import InputError
from .imagenet import load_imagenet_weights

# Images [n, 3, H, W] in [0, 1], rendered and true -> their mean distance, a scalar.
Perceptual = Callable[[Tensor, Tensor], Tensor]

# The file in which torchvision keeps VGG16's ImageNet weights, the backbone of LPIPS.
VGG_WEIGHTS = "vgg16-397923af.pth"
# Of EfficientNet-Lite0's feature maps, the first three are used: at strides 2, 4 and 8.
LEVELS = 3
CPU = torch.device("cpu")


def check_lpips() -> None:
    """Raise InputError if the package lpips, or VGG16's weights in torchvision's cache folder, are missing."""
    try:
        import lpips  # noqa: F401
    except ImportError:
        raise InputError("LPIPS is left out, since the package lpips is not installed") from None
    weights = Path(torch.hub.get_dir()) / "checkpoints" / VGG_WEIGHTS
    if not weights.is_file():
        raise InputError(f"LPIPS is left out, since VGG16's weights are not at {weights}")


def load_lpips_network(device: torch.device = CPU) -> Any:
    """LPIPS with VGG16 (Zhang et al. 2018) of the package lpips, with frozen weights; nothing is downloaded.

    Raises InputError as `check_lpips`.
    """
    check_lpips()
    import lpips

    return lpips.LPIPS(net="vgg", verbose=False).requires_grad_(False).to(device)


def load_lpips(device: torch.device = CPU) -> Perceptual:
    """The mean LPIPS of images on a device; raises InputError as `check_lpips`."""
    network = load_lpips_network(device)
    return lambda rendered, truth: network(rendered, truth, normalize=True).mean()


class EfficientNetDistance:
    """LPIPS without learned weights, on the ImageNet features of EfficientNet-Lite0.

    d(a, b) = mean over levels and pixels of |f(a) / |f(a)| - f(b) / |f(b)||^2, with feature vectors f of a pixel.
    """

    def __init__(self, device: torch.device = CPU) -> None:
        """Load the network for images on a device; raises InputError if the package of its weights is missing."""
        self.network = EfficientNetLite0().requires_grad_(False)
        load_imagenet_weights(self.network)
        del self.network.blocks[OUT_INDICES[LEVELS - 1] + 1 :]
        self.network.to(device)

    def __call__(self, rendered: Tensor, truth: Tensor) -> Tensor:
        """Images [n, 3, H, W] in [0, 1], sides multiples of 8 pixels -> their mean distance, a scalar."""
        pairs = zip(self.network(rendered), self.network(truth), strict=True)
        distances = [squared_distance(found, wanted) for found, wanted in pairs]
        return sum(distances[1:], distances[0]) / len(distances)


def squared_distance(first: Tensor, second: Tensor) -> Tensor:
    """The mean over pixels of |a / |a| - b / |b||^2 for feature maps a and b [n, channels, h, w]."""
    difference = F.normalize(first, dim=1) - F.normalize(second, dim=1)
    return difference.square().sum(1).mean()
