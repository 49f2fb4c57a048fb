"""Writing RGB images and depth maps as 8-bit PNG files, atomically."""

from pathlib import Path

import numpy as np

from ..system.files import atomic_write
from .colormaps import colormap_depth, to_uint8


def save_png(path: Path, rgb: np.ndarray) -> None:
    """Write RGB in [0, 1], [height, width, 3], as an 8-bit PNG; values outside are clipped.

    Raises InputError if the file cannot be written.
    """
    import cv2  # imported late, so that commands start without OpenCV

    _, encoded = cv2.imencode(".png", to_uint8(rgb)[..., ::-1])
    with atomic_write(path) as temporary:
        temporary.write_bytes(encoded.data)


def save_depth_png(path: Path, depth: np.ndarray) -> None:
    """Write depth, [height, width], as `colormap_depth` renders it.

    Raises InputError if the file cannot be written.
    """
    save_png(path, colormap_depth(depth))
