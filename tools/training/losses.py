"""Training losses: inverse depth, probabilities over depth candidates, rendered novel views, and a prior on offsets.

D is an inverse depth, D* the true one. Every error e goes through r(e; c) = c log(1 + e / c), which is e for small
errors and grows logarithmically beyond c, so that occluded and textureless pixels do not dominate (`robust_error`).
"""

import torch
from torch import Tensor

from ...model.common.gaussian_adapter import BASE_SIZES
from ...model.common.layers import repeat_views
from ...model.idesplat.config import IDESplatConfig
from ...model.idesplat.dpbu import DPBUOutput
from ...model.idesplat.encoder import EncoderFeatures
from ..perceptual import Perceptual

# Weights of the terms of a DPBU's loss.
FIRST_LAYER_WEIGHT = 0.5
RELATIVE_WEIGHT = 3.0
GRADIENT_WEIGHT = 0.5
ENTROPY_WEIGHT = 0.3
MATCHING_WEIGHT = 0.5
MONOCULAR_WEIGHT = 0.3
# Scales c of robust errors: of log D, of D in candidate spacings of DPBU 1, and of an image's squared error (25 dB).
RELATIVE_SCALE = 0.5
SPACING_SCALE = 8.0
SQUARED_SCALE = 0.003
# Weight of the offset prior. Synthetic views alone teach a head to shift all Gaussians downwards, since floors are
# nearer at lower pixels, and the nearer of two neighbouring Gaussians occludes the other.
OFFSET_WEIGHT = 0.05
# Weight of the perceptual distance beside the squared error: the papers' lambda for LPIPS.
LPIPS_WEIGHT = 0.05
EPS = 1e-6
# Channels of the offsets among a pixel's raw Gaussian parameters.
BASE_OFFSETS = slice(BASE_SIZES[0], BASE_SIZES[0] + BASE_SIZES[1])


def robust_error(error: Tensor, scale: float) -> Tensor:
    """r(e; c) = c log(1 + e / c) of errors e >= 0, with c = scale."""
    return scale * torch.log1p(error / scale)


def resize_truth(inverse_depth: Tensor, height: int, width: int) -> Tensor:
    """True inverse depth [views, H, W] at the pixels of a smaller map, [views, 1, height, width].

    Nearest neighbour with aligned corners, as the network resizes; interpolation would mix depths across edges.
    """
    rows = torch.linspace(0, inverse_depth.shape[1] - 1, height).round().long()
    columns = torch.linspace(0, inverse_depth.shape[2] - 1, width).round().long()
    return inverse_depth[:, rows][:, :, columns][:, None]


def candidate_spacing(config: IDESplatConfig, near: Tensor, far: Tensor) -> Tensor:
    """The spacing of DPBU 1's candidates, which are uniform in inverse depth, [views, 1, 1, 1]."""
    return ((1 / near - 1 / far) / (config.dpbus[0].candidates - 1))[:, None, None, None]


def inverse_depth_loss(predicted: Tensor, truth: Tensor, spacing: Tensor) -> Tensor:
    """L1 of inverse depth and of its logarithm, with a gradient term as in DPT (Ranftl et al. 2021) at a single scale.

    L = mean r(|D - D*| / s) + w_rel mean r(|log D - log D*|) + w_grad sum over x, y of mean r(|d(D - D*)| / s),
    with s = spacing, and d the difference of neighbouring pixels.

    predicted, truth: inverse depth [views, 1, h, w]. spacing: of the candidates of DPBU 1, [views, 1, 1, 1].
    """
    error = (predicted - truth).abs()
    absolute = robust_error(error / spacing, SPACING_SCALE)
    relative = robust_error((predicted.clamp(min=EPS).log() - truth.log()).abs(), RELATIVE_SCALE)
    loss = absolute.mean() + RELATIVE_WEIGHT * relative.mean()
    for axis in (2, 3):
        step = (predicted.diff(dim=axis) - truth.diff(dim=axis)).abs() / spacing
        loss = loss + GRADIENT_WEIGHT * robust_error(step, 1.0).mean()
    return loss


