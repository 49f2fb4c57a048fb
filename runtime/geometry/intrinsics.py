"""Intrinsics K [3, 3] of a pinhole camera without skew: checks, normalisation, scaling and cropping.

    x = fx X / Z + cx,  y = fy Y / Z + cy         Hartley & Zisserman, Multiple View Geometry, 2nd ed., eq. 6.7

In pixels, the centre of the top left pixel is at (0.5, 0.5), as in COLMAP. Normalised intrinsics are divided by the
image size, row 0 by the width and row 1 by the height, so that the image covers [0, 1] x [0, 1].
"""

import numpy as np

from ..errors import InputError

MIN_FOCAL, MAX_FOCAL = 0.05, 100.0  # in image widths (heights): fields of view of 169 and 0.6 degrees
HALF_PIXEL = 0.5  # OpenCV's pixel centres are at integers, ours at half-integers


def check_intrinsics(K: np.ndarray, width: float, height: float) -> None:
    """Raise InputError unless K [3, 3] is plausible for this image size (1 by 1 for normalised intrinsics)."""
    if K.shape != (3, 3):
        raise InputError(f"K has shape {K.shape}, expected (3, 3)")
    if not np.isfinite(K).all():
        raise InputError("K holds NaN or infinity, expected finite numbers")
    if K[0, 1] != 0 or K[1, 0] != 0 or K[2].tolist() != [0, 0, 1]:
        raise InputError(f"K is {K.tolist()}, expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]: no skew")
    image = f"an image of {width} x {height}"
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    if min(fx, fy) <= 0:
        raise InputError(f"the focal lengths are {fx:g} and {fy:g}, expected positive ones")
    if min(fx / width, fy / height) < MIN_FOCAL or max(fx / width, fy / height) > MAX_FOCAL:
        raise InputError(f"the focal lengths {fx:g} and {fy:g} are not plausible for {image}; check their unit")
    if not (-width <= cx <= 2 * width and -height <= cy <= 2 * height):
        raise InputError(f"the principal point ({cx:g}, {cy:g}) lies far outside {image}; check its unit")


def intrinsic_matrix(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """K [3, 3] from focal lengths and principal point, all in pixels or all normalised."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def scale_intrinsics(K: np.ndarray, scale_x: float, scale_y: float) -> np.ndarray:
    """K [..., 3, 3], float64, of the image resized by these factors."""
    return np.asarray(K, np.float64) * np.array([scale_x, scale_y, 1.0])[:, None]


def crop_intrinsics(K: np.ndarray, left: float, top: float) -> np.ndarray:
    """K [..., 3, 3], float64, of the image without its `left` columns and `top` rows (in the units of K)."""
    return np.asarray(K, np.float64) - np.array([[0, 0, left], [0, 0, top], [0, 0, 0]])


def normalize_intrinsics(K: np.ndarray, width: float, height: float) -> np.ndarray:
    """Normalised intrinsics [..., 3, 3], float64, of K in pixels."""
    return scale_intrinsics(K, 1 / width, 1 / height)


def denormalize_intrinsics(intrinsics: np.ndarray, width: float, height: float) -> np.ndarray:
    """K in pixels, [..., 3, 3], float64, of normalised intrinsics."""
    return scale_intrinsics(intrinsics, width, height)


def to_opencv_pixels(K: np.ndarray) -> np.ndarray:
    """K [3, 3] for pixel centres at integers."""
    return crop_intrinsics(K, HALF_PIXEL, HALF_PIXEL)


def from_opencv_pixels(K: np.ndarray) -> np.ndarray:
    """K [3, 3] for pixel centres at half-integers, from OpenCV's convention."""
    return crop_intrinsics(K, -HALF_PIXEL, -HALF_PIXEL)
