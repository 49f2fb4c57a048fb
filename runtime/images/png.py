"""Pictures out: colours and depth as 8-bit PNG files that appear whole or not at all."""

from pathlib import Path

import numpy as np

from ..system.files import atomic_write
from .colormaps import colormap_depth, to_uint8


def save_png(path: Path, rgb: np.ndarray) -> None:
    """Write colours in [0, 1], [height, width, 3], as an 8-bit PNG; what lies outside is clipped.

    Raises InputError if the file cannot be written.
    """
    import cv2  # here, so that a command can say what it does without loading OpenCV

    _, encoded = cv2.imencode(".png", to_uint8(rgb)[..., ::-1])
    with atomic_write(path) as temporary:
        temporary.write_bytes(encoded.data)


def save_depth_png(path: Path, depth: np.ndarray) -> None:
    """Write depth in world units, [height, width], in the colours of `colormap_depth`.

    Raises InputError if the file cannot be written.
    """
    save_png(path, colormap_depth(depth))
