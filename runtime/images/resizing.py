"""Resizing and cropping of images, with their intrinsics."""

from dataclasses import dataclass

import cv2
import numpy as np

from ..geometry.intrinsics import crop_intrinsics, normalize_intrinsics, scale_intrinsics
from .sizes import MAX_STRETCH


@dataclass(frozen=True)
class Crop:
    """A resize to width x height, followed by a crop whose top left pixel is (left, top)."""

    scale_x: float
    scale_y: float
    width: int
    height: int
    left: int
    top: int

    @property
    def matrix(self) -> np.ndarray:
        """Maps homogeneous pixel coordinates of the original image to those of the result, [3, 3]."""
        return crop_intrinsics(scale_intrinsics(np.eye(3), self.scale_x, self.scale_y), self.left, self.top)


def frame_crop(width: int, height: int, target_width: int, target_height: int) -> Crop:
    """The whole image, stretched by at most MAX_STRETCH, where its shape is nearly the target's; else `cover_crop`.

    A network works at multiples of some pixels, and sizes that are no exact copy of an image's shape are stretched
    rather than cropped: the intrinsics hold the two scales.
    """
    scale_x, scale_y = target_width / width, target_height / height
    if max(scale_x, scale_y) > MAX_STRETCH * min(scale_x, scale_y):
        return cover_crop(width, height, target_width, target_height)
    return Crop(scale_x, scale_y, target_width, target_height, 0, 0)


def cover_crop(width: int, height: int, target_width: int, target_height: int) -> Crop:
    """The smallest resize that covers the target size, and the centre crop to it."""
    factor = max(target_width / width, target_height / height)
    # Sides are rounded to whole pixels, so the scales of both sides differ slightly from the factor.
    scaled_width = max(target_width, round(width * factor))
    scaled_height = max(target_height, round(height * factor))
    left, top = (scaled_width - target_width) // 2, (scaled_height - target_height) // 2
    return Crop(scaled_width / width, scaled_height / height, scaled_width, scaled_height, left, top)


def resize_and_crop(
    image: np.ndarray, K: np.ndarray, height: int, width: int, crop: Crop | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Resize an image to height x width, with the exact intrinsics of the result.

    image: uint8 RGB [image height, image width, 3]. K: in pixels, [3, 3]. crop: by default `frame_crop`.
    Returns the image, float32 in [0, 1], [3, height, width], and its normalised intrinsics, float32 [3, 3].
    """
    crop = crop or frame_crop(image.shape[1], image.shape[0], width, height)
    interpolation = cv2.INTER_AREA if crop.scale_x < 1 else cv2.INTER_CUBIC
    scaled = cv2.resize(image, (crop.width, crop.height), interpolation=interpolation)
    cut = scaled[crop.top : crop.top + height, crop.left : crop.left + width]
    pixels = np.ascontiguousarray(cut.transpose(2, 0, 1), dtype=np.float32) / np.float32(255)  # [3, height, width]
    intrinsics = normalize_intrinsics(crop.matrix, width, height) @ K
    return pixels, intrinsics.astype(np.float32)
