"""Photographic textures: windows of the images in a folder, beside those that are generated."""

from collections.abc import Iterator
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from ...runtime.errors import InputError
from .textures import SIZE, Textures, mip_levels

KIND = "photo"
HDR_SUFFIX = ".hdr"
SUFFIXES = {".jpg", ".jpeg", ".png", ".webp", HDR_SUFFIX}
# The quantile of an HDR image's radiance that becomes white, and the display's gamma.
WHITE_QUANTILE, GAMMA = 0.95, 2.2
# Windows of one image at most, and texels of an image that one window should stand for.
MOST_WINDOWS, TEXELS_A_WINDOW = 4, 512 * 512
# Windows in all: each takes 256 KiB.
MOST_TEXTURES = 400
# A window of less contrast, the deviation of its grey values, is as well generated.
LEAST_CONTRAST = 0.03


@cache
def photo_textures(folder: Path) -> Textures:
    """Square windows of all images below a folder, the same for the same files.

    Raises InputError if there is no image that can be read.
    """
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)
    windows = [(index, window) for index, path in enumerate(paths) for window in _windows(path, index)]
    if not windows:
        raise InputError(
            f"{folder}: holds no image with texture that can be read; expected .jpg, .png, .webp or .hdr files"
        )
    order = np.random.default_rng(len(windows)).permutation(len(windows))[:MOST_TEXTURES]
    texels = [mip_levels(windows[index][1]) for index in order]
    return Textures(np.stack(texels), (KIND,) * len(texels))


def concatenate(first: Textures, second: Textures) -> Textures:
    """Two banks as one."""
    return Textures(np.concatenate([first.texels, second.texels]), first.kinds + second.kinds)


def _windows(path: Path, index: int) -> Iterator[np.ndarray]:
    """Windows [SIZE, SIZE, 3] of an image, RGB in [0, 1], of any scale from SIZE texels on."""
    image = _read(path)
    if image is None or min(image.shape[:2]) < SIZE:
        return
    rng = np.random.default_rng(index)
    height, width = image.shape[:2]
    for _ in range(int(np.clip(height * width // TEXELS_A_WINDOW, 1, MOST_WINDOWS))):
        side = int(np.exp(rng.uniform(np.log(SIZE), np.log(min(height, width)))))
        top, left = int(rng.integers(height - side + 1)), int(rng.integers(width - side + 1))
        window = cv2.resize(image[top : top + side, left : left + side], (SIZE, SIZE), interpolation=cv2.INTER_AREA)
        colours = window[..., ::-1].astype(np.float32) / 255
        if colours.mean(axis=2).std() >= LEAST_CONTRAST:
            yield colours


def _read(path: Path) -> np.ndarray | None:
    """An image as BGR bytes [height, width, 3], or None."""
    if path.suffix.lower() != HDR_SUFFIX:
        return cv2.imread(str(path), cv2.IMREAD_COLOR)
    radiance = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if radiance is None:
        return None
    white = float(np.quantile(radiance, WHITE_QUANTILE)) or 1.0  # an image that is black stays so
    return np.rint(255 * (radiance / white).clip(0, 1) ** (1 / GAMMA)).astype(np.uint8)
