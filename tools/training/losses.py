"""What training asks of each stage: inverse depth, its gradients and probabilities, and rendered novel views."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ...model.common.gaussian_adapter import BASE_SIZES
from ...model.common.layers import repeat_views
from ...model.idesplat.config import IDESplatConfig
from ...model.idesplat.dpbu import DPBUOutput
from ...model.idesplat.encoder import EncoderFeatures
from ...runtime.errors import InputError

# Shares of the terms of one stage's loss.
FIRST_LAYER_WEIGHT = 0.5
RELATIVE_WEIGHT = 3.0
GRADIENT_WEIGHT = 0.5
ENTROPY_WEIGHT = 0.3
MATCHING_WEIGHT = 0.5
MONOCULAR_WEIGHT = 0.3
# From here on errors count logarithmically, so that hidden and textureless pixels do not rule: relative to the truth's
# inverse depth, and in candidates of the coarsest unit.
LARGE_RELATIVE = 0.5
LARGE_BINS = 8.0
# The same for the mean squared error of an image: 25 dB.
LARGE_SQUARED = 0.003
# The one prior on Gaussians: that they lie in the middle of their pixels. Synthetic views alone teach a head to shift
# all of them downwards, because floors come nearer downwards and the nearer of two neighbours hides the other.
OFFSET_WEIGHT = 0.05
# The share of LPIPS beside the squared error (the papers' lambda).
LPIPS_WEIGHT = 0.05
# The file in torchvision's cache folder with the VGG16 weights that LPIPS is built on.
VGG_WEIGHTS = "vgg16-397923af.pth"
TINY = 1e-6
# The offsets' channels among a pixel's raw parameters.
BASE_OFFSETS = slice(BASE_SIZES[0], BASE_SIZES[0] + BASE_SIZES[1])

Perceptual = Callable[[Tensor, Tensor], Tensor]


def truth_at(inverse_depth: Tensor, height: int, width: int) -> Tensor:
    """True inverse depth [views, H, W] at the pixels of a smaller map, [views, 1, height, width].

    Corners lie on corners, as where the network resizes. Values are picked and never mixed across an edge.
    """
    rows = torch.linspace(0, inverse_depth.shape[1] - 1, height).round().long()
    columns = torch.linspace(0, inverse_depth.shape[2] - 1, width).round().long()
    return inverse_depth[:, rows][:, :, columns][:, None]


def candidate_spacing(config: IDESplatConfig, near: Tensor, far: Tensor) -> Tensor:
    """The distance of the coarsest unit's candidates, in inverse scene units, [views, 1, 1, 1]."""
    return ((1 / near - 1 / far) / (config.dpbus[0].candidates - 1))[:, None, None, None]


def inverse_depth_loss(predicted: Tensor, truth: Tensor, bins: Tensor) -> Tensor:
    """|1/D - 1/D*| in candidates, |log D - log D*|, and |1/D - 1/D*|'s gradient along x and y.

    predicted, truth: inverse depth [views, 1, h, w]. bins: [views, 1, 1, 1].
    """
    error = (predicted - truth).abs()
    absolute = softened(error / bins, LARGE_BINS)
    relative = softened((predicted.clamp(min=TINY).log() - truth.log()).abs(), LARGE_RELATIVE)
    loss = absolute.mean() + RELATIVE_WEIGHT * relative.mean()
    for axis in (2, 3):
        step = (predicted.diff(dim=axis) - truth.diff(dim=axis)).abs() / bins
        loss = loss + GRADIENT_WEIGHT * softened(step, 1.0).mean()
    return loss


def softened(error: Tensor, large: float) -> Tensor:
    """Errors as they are while small, and their logarithm once `large`."""
    return large * torch.log1p(error / large)


