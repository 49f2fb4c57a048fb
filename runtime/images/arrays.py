"""Images given as arrays: the value range follows from the type."""

import numpy as np

from ..errors import InputError

EXPECTED = "expected RGB [height, width, 3], as uint8 in 0 to 255 or as floating point in [0, 1]"


def as_uint8_image(image: np.ndarray, name: str) -> np.ndarray:
    """An RGB image [height, width, 3], uint8 or floating point in [0, 1], as uint8.

    name: for messages. Raises InputError for other shapes, types and ranges, such as uint16, or float32 in [0, 255] or
    [-1, 1], whose range would have to be guessed.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise InputError(f"{name}: an image of shape {image.shape}; {EXPECTED}")
    if image.dtype == np.uint8:
        return np.ascontiguousarray(image)
    if not np.issubdtype(image.dtype, np.floating):
        raise InputError(f"{name}: an image of type {image.dtype}; {EXPECTED}")
    low, high = float(image.min()), float(image.max())
    if not (low >= 0 and high <= 1):  # also NaN
        raise InputError(f"{name}: an image of {image.dtype} with values from {low:g} to {high:g}; {EXPECTED}")
    return np.rint(image * 255).astype(np.uint8)
