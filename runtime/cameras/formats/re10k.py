"""RealEstate10K's trajectories: a line with the video's address, then one line for each frame.

    timestamp fx fy cx cy 0 0 w2c     microseconds; focal lengths and principal point over width and height; 3 x 4

Poses are world-to-camera with OpenCV axes. A frame's image is named by its timestamp; the file does not know how
many pixels it has, so one image must be given or stand beside the file.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...errors import InputError, error_context
from ...geometry.intrinsics import intrinsic_matrix
from ...geometry.rigid import invert_rigid
from ..camera import Camera
from ..io import RE10K_COLUMNS
from ..parsing import numbers, read_text


def read(path: Path, images: Sequence[Path] = ()) -> list[Camera]:
    """Read the file; `images` give the frames' size. Raises InputError."""
    rows = _rows(path)
    width, height = _size([name for _, name, _ in rows], path.parent, images)
    cameras = []
    for number, name, values in rows:
        with error_context(f"line {number} (frame {name})"):
            K = intrinsic_matrix(*values[:4] * (width, height, width, height))
            pose = np.vstack([values[6:].reshape(3, 4), (0, 0, 0, 1)])
            cameras.append(Camera(name, width, height, K, invert_rigid(pose)))
    return cameras


def timestamps(path: Path) -> list[str]:
    """The names of the frames, for which no image is needed; raises InputError."""
    with error_context(str(path)):
        return [name for _, name, _ in _rows(path)]


def _rows(path: Path) -> list[tuple[int, str, np.ndarray]]:
    """For each frame the line's number, the timestamp and the 18 numbers after it."""
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.split()
        if not words or (number == 1 and len(words) == 1):  # the address
            continue
        with error_context(f"line {number}"):
            if len(words) != RE10K_COLUMNS:
                raise InputError(
                    f"has {len(words)} words, expected {RE10K_COLUMNS}: timestamp fx fy cx cy 0 0 and a 3 x 4 pose"
                )
            rows.append((number, words[0], np.array(numbers(words[1:]))))
    if not rows:
        raise InputError("holds no frame, expected lines of a timestamp and 18 numbers")
    return rows


def _size(names: Sequence[str], folder: Path, images: Sequence[Path]) -> tuple[int, int]:
    """The size of the first frame that has an image: all are cut from one video."""
    from ..image_files import GIVE_IMAGES, ImageSizes

    sizes = ImageSizes(folder, images)
    for name in names:
        size = sizes.size(name)
        if size is not None:
            return size
    raise InputError(
        f"gives no size in pixels, and no image is named by one of its {len(names)} timestamps, such as {names[0]}; "
        + GIVE_IMAGES
    )
