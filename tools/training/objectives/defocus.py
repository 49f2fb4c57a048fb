"""Defocus losses, for captures with shallow focus: views are rendered through a thin lens before they are compared.

Deng et al. 2025 supervise a splatting network with defocused images: L1 + SSIM where the image is in focus, and a
penalty on differing blur elsewhere. Here the lens has one diameter for all captures, and each view's focus is found:
the depth that is predicted where its image is sharp. With c the diameter of the circle of confusion
(`geometry.projection`) and B the rendered, I the true image,

    L = mean over c < 1 px of (0.8 |B - I| + 0.2 (1 - SSIM)) + OUT_OF_FOCUS_WEIGHT mean over c >= 1 px of |B - I|.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from ....model.common.gaussian_adapter import WorldGaussians
from ....model.common.geometry import denormalize_intrinsics, invert_rigid
from ..data.samples import TrainingViews
from ..rasterizer import render_on_black

SSIM_WEIGHT = 0.2
OUT_OF_FOCUS_WEIGHT = 0.5
# A circle of confusion of this diameter in pixels is in focus.
IN_FOCUS = 1.0
# SSIM (Wang et al. 2004): its Gaussian window, and the constants for images in [0, 1].
WINDOW, WINDOW_STD = 11, 1.5
C1, C2 = 0.01**2, 0.03**2
MIN_ALPHA = 1e-3


def defocus_loss(gaussians: WorldGaussians, views: TrainingViews, aperture: float) -> Tensor:
    """The mean of L over the target views. aperture: diameter of the lens in scene units; near is 1."""
    height, width = views.target_images.shape[2:]
    Ks = denormalize_intrinsics(views.target_intrinsics, width, height)
    losses = []
    for image, viewmat, K in zip(views.target_images, invert_rigid(views.target_extrinsics), Ks, strict=True):
        with torch.no_grad():
            depth = _depth(gaussians, viewmat, K, width, height)
            focus = focused_depth(image, depth)
        rendered = render_on_black(gaussians, viewmat, K, width, height, aperture, focus)[0].permute(2, 0, 1)
        confusion = aperture * K[0, 0] * (1 / focus - 1 / depth).abs()
        losses.append(compare_defocused(rendered, image, confusion))
    return torch.stack(losses).mean()


def compare_defocused(rendered: Tensor, image: Tensor, confusion: Tensor) -> Tensor:
    """L of one view. rendered, image: [3, H, W]. confusion: diameters c in pixels, [H, W]."""
    difference = (rendered - image).abs().mean(0)
    dissimilarity = 1 - ssim_map(rendered[None], image[None])[0].mean(0)
    sharp = (confusion < IN_FOCUS).to(difference)
    in_focus = (1 - SSIM_WEIGHT) * difference + SSIM_WEIGHT * dissimilarity
    return _mean(in_focus, sharp) + OUT_OF_FOCUS_WEIGHT * _mean(difference, 1 - sharp)


def focused_depth(image: Tensor, depth: Tensor) -> float:
    """The median of the depth, weighted by the image's squared Laplacian, which is large where it is sharp.

    image: [3, H, W]. depth: [H, W].
    """
    kernel = torch.tensor([[0.0, 1.0, 0.0], [1.0, -4.0, 1.0], [0.0, 1.0, 0.0]])
    sharpness = F.conv2d(image.mean(0)[None, None], kernel[None, None])[0, 0].square().flatten()
    inner, order = depth[1:-1, 1:-1].flatten().sort()
    weights = sharpness[order].double().cumsum(0)
    middle = int(torch.searchsorted(weights, weights[-1:] / 2).clamp(max=len(inner) - 1))
    return float(inner[middle])


def ssim_map(first: Tensor, second: Tensor) -> Tensor:
    """SSIM of each pixel of images [n, channels, H, W] in [0, 1], the border replicated: the same shape."""
    channels = first.shape[1]
    offsets = torch.arange(WINDOW, dtype=first.dtype) - WINDOW // 2
    taps = torch.exp(-(offsets**2) / (2 * WINDOW_STD**2))
    window = torch.outer(taps, taps / taps.sum() ** 2).expand(channels, 1, WINDOW, WINDOW)

    def smooth(x: Tensor) -> Tensor:
        return F.conv2d(F.pad(x, (WINDOW // 2,) * 4, mode="replicate"), window, groups=channels)

    mean_first, mean_second = smooth(first), smooth(second)
    variance_first = smooth(first * first) - mean_first**2
    variance_second = smooth(second * second) - mean_second**2
    covariance = smooth(first * second) - mean_first * mean_second
    luminance = (2 * mean_first * mean_second + C1) / (mean_first**2 + mean_second**2 + C1)
    return luminance * (2 * covariance + C2) / (variance_first + variance_second + C2)


def _depth(gaussians: WorldGaussians, viewmat: Tensor, K: Tensor, width: int, height: int) -> Tensor:
    """Rendered z-depth [H, W]; where nothing is rendered, the median."""
    _, alpha, depth = render_on_black(gaussians, viewmat, K, width, height)
    covered = alpha > MIN_ALPHA
    depth = depth / alpha.clamp(min=MIN_ALPHA)
    return torch.where(covered, depth, depth[covered].median() if covered.any() else 1.0)


def _mean(values: Tensor, weights: Tensor) -> Tensor:
    """The weighted mean of values; 0 if all weights are."""
    return (values * weights).sum() / weights.sum().clamp(min=1)