def candidate_cross_entropy(probability: Tensor, candidates: Tensor, truth: Tensor, scenes: int = 1) -> Tensor:
    """Cross entropy between candidate probabilities and the true inverse depth.

    The target distribution interpolates linearly between the two candidates around the truth; its mean is the truth.
    Pixels whose truth lies outside the candidates are left out. The mean over pixels is that of each scene, of which
    the loss is the mean.

    probability, candidates: [n, candidates, h, w]; candidates are inverse depths, uniformly spaced.
    truth: inverse depth, [n, 1, h, w]. scenes: how many the n maps are of, each with as many.
    """
    low = candidates[:, :1]
    step = candidates[:, 1:2] - low
    last = candidates.shape[1] - 1
    position = (truth - low) / step.clamp(min=EPS)
    inside = (position >= 0) & (position <= last)
    below = position.floor().clamp(0, last - 1)
    upper = (position - below).clamp(0, 1)
    index = below.long()
    log = probability.clamp(min=EPS).log()
    entropy = -(1 - upper) * log.gather(1, index) - upper * log.gather(1, index + 1)
    entropy, inside = (entropy * inside).reshape(scenes, -1), inside.reshape(scenes, -1)
    return (entropy.sum(1) / inside.sum(1).clamp(min=1)).mean()


def dpbu_loss(
    output: DPBUOutput, scores: tuple[Tensor, Tensor], inverse_depth: Tensor, spacing: Tensor, scenes: int = 1
) -> Tensor:
    """Loss of one depth probability boosting unit (DPBU): both layers' depth, and cross entropies.

    The correlations of both layers are supervised directly, too: without this, features learn to match much later,
    since gradients reach them through the U-Net alone. GMFlow (Xu et al. 2022) likewise takes a softmax over
    correlations as the matching distribution.

    scores: correlations of the two layers before their U-Nets, each [views * neighbours, candidates, h, w].
    inverse_depth: the truth, [views, H, W]. spacing: of the candidates of DPBU 1, [views, 1, 1, 1].
    scenes: how many the views are of.
    """
    truth = resize_truth(inverse_depth, *output.inverse_depth.shape[2:])
    loss = inverse_depth_loss(output.inverse_depth, truth, spacing)
    loss = loss + ENTROPY_WEIGHT * candidate_cross_entropy(output.probability, output.candidates, truth, scenes)
    loss = loss + FIRST_LAYER_WEIGHT * inverse_depth_loss(output.inverse_depth_first, truth, spacing)
    neighbours = scores[0].shape[0] // truth.shape[0]
    candidates, truth = repeat_views(output.candidates, neighbours), repeat_views(truth, neighbours)
    for layer in scores:
        loss = loss + MATCHING_WEIGHT * candidate_cross_entropy(layer.softmax(1), candidates, truth, scenes)
    return loss


def monocular_loss(encoded: EncoderFeatures, inverse_depth: Tensor, scenes: int = 1) -> Tensor:
    """Scale-invariant L1 of the monocular disparity d: r(|d / mean(d) - D* / mean(D*)|), means over a scene's views."""
    disparity = encoded.mono_disparity
    truth = resize_truth(inverse_depth, *disparity.shape[2:]).reshape(scenes, -1)
    disparity = disparity.reshape(scenes, -1)
    error = (disparity / disparity.mean(1, keepdim=True).clamp(min=EPS) - truth / truth.mean(1, keepdim=True)).abs()
    return MONOCULAR_WEIGHT * robust_error(error, 1.0).mean()


def photometric_loss(rendered: Tensor, truth: Tensor, perceptual: Perceptual | None) -> Tensor:
    """Mean over images of r(MSE), plus LPIPS_WEIGHT times a perceptual distance; images [views, 3, H, W] in [0, 1].

    MSE + 0.05 LPIPS is the loss of both papers. Here each image's MSE is made robust, since target views show
    regions that no context view sees.
    """
    squared = (rendered - truth).square().mean((1, 2, 3))
    loss = robust_error(squared, SQUARED_SCALE).mean()
    return loss if perceptual is None else loss + LPIPS_WEIGHT * perceptual(rendered, truth)


def offset_prior(raw: Tensor) -> Tensor:
    """Regularisation term: the mean distance of Gaussians from their pixels' centres, in pixels, per axis.

    raw: input of GaussianAdapter, [views, parameters, H, W].
    """
    return OFFSET_WEIGHT * (raw[:, BASE_OFFSETS].sigmoid() - 0.5).abs().mean()
