"""Textures cropped from the images in a folder."""

from collections.abc import Iterator
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from ...runtime.errors import InputError
from .textures import PHOTO_KIND, SIZE, Textures, mip_levels

HDR_SUFFIX = ".hdr"
SUFFIXES = {".jpg", ".jpeg", ".png", ".webp", HDR_SUFFIX}
# The quantile of an HDR image's radiance that becomes white, and the gamma of its tone curve.
WHITE_QUANTILE, GAMMA = 0.95, 2.2
# Crops of one image at most, and pixels of an image per crop.
MAX_CROPS, PIXELS_PER_CROP = 4, 512 * 512
# Crops in all; each takes 256 KiB.
MAX_TEXTURES = 400
# Least standard deviation of a crop's grey values; generated textures serve as well below it.
MIN_CONTRAST = 0.03


@cache
def photo_textures(folder: Path) -> Textures:
    """Square crops of all images below a folder, the same for the same files.

    Raises InputError if no crop has enough contrast, or no image can be read.
    """
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)
    texels = [mip_levels(crop) for index, path in enumerate(paths) for crop in _crops(path, index)]
    if not texels:
        raise InputError(
            f"{folder}: holds no image with texture that can be read; expected .jpg, .png, .webp or .hdr files"
        )
    order = np.random.default_rng(len(texels)).permutation(len(texels))[:MAX_TEXTURES]
    return Textures(np.stack([texels[index] for index in order]), (PHOTO_KIND,) * len(order))


def concatenate(first: Textures, second: Textures) -> Textures:
    """The textures of both banks."""
    return Textures(np.concatenate([first.texels, second.texels]), first.kinds + second.kinds)


def _crops(path: Path, index: int) -> Iterator[np.ndarray]:
    """Random crops of an image, resized to [SIZE, SIZE, 3], RGB in [0, 1]; sides are at least SIZE pixels."""
    image = _read(path)
    if image is None or min(image.shape[:2]) < SIZE:
        return
    rng = np.random.default_rng(index)
    height, width = image.shape[:2]
    for _ in range(int(np.clip(height * width // PIXELS_PER_CROP, 1, MAX_CROPS))):
        side = int(np.exp(rng.uniform(np.log(SIZE), np.log(min(height, width)))))
        top, left = int(rng.integers(height - side + 1)), int(rng.integers(width - side + 1))
        crop = cv2.resize(image[top : top + side, left : left + side], (SIZE, SIZE), interpolation=cv2.INTER_AREA)
        colours = crop[..., ::-1].astype(np.float32) / 255
        if colours.mean(axis=2).std() >= MIN_CONTRAST:
            yield colours


def _read(path: Path) -> np.ndarray | None:
    """An image as uint8 BGR [height, width, 3]; None if it cannot be read."""
    if path.suffix.lower() != HDR_SUFFIX:
        return cv2.imread(str(path), cv2.IMREAD_COLOR)
    radiance = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if radiance is None:
        return None
    white = float(np.quantile(radiance, WHITE_QUANTILE)) or 1.0  # a black image stays black
    return np.rint(255 * (radiance / white).clip(0, 1) ** (1 / GAMMA)).astype(np.uint8)