def entropy_loss(probability: Tensor, candidates: Tensor, truth: Tensor) -> Tensor:
    """Cross entropy with the two candidates next to the truth, shared by distance; pixels outside the candidates: none.

    probability, candidates: [n, candidates, h, w], candidates in inverse depth; truth: inverse depth [n, 1, h, w].
    """
    low = candidates[:, :1]
    step = candidates[:, 1:2] - low
    last = candidates.shape[1] - 1
    position = (truth - low) / step.clamp(min=TINY)
    inside = (position >= 0) & (position <= last)
    below = position.floor().clamp(0, last - 1)
    upper = (position - below).clamp(0, 1)
    index = below.long()
    log = probability.clamp(min=TINY).log()
    entropy = -(1 - upper) * log.gather(1, index) - upper * log.gather(1, index + 1)
    return (entropy * inside).sum() / inside.sum().clamp(min=1)


def dpbu_loss(unit: DPBUOutput, scores: tuple[Tensor, Tensor], inverse_depth: Tensor, bins: Tensor) -> Tensor:
    """Everything that one boosting unit is asked.

    scores: what its two layers found by matching alone, each [views * neighbours, candidates, h, w]. They are asked
    for the truth themselves, since features learn to match much later where only the U-Net behind them is asked.
    inverse_depth: the truth, [views, H, W].
    """
    truth = truth_at(inverse_depth, *unit.inverse_depth.shape[2:])
    loss = inverse_depth_loss(unit.inverse_depth, truth, bins)
    loss = loss + ENTROPY_WEIGHT * entropy_loss(unit.probability, unit.candidates, truth)
    loss = loss + FIRST_LAYER_WEIGHT * inverse_depth_loss(unit.inverse_depth_first, truth, bins)
    neighbours = scores[0].shape[0] // truth.shape[0]
    candidates, truth = repeat_views(unit.candidates, neighbours), repeat_views(truth, neighbours)
    for layer in scores:
        loss = loss + MATCHING_WEIGHT * entropy_loss(layer.softmax(1), candidates, truth)
    return loss


def monocular_loss(encoded: EncoderFeatures, inverse_depth: Tensor) -> Tensor:
    """The monocular branch knows no scale: both disparities are divided by their mean over all views."""
    disparity = encoded.mono_disparity
    truth = truth_at(inverse_depth, *disparity.shape[2:])
    error = (disparity / disparity.mean().clamp(min=TINY) - truth / truth.mean()).abs()
    return MONOCULAR_WEIGHT * softened(error, 1.0).mean()


def render_loss(rendered: Tensor, truth: Tensor, perceptual: Perceptual | None) -> Tensor:
    """Squared error and, where there is one, the perceptual distance; images [views, 3, H, W] in [0, 1].

    The error of each image is softened: what no input view shows does not rule over the rest.
    """
    squared = (rendered - truth).square().mean((1, 2, 3))
    loss = softened(squared, LARGE_SQUARED).mean()
    return loss if perceptual is None else loss + LPIPS_WEIGHT * perceptual(rendered, truth)


def offset_loss(raw: Tensor) -> Tensor:
    """How far Gaussians are from the middle of their pixels.

    raw: what GaussianAdapter is given, [views, parameters, H, W].
    """
    return OFFSET_WEIGHT * (raw[:, BASE_OFFSETS].sigmoid() - 0.5).abs().mean()


def load_perceptual() -> Perceptual | None:
    """LPIPS if the `lpips` package and VGG16's weights are on this machine, else None and a warning; no download."""
    try:
        network = load_lpips_network()
    except InputError as error:
        print(f"warning: {error}", file=sys.stderr)
        return None
    return lambda rendered, truth: network(rendered, truth, normalize=True).mean()


def load_lpips_network() -> Any:
    """LPIPS with VGG16 (Zhang et al. 2018) as the package lpips has it, with frozen weights; nothing is downloaded.

    Raises InputError if the package or VGG16's weights in torchvision's cache folder are missing.
    """
    try:
        import lpips
    except ImportError:
        raise InputError("LPIPS is left out, since the package lpips is not installed") from None
    weights = Path(torch.hub.get_dir()) / "checkpoints" / VGG_WEIGHTS
    if not weights.is_file():
        raise InputError(f"LPIPS is left out, since VGG16's weights are not at {weights}")
    return lpips.LPIPS(net="vgg", verbose=False).requires_grad_(False)
