"""Initial weights with which a new network matches features from the first step.

With random weights, query and key projections differ and the U-Nets mix candidates, and training first has to undo
both. Here queries and keys start with the identity, and each U-Net starts as a smoothing of the correlations along the
candidates, plus noise. The architecture is unchanged.
"""

import math

import torch
from torch import Tensor, nn

from ...model.common.gaussian_adapter import SCALE_SHIFT
from ...model.common.mv_transformer import TransformerBlock, WindowAttention
from ...model.common.unet import CostRegulariser, ResBlock
from ...model.idesplat.config import IDESplatConfig
from ...model.idesplat.epipolar_attention import EpipolarAttention
from ...model.idesplat.network import IDESplat
from ..imagenet import load_imagenet_weights

# Gain from a correlation to its candidate's logit.
TEMPERATURE = 2.0
# Factor of the random weights around those that are set.
NOISE = 0.2
# Initial Gaussians: opacity 0.5, so that overlapping views blend; the scale in pixels leaves no gaps.
OPACITY_LOGIT, SCALE_PIXELS = 0.0, 0.5
# Initial gain of the multi-view transformer's residual branches.
RESIDUAL_GAIN = 0.1


def new_model(config: IDESplatConfig, seed: int) -> IDESplat:
    """A network with random weights of `seed`."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = IDESplat(config)
    for part in model.modules():
        if isinstance(part, EpipolarAttention):
            _set_identity_projections(part)
            _set_smoothing(part.regulariser, first=1)
        elif isinstance(part, TransformerBlock | WindowAttention):
            nn.init.constant_(part.norm.weight, RESIDUAL_GAIN)
    _set_smoothing(model.gaussians.residual, first=config.dpbus[2].channels)
    _set_head_biases(model)
    # The monocular disparity is one over this layer's output: it must start away from zero.
    if model.encoder.photo is None:
        bias = model.encoder.dpt.disparity3.bias
        assert bias is not None
        nn.init.ones_(bias)
    else:
        load_imagenet_weights(model.encoder.photo.network)
    return model


@torch.no_grad()
def _set_head_biases(model: IDESplat) -> None:
    """Set the head's biases to the initial opacity and, if scales are predicted in pixels, to the initial scale."""
    bias = model.gaussians.head2.bias
    assert bias is not None
    bias[0] = OPACITY_LOGIT
    if model.config.scale_in_pixels:
        bias[3:6] = SCALE_SHIFT + math.log(math.expm1(SCALE_PIXELS))  # softplus gives it back


@torch.no_grad()
def _set_identity_projections(layer: EpipolarAttention) -> None:
    """Make query and key projections the identity, so that correlations compare like features."""
    for projection in (layer.q_proj, layer.k_proj):
        nn.init.eye_(projection.weight)
        nn.init.zeros_(projection.bias)


@torch.no_grad()
def _set_smoothing(regulariser: CostRegulariser, first: int) -> None:
    """Pass the candidates, input channels from `first` on, through the U-Net to the logits, smoothed."""
    unet = regulariser.unet
    channels, candidates = unet.conv_in.weight.shape[0], regulariser.conv_out.weight.shape[0]
    triangles = _triangles(channels, candidates)
    _set_centre(regulariser.conv_in, triangles / triangles.sum(1, keepdim=True), first)
    _set_centre(unet.conv_in, torch.eye(channels), 0)
    # The last block's shortcut reads the upsampled map, then the skip connection, which is passed on.
    last_block = unet.up_blocks[-1]
    assert isinstance(last_block, ResBlock) and isinstance(last_block.shortcut, nn.Conv2d)
    _set_centre(last_block.shortcut, torch.eye(channels), channels)
    nn.init.zeros_(last_block.conv2.weight)
    _set_centre(unet.conv_out, torch.eye(channels), 0)
    _set_centre(regulariser.conv_out, (TEMPERATURE * triangles / triangles.sum(0)).T, 0)


def _triangles(channels: int, candidates: int) -> Tensor:
    """Overlapping triangular windows over the candidates, [channels, candidates]."""
    centres = torch.linspace(0, candidates - 1, channels)
    width = max(1.0, (candidates - 1) / (channels - 1))
    return (1 - (torch.arange(candidates) - centres[:, None]).abs() / width).clamp(min=0)


def _set_centre(convolution: nn.Conv2d, matrix: Tensor, first: int) -> None:
    """Add `matrix` to the kernel's centre for the input channels from `first` on, and damp the random weights."""
    convolution.weight.mul_(NOISE)
    middle = convolution.weight.shape[2] // 2
    convolution.weight[:, first : first + matrix.shape[1], middle, middle] += matrix
    if convolution.bias is not None:
        convolution.bias.zero_()
