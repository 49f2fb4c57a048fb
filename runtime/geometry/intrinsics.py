"""Intrinsics: K in pixels with the centre of the top left pixel at (.5, .5), or normalised by the image's size."""

import numpy as np

from ..errors import InputError

MIN_FOCAL, MAX_FOCAL = 0.05, 100.0  # in image widths (heights): 169 and 0.6 degrees of view


def check_intrinsics(K: np.ndarray, width: float, height: float) -> None:
    """Check K [3, 3] of an image of this size (1 by 1 for a normalised K); raises InputError."""
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
    """K [3, 3] without skew."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
