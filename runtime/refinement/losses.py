"""The photometric loss of 3DGS, (1 - w) L1 + w (1 - SSIM), with its gradient."""

from typing import NamedTuple

import cv2
import numpy as np

SSIM_SIGMA = 1.5  # Wang et al. 2004: an 11 x 11 window
SSIM_WINDOW = 11
C1, C2 = 0.01**2, 0.03**2


class Loss(NamedTuple):
    """A loss's value, and its gradient with respect to the rendered image, [height, width, 3] float32."""

    value: float
    gradient: np.ndarray


def photometric_loss(rendered: np.ndarray, image: np.ndarray, weights: np.ndarray, ssim_weight: float) -> Loss:
    """(1 - w) L1 + w (1 - SSIM), averaged with `weights`; float32 [height, width, 3] and [height, width, 1]."""
    total = max(float(weights.sum()) * 3, 1.0)
    difference = rendered - image
    l1 = float((np.abs(difference) * weights).sum()) / total
    gradient = np.sign(difference) * weights * np.float32((1 - ssim_weight) / total)
    if ssim_weight == 0:
        return Loss(l1, gradient)
    ssim, ssim_gradient = _ssim(rendered, image, weights / np.float32(total))
    return Loss((1 - ssim_weight) * l1 + ssim_weight * (1 - ssim), gradient - np.float32(ssim_weight) * ssim_gradient)


def _ssim(x: np.ndarray, y: np.ndarray, weights: np.ndarray) -> tuple[float, np.ndarray]:
    """The weighted sum of the SSIM map and its gradient with respect to `x`.

    SSIM = A1 A2 / (B1 B2) with A1 = 2 mx my + C1, A2 = 2 sxy + C2, B1 = mx^2 + my^2 + C1, B2 = sx + sy + C2, where m
    and s are means and (co)variances under the Gaussian window. The window is symmetric: its adjoint is itself, but
    for the border, where the image is continued by zeros.
    """
    mx, my = _blur(x), _blur(y)
    sx, sy, sxy = _blur(x * x) - mx * mx, _blur(y * y) - my * my, _blur(x * y) - mx * my
    a1, a2, b1, b2 = 2 * mx * my + C1, 2 * sxy + C2, mx * mx + my * my + C1, sx + sy + C2
    ssim = a1 * a2 / (b1 * b2)
    for_a2 = weights * a1 / (b1 * b2)  # gradient of A2
    for_b2 = -weights * ssim / b2
    for_mx = weights * 2 * (my * a2 / (b1 * b2) - mx * ssim / b1) - for_a2 * 2 * my - for_b2 * 2 * mx
    gradient = _blur(for_mx) + 2 * y * _blur(for_a2) + 2 * x * _blur(for_b2)
    return float((ssim * weights).sum()), gradient


def _blur(image: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(image, (SSIM_WINDOW, SSIM_WINDOW), SSIM_SIGMA, borderType=cv2.BORDER_CONSTANT)
