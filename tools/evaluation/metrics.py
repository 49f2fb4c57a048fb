"""Image and depth metrics: PSNR, SSIM, perceptual distances, AbsRel, delta < 1.25 and the inlier ratio at 1.05."""

from collections.abc import Callable
from importlib.util import find_spec
from typing import TYPE_CHECKING

import cv2
import numpy as np

from ...runtime.errors import InputError

if TYPE_CHECKING:
    from ..perceptual import Perceptual

# SSIM as Wang et al. (2004) define it and the releases compute it with scikit-image.
SSIM_WINDOW = 11
# PSNR of images that agree exactly, in dB.
HIGHEST_PSNR = 100.0
# Thresholds of max(D / D*, D* / D): of delta < 1.25, and of the inlier ratio.
DELTA, INLIER = 1.25, 1.05
INSTALL = "pip install 'idesplat[eval]'"

LPIPS, LITE0 = "lpips", "lite0"  # perceptual distances
LITE0_TITLE = "perceptual (Lite0)"
# Image and truth [height, width, 3], and valid [height, width] -> a distance.
PerceptualMetric = Callable[[np.ndarray, np.ndarray, np.ndarray], float]


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
    """Structural similarity (scikit-image, Gaussian weights of sigma 1.5, window 11), averaged over colour channels.

    image, truth: [height, width, 3], 0 to 1, not clipped. valid: bool [height, width]. Only pixels whose whole window
    is valid count; NaN if there is none.
    """
    from skimage.metrics import structural_similarity

    _, similarity = structural_similarity(
        truth.astype(np.float64),
        image.astype(np.float64),
        win_size=SSIM_WINDOW,
        gaussian_weights=True,
        data_range=1.0,
        channel_axis=2,
        full=True,
    )
    padded = np.pad(valid, 1).astype(np.uint8)  # pixels outside the image are not valid
    window = np.ones((SSIM_WINDOW, SSIM_WINDOW), np.uint8)
    whole = cv2.erode(padded, window, borderType=cv2.BORDER_REPLICATE)[1:-1, 1:-1].astype(bool)
    return float(similarity[whole].mean()) if whole.any() else float("nan")


def check_ssim() -> None:
    """Raise InputError if scikit-image, which computes SSIM, is not installed."""
    if find_spec("skimage") is None:
        raise InputError(f"scikit-image is needed for SSIM, and is not installed; {INSTALL}")


def load_lpips() -> PerceptualMetric:
    """LPIPS with VGG16 (Zhang et al. 2018); invalid pixels are given the truth's colour.

    Raises InputError if torch, lpips or VGG16's weights are missing.
    """
    _check_torch("LPIPS")
    from .. import perceptual

    return _as_metric(perceptual.load_lpips())


def load_lite0() -> PerceptualMetric:
    """The distance of EfficientNet-Lite0's features that training uses, too (`EfficientNetDistance`).

    Invalid pixels are given the truth's colour. Raises InputError if torch or the network's weights are missing.
    """
    _check_torch(LITE0_TITLE)
    from .. import perceptual

    try:
        return _as_metric(perceptual.EfficientNetDistance())
    except InputError as error:
        raise InputError(f"{LITE0_TITLE} is left out: {error}") from None


def _check_torch(metric: str) -> None:
    if find_spec("torch") is None:
        raise InputError(f"{metric} is left out, since the package torch is not installed")


def _as_metric(distance: "Perceptual") -> PerceptualMetric:
    """A distance of batches of tensors as a function of image, truth and valid, like the other metrics."""
    import torch

    def metric(image: np.ndarray, truth: np.ndarray, valid: np.ndarray) -> float:
        shown = np.where(valid[..., None], image.clip(0, 1), truth)
        first, second = (torch.from_numpy(x.astype(np.float32)).permute(2, 0, 1)[None] for x in (shown, truth))
        threads = torch.get_num_threads()
        torch.set_num_threads(1)  # where cores are shared, the threads wait for each other: twenty times as slow
        try:
            with torch.no_grad():
                return float(distance(first, second))
        finally:
            torch.set_num_threads(threads)

    return metric


def depth_measures(depth: np.ndarray, truth: np.ndarray, matched: np.ndarray | None = None) -> dict[str, float]:
    """AbsRel, delta < 1.25 and the inlier ratio at 1.05 of predicted depth.

    AbsRel is the mean of |D / D* - 1|; the others are the shares of pixels with max(D / D*, D* / D) below a threshold.
    depth, truth: z-depth, [views, height, width]. Pixels whose true depth is not positive and finite are left out.
    matched: the pixels whose surface another view sees, bool [views, height, width]; AbsRel of these is given, too.
    """
    known = np.isfinite(truth) & (truth > 0)
    ratio = depth[known].astype(np.float64) / truth[known]
    worst = np.maximum(ratio, np.divide(1, ratio, out=np.full_like(ratio, np.inf), where=ratio > 0))
    error = np.abs(ratio - 1)
    measures = {
        "abs_rel": float(error.mean()),
        "delta_1.25": float((worst < DELTA).mean()),
        "inlier_ratio_1.05": float((worst < INLIER).mean()),
    }
    if matched is not None and matched[known].any():
        measures["abs_rel_covisible"] = float(error[matched[known]].mean())
    return measures
