"""Resizing and cropping, with the intrinsics that follow."""

from dataclasses import dataclass

import cv2
import numpy as np


@dataclass(frozen=True)
class Crop:
    """How a picture was brought to another size: scaled to width x height, then cut from (left, top)."""

    scale_x: float
    scale_y: float
    width: int
    height: int
    left: int
    top: int

    @property
    def matrix(self) -> np.ndarray:
        """Maps pixel coordinates (x, y, 1) of the original to those of the result, [3, 3]; its inverse leads back."""
        return np.array([[self.scale_x, 0, -self.left], [0, self.scale_y, -self.top], [0, 0, 1]])


def cover_crop(width: int, height: int, target_width: int, target_height: int) -> Crop:
    """Return the scaling that just covers the target size, and the cut from its middle."""
    factor = max(target_width / width, target_height / height)
    # A side is rounded to a whole pixel, so its true scale differs a little from the factor.
    scaled_width = max(target_width, round(width * factor))
    scaled_height = max(target_height, round(height * factor))
    left, top = (scaled_width - target_width) // 2, (scaled_height - target_height) // 2
    return Crop(scaled_width / width, scaled_height / height, scaled_width, scaled_height, left, top)


def resize_and_crop(image: np.ndarray, K: np.ndarray, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Scale a picture to cover height x width, cut out the middle, and let the intrinsics follow exactly.

    image: uint8 RGB, [image height, image width, 3]. K: pixels, pixel centres at .5, [3, 3].
    Returns the picture, float32 in [0, 1], [3, height, width], and its intrinsics, float32, [3, 3], with row 0 divided
    by the width and row 1 by the height. `cover_crop` tells where a result lies in the original.
    """
    crop = cover_crop(image.shape[1], image.shape[0], width, height)
    interpolation = cv2.INTER_AREA if crop.scale_x < 1 else cv2.INTER_CUBIC
    scaled = cv2.resize(image, (crop.width, crop.height), interpolation=interpolation)
    cut = scaled[crop.top : crop.top + height, crop.left : crop.left + width]
    pixels = np.ascontiguousarray(cut.transpose(2, 0, 1), dtype=np.float32) / np.float32(255)  # [3, height, width]
    intrinsics = np.diag([1 / width, 1 / height, 1]) @ crop.matrix @ K
    return pixels, intrinsics.astype(np.float32)
