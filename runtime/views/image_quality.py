"""Whether an image shows anything, and whether it is sharp, from what the network sees of it."""

from dataclasses import dataclass

import cv2
import numpy as np

from ..images.colormaps import to_uint8

SIDE = 256  # pixels: shorter side at which an image is measured, or its own if that is smaller
CONTRAST_PERCENTILES = 2, 98
WHITE = 250  # grey level from which a pixel is overexposed
BLUR_WINDOW = 9  # pixels, of the box filter of the blur effect

# Of 850 frames of 18 captures, these limits reject four, all of them blurred, where each is compared with its
# neighbours.
MIN_CONTRAST = 12  # grey levels; the least of a good frame is 76
MAX_WHITE = 0.4  # share of the pixels; the most of a good frame is 0.12
MAX_WHITE_AROUND = 0.2  # of the images beside an overexposed one; a white background is in all of them
MIN_DETAIL_RATIO = 0.35  # of the variance of the Laplacian to that of the images beside it
MAX_BLUR_EXCESS = 0.08  # of the blur effect, over the images beside it; unlike the former, it ignores what is shown
BLURRED_ALONE = 0.47  # blur effect of which one in 200 good frames has more, so that it is compared with more images


@dataclass(frozen=True)
class ImageStatistics:
    """Measures of an image's luminance, from 0 to 255.

    contrast: between the 2nd and the 98th percentile. white: share of overexposed pixels.
    detail: variance of the Laplacian. blur: the blur effect, 0 (sharp) to 1 (Crete et al. 2007): how little the
    differences between neighbouring pixels change by another blur, along the axis along which that is less.
    """

    contrast: float
    white: float
    detail: float
    blur: float


def measure(image: np.ndarray) -> ImageStatistics:
    """The statistics of an image, float32 RGB in [0, 1], [3, height, width]."""
    grey = cv2.cvtColor(np.ascontiguousarray(to_uint8(image).transpose(1, 2, 0)), cv2.COLOR_RGB2GRAY)
    scale = SIDE / min(grey.shape)
    if scale < 1:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    darkest, brightest = np.percentile(grey, CONTRAST_PERCENTILES)
    pixels = grey.astype(np.float32)
    return ImageStatistics(
        float(brightest - darkest),
        float((grey >= WHITE).mean()),
        float(cv2.Laplacian(pixels, cv2.CV_32F).var()),
        max(_blur_effect(pixels), _blur_effect(np.ascontiguousarray(pixels.T))),
    )


def describe_blank(image: ImageStatistics) -> str | None:
    """What is wrong with an image that shows nothing, or None."""
    if image.contrast >= MIN_CONTRAST:
        return None
    return (
        f"shows nothing: 96 % of its pixels are within {image.contrast:.0f} of 255 grey levels, expected {MIN_CONTRAST}"
    )


def maybe_defective(image: ImageStatistics, beside: ImageStatistics) -> bool:
    """Whether an image should be compared with more than the one beside it."""
    return image.white > MAX_WHITE or image.blur > BLURRED_ALONE or _is_blurred(image, beside.detail, beside.blur)


def describe_overexposed(image: ImageStatistics, around: list[ImageStatistics]) -> str | None:
    """What is wrong with an image that is overexposed, unlike those of the same scene around it, or None."""
    white = float(np.median([other.white for other in around]))
    if image.white <= MAX_WHITE or white > MAX_WHITE_AROUND:
        return None
    return f"is overexposed: {100 * image.white:.0f} % of it is white, beside {100 * white:.0f} % of its neighbours"


def describe_blurred(image: ImageStatistics, around: list[ImageStatistics]) -> str | None:
    """What is wrong with an image that is blurred, compared with those of the same scene around it, or None."""
    detail = float(np.median([other.detail for other in around]))
    blur = float(np.median([other.blur for other in around]))
    if not _is_blurred(image, detail, blur):
        return None
    return f"is blurred: its Laplacian's variance is {100 * image.detail / detail:.0f} % of that of its neighbours"


def _is_blurred(image: ImageStatistics, detail: float, blur: float) -> bool:
    return image.detail < MIN_DETAIL_RATIO * detail and image.blur > blur + MAX_BLUR_EXCESS


def _blur_effect(image: np.ndarray) -> float:
    """The blur effect along the rows of a float image [height, width]."""
    blurred = cv2.blur(image, (BLUR_WINDOW, 1))
    difference, remaining = np.abs(np.diff(image, axis=1)), np.abs(np.diff(blurred, axis=1))
    lost = np.maximum(difference - remaining, 0).sum()
    return float(1 - lost / max(float(difference.sum()), 1e-6))
