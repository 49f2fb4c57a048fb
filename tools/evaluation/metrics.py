"""How far a image or a depth map is from the truth: PSNR, SSIM, LPIPS, AbsRel, as the field counts them."""

import sys
from collections.abc import Callable
from importlib.util import find_spec

import numpy as np

# SSIM of Wang et al., as scikit-image computes it with Gaussian weights and the releases report it.
SSIM_WINDOW, SSIM_SIGMA = 11, 1.5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2
# Images that agree exactly count as this good, in dB.
HIGHEST_PSNR = 100.0
# Thresholds of max(D / D*, D* / D): of delta < 1.25, and of the inlier ratio.
DELTA, INLIER = 1.25, 1.05

LPIPS = Callable[[np.ndarray, np.ndarray, np.ndarray], float]


def psnr(image: np.ndarray, truth: np.ndarray, valid: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB over the valid pixels, of values clipped to [0, 1].

    image, truth: [height, width, 3]. valid: bool [height, width], not all False.
    """
    difference = np.clip(image[valid], 0, 1) - np.clip(truth[valid], 0, 1)
    return min(-10 * float(np.log10(np.mean(difference**2, dtype=np.float64) + 1e-30)), HIGHEST_PSNR)


def fit_exposure(image: np.ndarray, truth: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """The image after the gain and offset of each channel that bring its valid pixels closest to the truth.

    Least squares on values clipped to [0, 1]. image, truth: [height, width, 3]. valid: bool [height, width].
    """
    clipped = np.clip(image, 0, 1).astype(np.float64)
    x, y = clipped[valid], np.clip(truth[valid], 0, 1).astype(np.float64)  # [pixels, 3]
    deviation = x - x.mean(axis=0)
    variance = np.square(deviation).mean(axis=0)
    covariance = (deviation * (y - y.mean(axis=0))).mean(axis=0)
    gain = np.divide(covariance, variance, out=np.zeros(3), where=variance > 0)
    return (gain * (clipped - x.mean(axis=0)) + y.mean(axis=0)).astype(np.float32)


def ssim(image: np.ndarray, truth: np.ndarray, valid: np.ndarray) -> float:
    """Structural similarity: its mean over colours and over the pixels whose whole window lies on valid pixels.

    image, truth: [height, width, 3], 0 to 1, not clipped. valid: bool [height, width]; all valid gives the number
    of scikit-image (Gaussian weights, sigma 1.5, window 11). NaN if no window is valid throughout.
    """
    import cv2

    def local_mean(values: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur(values, (SSIM_WINDOW, SSIM_WINDOW), SSIM_SIGMA)

    x, y = image.astype(np.float64), truth.astype(np.float64)
    mean_x, mean_y = local_mean(x), local_mean(y)
    unbiased = SSIM_WINDOW**2 / (SSIM_WINDOW**2 - 1)
    variance_x = unbiased * (local_mean(x * x) - mean_x**2)
    variance_y = unbiased * (local_mean(y * y) - mean_y**2)
    covariance = unbiased * (local_mean(x * y) - mean_x * mean_y)
    similarity = (2 * mean_x * mean_y + SSIM_C1) * (2 * covariance + SSIM_C2)
    similarity /= (mean_x**2 + mean_y**2 + SSIM_C1) * (variance_x + variance_y + SSIM_C2)

    padded = np.pad(valid, 1).astype(np.uint8)  # outside of the image nothing is valid
    window = np.ones((SSIM_WINDOW, SSIM_WINDOW), np.uint8)
    whole = cv2.erode(padded, window, borderType=cv2.BORDER_REPLICATE)[1:-1, 1:-1].astype(bool)
    return float(similarity[whole].mean()) if whole.any() else float("nan")


def load_lpips() -> LPIPS | None:
    """LPIPS with VGG16 as a function of image, truth and valid, like the others; None and a warning if not there.

    It needs the packages torch and lpips, and VGG16's weights where torchvision keeps them; nothing is downloaded.
    Pixels that are not valid are given the truth's colour.
    """
    for package in ("torch", "lpips"):
        if find_spec(package) is None:
            print(f"warning: LPIPS is left out, since the package {package} is not installed", file=sys.stderr)
            return None
    import torch

    from ..training.losses import load_perceptual

    network = load_perceptual()
    if network is None:
        return None

    def distance(image: np.ndarray, truth: np.ndarray, valid: np.ndarray) -> float:
        shown = np.where(valid[..., None], image, truth)
        first, second = (torch.from_numpy(x.astype(np.float32)).permute(2, 0, 1)[None] for x in (shown, truth))
        with torch.no_grad():
            return float(network(first, second))

    return distance


def depth_measures(depth: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """AbsRel, delta < 1.25 and the inlier ratio at 1.05 of predicted depth.

    AbsRel is the mean of |D - D*| / D*; the others are the shares of pixels with max(D / D*, D* / D) below a threshold.
    depth, truth: z-depth, [views, height, width]. Pixels whose true depth is not positive and finite are left out.
    """
    known = np.isfinite(truth) & (truth > 0)
    ratio = depth[known].astype(np.float64) / truth[known]
    worst = np.maximum(ratio, np.divide(1, ratio, out=np.full_like(ratio, np.inf), where=ratio > 0))
    return {
        "abs_rel": float(np.abs(ratio - 1).mean()),
        "delta_1.25": float((worst < DELTA).mean()),
        "inlier_ratio_1.05": float((worst < INLIER).mean()),
    }
